"""FleetRun: the runs of all cells of a fleet, which were simulated together.

The folder of a fleet contains one run folder per cell, ``fleet-windows.parquet`` with the load of
the shared nodes, and ``fleet.json``, which gets this name after all other files are complete.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.errors import DwellError, ProblemError, RunError
from dwell.files import write_whole
from dwell.model.declaration import declared_fields
from dwell.model.document import Document, to_document
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record.json_documents import read_document
from dwell.record.run import FLEET, Run, open_run, read_table, write_table
from dwell.record.schema import SCHEMA_VERSION, require_version

if TYPE_CHECKING:
    import numpy as np
    import polars as pl
    from numpy.typing import NDArray

#: Name of `FLEET` until all other files are written.
UNFINISHED = f".{FLEET}.unfinished"
LOAD = "fleet-windows.parquet"
#: Largest number of incomplete runs that a message lists.
LISTED = 4


class FleetRun:
    """Runs of the cells of a fleet, and the load of the nodes that they share.

    Parameters
    ----------
    fleet : Fleet
        The simulated fleet.
    cells : mapping of str to Run
        Runs by the names of the cells.
    load : mapping of str to array, or function that makes a DataFrame
        Load of every shared node over time (see `dwell.sim.shared_load`).
    seed : int
    seconds : float
        Length of the run; every cell releases cycles until then.
    guard : bool
        Whether guards acted.
    phases_ms : mapping of str to float
        Offset of every cell's releases.
    faults : sequence of str
        Reasons why runs of the fleet are missing from `cells`.
    finished : bool
        Whether all files of the fleet were written.
    """

    def __init__(
        self,
        fleet: Fleet,
        cells: Mapping[str, Run],
        load: Mapping[str, NDArray[np.generic]] | Callable[[], pl.DataFrame],
        *,
        seed: int,
        seconds: float,
        guard: bool,
        phases_ms: Mapping[str, float],
        faults: Sequence[str] = (),
        finished: bool = True,
    ) -> None:
        self.fleet, self.cells, self._load = fleet, dict(cells), load
        self.seed, self.seconds, self.guard = seed, seconds, guard
        self.phases_ms = dict(phases_ms)
        self.faults, self.finished = tuple(faults), finished

    def __repr__(self) -> str:
        return f"<FleetRun of {self.fleet.name}: {len(self.cells)} cells, seed {self.seed}>"

    @property
    def windows(self) -> pl.DataFrame:
        """Windows of all cells, with a column `cell`; columns that a cell lacks are null."""
        return self._all("windows")

    @property
    def decisions(self) -> pl.DataFrame:
        """Decisions of all cells, with a column `cell`; columns that a cell lacks are null.

        The columns of Φ and the round always exist; without coordination they are null.
        """
        import polars as pl

        found = self._all("decisions")
        asked = {"phi_before": pl.Float64, "phi_after": pl.Float64, "round": pl.Int64}
        missing = [(name, kind) for name, kind in asked.items() if name not in found.columns]
        return found.with_columns(pl.lit(None, kind).alias(name) for name, kind in missing)

    @cached_property
    def load(self) -> pl.DataFrame:
        """Load of every shared node over time, and each cell's share of it."""
        import polars as pl

        return self._load() if callable(self._load) else pl.DataFrame(self._load)

    def _all(self, table: str) -> pl.DataFrame:
        import polars as pl

        frames: list[pl.DataFrame] = [
            getattr(run, table).select(pl.lit(name).alias("cell"), pl.all())
            for name, run in self.cells.items()
        ]
        # Merge the categories of all cells for each Enum column.
        names: dict[str, dict[str, None]] = {}
        for frame in frames:
            for column, kind in frame.schema.items():
                if isinstance(kind, pl.Enum):
                    names.setdefault(column, {}).update(dict.fromkeys(kind.categories))
        kinds = {column: pl.Enum([*known]) for column, known in names.items()}
        casts = [frame.cast({c: kinds[c] for c in frame.columns if c in kinds}) for frame in frames]
        return pl.concat(casts, how="diagonal_relaxed")

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the fleet's folder: one run folder per cell, and ``fleet.json`` last.

        Parameters
        ----------
        path : path-like
            Folder to make. Runs of the same fleet and settings in it are replaced.

        Raises
        ------
        RunError
            If the folder holds anything else, or cannot be written.
        """
        folder = Path(path)
        described = self._described()
        require_free_or_same(folder, described)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / FLEET).unlink(missing_ok=True)
            write_whole(folder / UNFINISHED, json.dumps(described, indent=2) + "\n")
            for name, run in self.cells.items():
                run.save(folder / name)
            write_table(self.load, folder / LOAD)
            (folder / UNFINISHED).replace(folder / FLEET)
        except OSError as error:
            raise RunError(f"{folder}: cannot be written ({error.strerror or error})") from None
        return folder

    def _described(self) -> dict[str, Any]:
        meta = next(iter(self.cells.values())).meta
        return describe_fleet(
            self.fleet,
            seed=self.seed,
            guard=self.guard,
            phases=self.phases_ms,
            seconds=self.seconds,
            versions=meta["versions"],
        )


def describe_fleet(fleet: Fleet, **settings: Any) -> dict[str, Any]:
    """Return the content of ``fleet.json``.

    The settings are seed, seconds, guard, versions, and the phases (ms by cell), all JSON-able.
    """
    document = fleet_document(fleet)
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
    return {
        "schema_version": SCHEMA_VERSION,
        "name": fleet.name,
        "file": fleet.file or None,
        "hash": digest,
        "coordination": fleet.coordination,
        **settings,
        "cells": [cell.name for cell in fleet.cells],
        "fleet": document,
    }


def fleet_document(fleet: Fleet) -> Document:
    """Return a fleet as JSON-able values, with the complete cell in every entry."""
    entries = [{"cell": to_document(entry.cell), **_keys(entry)} for entry in fleet.entries]
    return {"name": fleet.name, "cells": entries, **_keys(fleet)}


def _keys(of: Fleet | FleetEntry) -> Document:
    values = {one.named: getattr(of, one.name) for one in declared_fields(type(of))}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
        if value is not None
    }


def _fleet_of(document: Mapping[str, Any], file: str) -> Fleet:
    from dwell.cellfile import from_record

    given = dict(document)
    entries = tuple(
        FleetEntry(**{**entry, "cell": from_record(entry["cell"])}) for entry in given.pop("cells")
    )
    return Fleet(entries=entries, file=file, **given)


def require_free_or_same(folder: Path, described: Mapping[str, Any]) -> None:
    """Refuse a folder unless it is empty, missing, or of the same fleet and settings.

    Raises
    ------
    RunError
        If the folder holds anything else.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    file = _described_in(folder)
    if file is None:
        raise RunError(f"{folder} exists and is no fleet's; choose another folder")
    same = {"versions": None, "file": None}
    if {**read_document(file), **same} != {**json.loads(json.dumps(described)), **same}:
        raise RunError(f"{folder} holds the runs of another fleet; choose another folder")


def _described_in(folder: Path) -> Path | None:
    """Return the file that describes a fleet's folder; None in any other folder."""
    return next((folder / one for one in (FLEET, UNFINISHED) if (folder / one).is_file()), None)


def is_fleet(path: str | os.PathLike[str]) -> bool:
    """Whether a folder holds the runs of a fleet, complete or not."""
    return _described_in(Path(path)) is not None


def open_fleet(path: str | os.PathLike[str], *, whole: bool = True) -> FleetRun:
    """Open a fleet's folder; each table is read at the first access.

    Parameters
    ----------
    whole : bool
        Whether to require all runs. Otherwise `FleetRun.faults` explains the missing runs.

    Raises
    ------
    RunError
        If the folder is missing or not of a fleet, if it has no complete run, or if a run is
        incomplete and `whole` is true.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise RunError(f"{folder}: no such folder")
    file = _described_in(folder)
    if file is None:
        raise RunError(f"{folder}: no fleet's folder (it has no {FLEET})")
    described = read_document(file)
    require_version(described, f"{file}: ")
    try:
        names = [str(name) for name in described["cells"]]
        fleet = _fleet_of(described["fleet"], str(described.get("file") or ""))
        seed, guard = int(described["seed"]), bool(described["guard"])
        seconds = float(described["seconds"])
        phases_ms = {name: float(described["phases"][name]) for name in names}
    except (KeyError, TypeError, ValueError) as error:
        why = "; ".join(str(error).splitlines()) if isinstance(error, ProblemError) else repr(error)
        raise RunError(f"{file}: cannot be read ({why})") from None
    finished = file.name == FLEET
    runs, faults = {}, []
    for name in names:
        try:
            runs[name] = open_run(folder / name)
        except DwellError as error:
            faults.append(str(error))
    if not runs or (whole and (faults or not finished)):
        remedy = "remove what is damaged, and the same command makes the others again"
        told = f"{folder}: {how_many_are_whole(len(runs), len(names))}; {remedy}"
        raise RunError("\n".join([told, *(f"  {fault}" for fault in listed(faults))]))
    load = read_table(folder / LOAD)
    return FleetRun(
        *(fleet, runs, load),
        seed=seed,
        seconds=seconds,
        guard=guard,
        phases_ms=phases_ms,
        faults=faults,
        finished=finished,
    )


def how_many_are_whole(count: int, of: int) -> str:
    """Return a message about the number of complete runs."""
    return f"{count} of {of} runs are whole"


def listed(faults: Sequence[str]) -> list[str]:
    """Return the first `LISTED` faults, and a line with the number of further faults."""
    more = [f"and {len(faults) - LISTED} more"] if len(faults) > LISTED else []
    return [*faults[:LISTED], *more]
