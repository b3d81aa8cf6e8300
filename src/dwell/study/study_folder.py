"""The folder of a study: what study it is, a part for every finished item, and the tables.

``study.json`` says what study the folder belongs to, ``parts`` holds one Parquet file an item. A
file appears complete or not at all: it is written under another name, brought to the disk, and
renamed. Whatever kills the process, what is there can be relied on, and what is not is done again.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.cellfile import from_record
from dwell.cellfile.work_folder import FolderMark, unwritable
from dwell.errors import DwellError, RunError
from dwell.files import write_whole

if TYPE_CHECKING:
    import polars as pl

    from dwell.study.results import StudyRuns

PARTS = "parts"
STUDY = FolderMark("study", "study.json", 1, (PARTS,))
#: Of a finished study, each a Parquet file.
TABLES = ("runs", "costs", "latencies")


def finished(folder: Path) -> frozenset[str]:
    """Return the names of the items whose parts are in the folder of a study."""
    return frozenset(path.stem for path in (folder / PARTS).glob("*.parquet"))


def read_parts(folder: Path, names: Sequence[str]) -> pl.DataFrame:
    """Return the parts of items, one below the other.

    Raises
    ------
    RunError
        If one cannot be read.
    """
    import polars as pl

    remedy = "; remove it and run the study again"
    return pl.concat([_read(folder / PARTS / f"{name}.parquet", remedy) for name in names])


def write_table(folder: Path, name: str, frame: pl.DataFrame) -> None:
    """Write a table of the whole study, or the part ``parts/ITEM``.

    Raises
    ------
    SimulationError
        If that fails.
    """
    path = folder / f"{name}.parquet"
    # To memory first: how a disk is full is then the system's own answer.
    data = io.BytesIO()
    frame.rechunk().write_parquet(data)
    try:
        write_whole(path, data.getvalue())
    except OSError as error:
        raise unwritable(path, error) from None


def is_study(folder: Path) -> bool:
    """Whether a folder is a study's."""
    return (folder / STUDY.file).is_file()


def open_study(folder: str | Path) -> StudyRuns:
    """Read the folder of a study that is finished.

    Raises
    ------
    RunError
        If it is none, its runs are not finished, or a file of it cannot be read.
    """
    from dwell.study.results import StudyRuns

    folder = Path(folder)
    path = folder / STUDY.file
    if not is_study(folder):
        raise RunError(f"{folder} is no study: there is no {STUDY.file}")
    try:
        known: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        problem = from_record(known["cell"])
        scenarios, policies = (tuple(map(str, known[name])) for name in ("scenarios", "policies"))
        seeds = tuple(map(int, known["seeds"]))
        windows = int(known["windows"])
        labels = {str(path): str(label) for path, label in known.get("labels", {}).items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, DwellError) as error:
        raise RunError(f"{path}: cannot be read ({error!r})") from None
    tables = {}
    for name in TABLES:
        table = folder / f"{name}.parquet"
        if not table.is_file():
            raise RunError(
                f"{folder}: the study is not finished: there is no {table.name}; `dwell study` "
                "with its file goes on with it"
            )
        tables[name] = _read(table)
    software = {name: one for name, one in known.get("software", {}).items() if name != "sources"}
    return StudyRuns(
        name=str(known.get("name", folder.name)),
        problem=problem,
        scenarios=scenarios,
        policies=policies,
        seeds=seeds,
        windows=windows,
        **tables,
        versions=software,
        labels=labels,
    )


def _read(path: Path, remedy: str = "") -> pl.DataFrame:
    import polars as pl

    try:
        return pl.read_parquet(path, glob=False)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise RunError(f"{path}: cannot be read ({error}){remedy}") from None
