"""Run: the record of a simulated run or of a live one; one schema for both."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from dwell.display import Displayed
from dwell.errors import ProblemError, RunError
from dwell.files import write_whole
from dwell.model import Problem, Scenario
from dwell.model.table_columns import TABLES
from dwell.record.journal import JOURNAL, Journal, read_journal
from dwell.record.json_documents import read_document
from dwell.record.schema import SCHEMA_VERSION, require_table, require_version
from dwell.record.table_arrays import TableArrays, arrays_of

if TYPE_CHECKING:
    import polars as pl

ALWAYS = tuple(name for name, table in TABLES.items() if not table.on_request)
#: Name of the scenario that holds the disturbances applied to a run.
PLAYED = "played"
#: File of a fleet's folder that is written last (see `dwell.record.fleet_run`).
FLEET = "fleet.json"
ON_REQUEST = tuple(name for name, table in TABLES.items() if table.on_request)

#: Sentences about the losses of a journal.
LOSSES = {
    "torn_bytes": "{} bytes at the journal's end were torn by a kill; what they said is not here.",
    "damaged_bytes": "{} bytes within the journal were damaged; what they said is not here.",
    "missing_cycles": "Cycles missing from the run: {}.",
    "missing_windows": "Windows missing from the run: {}.",
}

#: Message if a measured run has no jobs.
NO_JOBS = "this run kept no jobs; `dwell controller --jobs` keeps them"

Table: TypeAlias = "pl.DataFrame | Callable[[], pl.DataFrame]"


class Run(Displayed):
    """Tables and metadata of one run.

    Parameters
    ----------
    meta : mapping, or function that makes it
        Problem, scenario, policy, seed and versions, as JSON-able values.
    tables : mapping of str to DataFrame, or to a function that makes it
        ``cycles``, ``windows``, ``decisions`` and, on request, ``jobs`` and ``processes``. A
        function is called at the first access.
    arrays : mapping of str to function that makes `TableArrays`, optional
        Tables that are available as arrays without Polars.
    """

    def __init__(
        self,
        meta: Mapping[str, Any] | Callable[[], Mapping[str, Any]],
        tables: Mapping[str, Table],
        arrays: Mapping[str, Callable[[], TableArrays]] | None = None,
    ) -> None:
        self._meta = meta if callable(meta) else dict(meta)
        self._tables: dict[str, Table] = dict(tables)
        self._arrays = dict(arrays or {})

    def __repr__(self) -> str:
        told = {name: self.meta.get(name) for name in ("scenario", "policy", "seed", "windows")}
        known = ", ".join(f"{name} {value}" for name, value in told.items() if value is not None)
        cell = self.meta.get("problem")
        name = cell.get("name") if isinstance(cell, Mapping) else None
        return (
            f"<Run of {name or 'an unknown cell'}, {self.meta.get('kind', 'simulated')}: {known}>"
        )

    @cached_property
    def meta(self) -> dict[str, Any]:
        """Metadata of the run, ready for JSON."""
        meta = self._meta() if callable(self._meta) else self._meta
        return {**meta, "schema_version": SCHEMA_VERSION}

    def with_facts(self, **facts: object) -> Run:
        """Return the same run with further JSON-able entries in `meta`."""
        return Run({**self.meta, **facts}, self._tables, self._arrays)

    def _table(self, name: str) -> pl.DataFrame:
        table = self._tables[name]
        if callable(table):
            table = table()
            self._tables[name] = table
            # Release the arrays that the table was made from.
            self._arrays.pop(name, None)
        return table

    def arrays(self, name: str) -> TableArrays:
        """Return the columns of a table as arrays."""
        if name in self._arrays:
            return self._arrays[name]()
        return arrays_of(self._table(name))

    @cached_property
    def problem(self) -> Problem:
        """The cell of the run. The record names its traces and does not contain their data.

        Raises
        ------
        RunError
            If the record of the cell is missing or cannot be read.
        """
        return self._cell_with({})

    @cached_property
    def played(self) -> Scenario | None:
        """Disturbances applied to the run, from the first release on; None if unrecorded.

        If they are not recorded, the disturbances of the scenario apply.

        Raises
        ------
        RunError
            If the record of the disturbances or of the cell cannot be read.
        """
        return self._scenario("played")

    @cached_property
    def shared_disturbances(self) -> Scenario:
        """Disturbances of the nodes that a cell shares with its fleet.

        Raises
        ------
        RunError
            If the record of the disturbances or of the cell cannot be read.
        """
        return self._scenario("disturbances") or ()

    def _scenario(self, key: str) -> Scenario | None:
        told = self.meta.get(key)
        if not isinstance(told, list):
            return None
        items = [item for item in told if isinstance(item, Mapping)]
        within = [_from_the_start(item) for item in items if _end_s(item) > max(_at_s(item), 0.0)]
        return self._cell_with({"scenarios": {PLAYED: within}}).scenarios[PLAYED]

    @property
    def disturbances(self) -> Scenario:
        """Disturbances of nodes and links: as recorded, or else as in the scenario.

        Raises
        ------
        RunError
            If the record of the disturbances or of the cell cannot be read.
        """
        if self.played is not None:
            return self.played
        own = self.problem.scenarios.get(str(self.meta.get("scenario")), ())
        return tuple(dict.fromkeys((*own, *self.shared_disturbances)))

    def _cell_with(self, changes: Mapping[str, object]) -> Problem:
        from dwell.cellfile import from_record

        told = self.meta.get("problem")
        if not isinstance(told, Mapping):
            raise RunError("its record does not say which cell it ran")
        try:
            return from_record({**told, **changes})
        except ProblemError as error:
            why = "; ".join(str(error).splitlines())
            raise RunError(f"its record of the cell cannot be read: {why}") from None

    @property
    def cycles(self) -> pl.DataFrame:
        """One row per cycle: release, placement, latency and its parts, outcome."""
        return self._table("cycles")

    @property
    def last_window_end(self) -> int:
        """Number of rows of `cycles` up to the end of the last window, where statistics end."""
        (within,) = (~self.arrays("cycles")["lead"]).nonzero()
        return int(within[-1]) + 1 if len(within) else 0

    @property
    def windows(self) -> pl.DataFrame:
        """One row per window: its final metrics, and the metrics that the controller saw."""
        return self._table("windows")

    @property
    def decisions(self) -> pl.DataFrame:
        """One row per decision: incumbent, choice, reason, costs and estimates."""
        return self._table("decisions")

    @property
    def jobs(self) -> pl.DataFrame:
        """One row per job that became ready: task, node, instants, outcome.

        Raises
        ------
        RunError
            If the run recorded no jobs.
        """
        if "jobs" not in self._tables:
            how = "simulate with jobs=True (`dwell run --jobs`)"
            raise RunError(f"this run kept no jobs; {how}" if self.is_simulated else NO_JOBS)
        return self._table("jobs")

    @property
    def processes(self) -> pl.DataFrame:
        """CPU time used by the processes of a live cell: one row per window and process.

        Raises
        ------
        RunError
            If the run was simulated or recorded no processes.
        """
        if "processes" not in self._tables:
            raise RunError("this run kept no processes; `dwell controller --jobs` does")
        return self._table("processes")

    @property
    def has_processes(self) -> bool:
        """Whether the run recorded the CPU time of each process."""
        return "processes" in self._tables

    @property
    def run_id(self) -> str | None:
        """Id of a live run, as in its stamps; None for a simulated run."""
        if "run" not in self.cycles.columns or self.cycles.is_empty():
            return None
        return str(self.cycles["run"][0])

    @property
    def is_simulated(self) -> bool:
        """Whether the run was simulated; a live run was measured."""
        return str(self.meta.get("kind", "simulated")) == "simulated"

    @property
    def has_jobs(self) -> bool:
        """Whether the run recorded its jobs."""
        return "jobs" in self._tables

    @property
    def unfinished(self) -> bool:
        """Whether the run has only an open journal: it is running, or its controller was killed."""
        return not self.meta.get("recovered", {}).get("sealed", True)

    @property
    def losses(self) -> list[str]:
        """Sentences about data that the run lacks because of a kill or of damage."""
        recovered = self.meta.get("recovered", {})
        told = [
            text.format(recovered[name]) for name, text in LOSSES.items() if recovered.get(name)
        ]
        if (opened := recovered.get("opened", 1)) > 1:
            told.insert(0, f"The controller was started {opened} times while the run went on.")
        if self.unfinished:
            told.append(
                "The run was not closed: it goes on, or its controller was killed. This is what "
                "its journal holds; what came after its last window is not here."
            )
        return told

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the run's folder in one atomic step.

        Parameters
        ----------
        path : path-like
            Folder to make. An older run in it is replaced.

        Raises
        ------
        RunError
            If the folder holds something that is not a run, or cannot be written.
        """
        target = Path(path)
        require_free(target)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            draft = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        except OSError as error:
            raise RunError(f"{target.parent}: cannot be written ({error.strerror})") from None
        try:
            for name in self._tables:
                write_table(self._table(name), draft / f"{name}.parquet")
            text = json.dumps(self.meta, indent=2, allow_nan=False)
            (draft / "run.json").write_text(text + "\n", encoding="utf-8")
            draft.chmod(0o755)
            _replace(draft, target)
        except OSError as error:
            raise RunError(f"{target}: cannot be written ({error.strerror or error})") from None
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return target


def _at_s(item: Mapping[str, Any]) -> float:
    return float(item.get("at_s", 0.0))


def _end_s(item: Mapping[str, Any]) -> float:
    return _at_s(item) + float(item.get("for_s", math.inf))


def _from_the_start(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recorded disturbance without its part before the first release."""
    if _at_s(item) >= 0:
        return dict(item)
    shorter = {"for_s": _end_s(item)} if "for_s" in item else {}
    return {**item, "at_s": 0.0, **shorter}


def require_free(path: str | os.PathLike[str]) -> None:
    """Refuse a path unless it is free, an empty folder, or the folder of a finished run.

    Raises
    ------
    RunError
        If the path holds something else, such as the journal of a live run.
    """
    target = Path(path)
    if (target / JOURNAL).is_file() and not (target / "run.json").is_file():
        raise RunError(f"{target} holds a live run that has not been sealed; choose another folder")
    if target.exists() and not (target / "run.json").is_file():
        if target.is_dir() and not any(target.iterdir()):
            return
        raise RunError(f"{target} exists and is not a run; choose another folder")


def _replace(draft: Path, target: Path) -> None:
    """Rename a finished folder to its target; if that fails, restore the older run."""
    if target.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{target.name}-old-", dir=target.parent))
        kept = old / target.name
        try:
            target.replace(kept)
            draft.replace(target)
        except BaseException:
            if kept.exists():
                kept.replace(target)
            raise
        finally:
            shutil.rmtree(old, ignore_errors=True)
    else:
        draft.replace(target)


def is_run(path: str | os.PathLike[str]) -> bool:
    """Whether a folder holds a finished run or the journal of a live one."""
    return any((Path(path) / name).is_file() for name in ("run.json", JOURNAL))


def open_run(path: str | os.PathLike[str]) -> Run:
    """Open a run's folder; each table is read at the first access.

    If the folder has only a journal, because the run is still active or was killed, all data are
    read from the journal at once, and ``recovered`` in `Run.meta` counts the losses.

    Raises
    ------
    RunError
        If the folder is missing, is not a run, lacks a table, or has another version of the schema.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise RunError(f"{folder}: no such folder")
    file = folder / "run.json"
    if (folder / JOURNAL).is_file() and not file.is_file():
        meta, tables = read_journal(folder)
        missing = [name for name in ALWAYS if name not in tables]
        if missing:
            raise RunError(f"{folder / JOURNAL}: no run, without {', '.join(missing)}")
        return Run(meta, tables)
    if not file.exists():
        if (folder / FLEET).is_file():
            raise RunError(f"{folder} is a fleet's folder; name the run of a cell in it")
        raise RunError(f"{folder}: not a run (it has no run.json)")
    meta = read_document(file)
    require_version(meta, f"{file}: ")
    missing = [name for name in ALWAYS if not (folder / f"{name}.parquet").is_file()]
    if missing:
        raise RunError(f"{folder}: incomplete run, without {', '.join(missing)}")
    more = [name for name in ON_REQUEST if (folder / f"{name}.parquet").is_file()]
    names = [*ALWAYS, *more]
    run = Run(meta, {})
    run._tables |= {name: partial(_read_checked, run, name, folder) for name in names}
    return run


def _read_checked(run: Run, name: str, folder: Path) -> pl.DataFrame:
    """Read a table of a run and check its columns."""
    file = folder / f"{name}.parquet"
    table = read_table(file)()
    try:
        problem = run.problem
    except RunError:
        return table  # without the cell there is nothing to check; `Run.problem` raises
    require_table(name, problem, table, str(file))
    if name == "cycles" and run.is_simulated and len(windows := run.windows):
        last = int(str(windows["first_cycle"].max())) + problem.window_cycles
        if len(table) < last:
            raise RunError(f"{file}: has {len(table)} cycles; the windows have {last}")
    return table


def seal_run(path: str | os.PathLike[str], **meta: object) -> Run:
    """Convert a live run's journal to tables; a kill leaves the journal or the tables complete.

    Parameters
    ----------
    path : path-like
        The run's folder. If the run is sealed already, its tables stay unchanged.
    **meta : JSON-able
        Entries to add to `Run.meta`, also for a run that is sealed already.

    Raises
    ------
    RunError
        If a process is writing the journal, the journal cannot be read, or the tables cannot be
        written.
    """
    folder = Path(path)
    journal, file = folder / JOURNAL, folder / "run.json"
    sealed = file.is_file()
    if not sealed and Journal.written(folder):
        raise RunError(f"{journal}: the run is still going on; stop it first")
    if meta or not sealed:
        run = open_run(folder)
        told = {**run.meta, **meta}
        if not sealed:
            told["recovered"] = {**run.meta.get("recovered", {}), "sealed": True}
        text = json.dumps(told, indent=2) + "\n"
        try:
            for name in () if sealed else run._tables:
                table = partial(write_table, run._table(name))
                write_whole(folder / f"{name}.parquet", table)
            # With this file the folder is a finished run.
            write_whole(file, text)
        except OSError as error:
            raise RunError(f"{folder}: cannot be written ({error.strerror or error})") from None
    # Remove the drafts of a process that was killed while it sealed the run.
    for draft in folder.glob(".*.draft"):
        draft.unlink(missing_ok=True)
    journal.unlink(missing_ok=True)
    return open_run(folder)


def write_table(table: pl.DataFrame, file: Path) -> None:
    """Write a table; raise OSError if Polars reports an error, such as a full disk."""
    import polars as pl

    try:
        table.write_parquet(file)
    except pl.exceptions.PolarsError as error:
        raise OSError(str(error)) from None


def read_table(file: Path, remedy: str = "") -> Callable[[], pl.DataFrame]:
    """Return the function that reads a table; `remedy` ends its error message."""

    def read() -> pl.DataFrame:
        import polars as pl

        try:
            return pl.read_parquet(file, glob=False)
        except (OSError, pl.exceptions.PolarsError) as error:
            raise RunError(f"{file}: cannot be read ({error}){remedy}") from None

    return read
