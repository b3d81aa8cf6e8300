"""Recording: the folder of a live run, written during the run."""

from __future__ import annotations

import importlib.metadata
import platform
from collections import deque
from collections.abc import Callable
from pathlib import Path

from dwell.control import Controller
from dwell.errors import RunError, UnwritableError, installing
from dwell.live.roles.run_rows import Resume, Rows, columns_of
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.record import seal_run
from dwell.record.journal import Journal
from dwell.version import __version__

#: Largest number of rows that wait in memory until the folder can be written, about 25 MB; then
#: the oldest are dropped.
MOST_WAITING = 50_000
#: Largest number of folders to try for one run, as some may be in use.
MOST_FOLDERS = 100


class RunRecorder:
    """Records the rows of a cell's runs, with one folder per run id.

    A folder that cannot be written does not affect decisions: rows wait in memory, and every
    `append` tries to write them.

    Parameters
    ----------
    jobs : bool
        Whether to record jobs and the CPU time of processes too.
    continues : str
        Folder name of the previous run, which had other settings; empty if none.

    Attributes
    ----------
    folder : Path or None
        Folder of the current run; None until it is created.
    trouble : str
        Reason that the folder cannot be written; empty if it can.
    waiting, dropped : int
        Number of rows that wait, and of rows dropped because too many waited.
    """

    def __init__(
        self,
        out: Path,
        problem: Problem,
        controller: Controller,
        say: Callable[[str], None],
        *,
        jobs: bool = False,
        continues: str = "",
        most_waiting: int = MOST_WAITING,
    ) -> None:
        self.out, self.problem, self.controller, self.jobs = out, problem, controller, jobs
        self._say, self._most = say, most_waiting
        self._continues = {"continues": continues} if continues else {}
        self._run: int | None = None
        self._journal: Journal | None = None
        self._rows: deque[tuple[Rows, dict[str, object]]] = deque()
        self.waiting = self.dropped = 0
        self.trouble = ""

    @property
    def folder(self) -> Path | None:
        """See the class."""
        return None if self._journal is None else self._journal.folder

    def open(self, run: int) -> Resume:
        """Start or continue the record of a run; return its next window and cycle."""
        self.finish()
        self._run = run
        self._journal = journal = self._opened(run)
        if journal is None:
            return Resume(jobs=self.jobs)
        window, cycle = journal.following("windows"), journal.following("cycles")
        return Resume(window, cycle, journal.meta.get("origin_ns"), self.jobs)

    def _opened(self, run: int, *, new: bool = False) -> Journal | None:
        """Open a run's journal; return None if no folder can be written.

        It skips folders that are sealed, in use by another controller, from another cell file, or,
        with `new`, not empty.
        """
        columns = columns_of(self.controller, jobs=self.jobs)
        for count in range(1, MOST_FOLDERS + 1):
            suffix = f"-{count}" if count > 1 else ""
            folder = self.out / f"{self.problem.name}-{run}{suffix}"
            if (folder / "run.json").exists():
                continue
            try:
                journal = Journal(folder, run=str(run), meta=self._meta(), columns=columns)
            except UnwritableError as error:
                self._complain(error)
                return None
            except RunError as error:
                self._say(f"error: {error}; the run goes to another folder")
                continue
            if new and journal.following("cycles"):
                journal.close()
                continue
            self._say(f"{self.problem.name}: the run is kept in {folder}")
            return journal
        self._complain(RunError(f"{folder}: and {MOST_FOLDERS - 1} folders before it are taken"))
        return None

    def append(self, rows: Rows, **meta: object) -> None:
        """Record rows; if the disk is full, rows may be lost, but control continues."""
        if self._run is None:
            return
        self._rows.append((rows, meta))
        self.waiting += _count(rows)
        self._write()
        while self.waiting > self._most:
            count = _count(self._rows.popleft()[0])
            self.waiting -= count
            self.dropped += count

    def _write(self) -> None:
        """Write the waiting rows until a write fails."""
        if self._journal is None and self._run is not None:
            self._journal = self._opened(self._run, new=True)
        if self._journal is None:
            return
        while self._rows:
            rows, meta = self._rows[0]
            try:
                self._journal.append(rows, **meta)
            except UnwritableError as error:
                self._complain(error)
                return
            except RunError as error:
                self._say(f"error: {error}")
            self._rows.popleft()
            self.waiting -= _count(rows)
        if self.trouble:
            lost = f"; {self.dropped} rows found no room, and are missing" if self.dropped else ""
            self._say(f"{self._journal.folder}: can be written again{lost}")
            self.trouble, self.dropped = "", 0

    def _complain(self, error: RunError) -> None:
        """Log once that a folder cannot be written."""
        if self.trouble != str(error):
            self._say(
                f"error: {error}; decisions go on, and the run's last {self._most} rows wait for it"
            )
        self.trouble = str(error)

    def finish(self, rows: Rows | None = None) -> Path | None:
        """Write the tables of the run; return its folder, or None if no run is open."""
        if rows is not None:
            self.append(rows)
        if self._rows:
            self._say(f"error: {self.trouble}; {self.waiting + self.dropped} rows are lost")
        self._rows.clear()
        journal, self._journal, self._run = self._journal, None, None
        self.waiting, self.dropped, self.trouble = 0, 0, ""
        if journal is None:
            return None
        journal.close()
        try:
            seal_run(journal.folder)
        except RunError as error:
            self._say(f"error: {error}; what there is stays in its journal")
        except ModuleNotFoundError as error:
            if error.name != "polars":
                raise
            self._say(
                f"{journal.folder}: stays a journal, for Polars is not installed here; with "
                f"{installing('sim')}, this writes its tables: python -c "
                '"import sys; from dwell.record import seal_run; seal_run(sys.argv[1])" FOLDER'
            )
        return journal.folder

    def _meta(self) -> dict[str, object]:
        packages = ("numpy", "eclipse-zenoh")
        return {
            "kind": "live",
            "cell": self.problem.name,
            "scenario": "live",
            **self.controller.described(),
            **self._continues,
            "problem": to_document(self.controller.problem),
            "versions": {
                "dwell": __version__,
                **{name: importlib.metadata.version(name) for name in packages},
                "python": platform.python_version(),
            },
        }


def _count(rows: Rows) -> int:
    return sum(map(len, rows.values()))
