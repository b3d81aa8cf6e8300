"""The folder of a study: what study it is, a part for every finished item, and the tables.

``study.json`` says what study the folder belongs to, ``parts`` holds one Parquet file an item. A
file appears complete or not at all: it is written under another name, brought to the disk, and
renamed. Whatever kills the process, what is there can be relied on, and what is not is done again.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dwell.cellfile.work_folder import Description, FolderMark, claimed, unwritable
from dwell.errors import RunError
from dwell.files import write_whole

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Parts", "opened"]

FOLDER = "parts"
STUDY = FolderMark("study", "study.json", 1, (FOLDER,))


@dataclass(slots=True)
class Parts:
    """The parts of one study in its folder, open for this process alone.

    Parameters
    ----------
    names : frozenset of str
        Of all items of the study.
    """

    folder: Path
    names: frozenset[str]

    def finished(self) -> frozenset[str]:
        """Return the names of the items whose parts are there."""
        found = (path.stem for path in (self.folder / FOLDER).glob("*.parquet"))
        return self.names.intersection(found)

    def write(self, name: str, frame: pl.DataFrame) -> None:
        """Write the part of an item.

        Raises
        ------
        SimulationError
            If that fails; the parts that are there stay.
        """
        self._write(self._part(name), frame)

    def read(self, names: Sequence[str]) -> pl.DataFrame:
        """Return the parts of items, one below the other.

        Raises
        ------
        RunError
            If one cannot be read.
        """
        import polars as pl

        frames = []
        for name in names:
            try:
                frames.append(pl.read_parquet(self._part(name), glob=False))
            except (OSError, pl.exceptions.PolarsError) as error:
                raise RunError(
                    f"{self._part(name)}: cannot be read ({error}); remove it and run the study "
                    "again"
                ) from None
        return pl.concat(frames)

    def write_table(self, name: str, frame: pl.DataFrame) -> None:
        """Write a table of the whole study.

        Raises
        ------
        SimulationError
            If that fails.
        """
        self._write(self.folder / f"{name}.parquet", frame)

    def _part(self, name: str) -> Path:
        return self.folder / FOLDER / f"{name}.parquet"

    def _write(self, path: Path, frame: pl.DataFrame) -> None:
        # To memory first: how a disk is full is then the system's own answer.
        data = io.BytesIO()
        frame.rechunk().write_parquet(data)
        try:
            write_whole(path, data.getvalue())
        except OSError as error:
            raise unwritable(path, error) from None


@contextmanager
def opened(folder: Path, description: Description, names: Sequence[str]) -> Iterator[Parts]:
    """Open the folder of a study, which is made where there is none.

    Parameters
    ----------
    description : mapping
        JSON-able: all that the tables depend on.
    names : sequence of str
        Of all items.

    Raises
    ------
    RunError
        If the folder holds something else, or another study, or is in use.
    SimulationError
        If it cannot be made or written.
    """
    with claimed(folder, STUDY, description):
        yield Parts(folder, frozenset(names))
