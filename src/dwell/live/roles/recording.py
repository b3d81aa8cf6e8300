"""Recording: the folder of a live run, written while it goes on."""

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

#: Rows that wait in memory while the folder cannot be written, some 25 MB; of more, those of the
#: oldest windows are dropped.
MOST_WAITING = 50_000
#: Folders that are tried for one run, of which others may be in use.
MOST_FOLDERS = 100


class RunRecorder:
    """Keeps the rows of a cell's runs, one folder a run id.

    A folder that cannot be written costs no decision: rows wait in memory, and are written when it
    can be; that is tried whenever there are new ones, which is once a window.

    Parameters
    ----------
    jobs : bool
        Whether to keep the jobs, and what each process took of the CPUs, too.
    continues : str
        Name of the folder of the run before, which had other settings; empty for none.

    Attributes
    ----------
    folder : Path or None
        Folder of the run that is kept; None until it could be made.
    trouble : str
        Why it cannot be written; empty where it can.
    waiting, dropped : int
        Rows that wait, and that found no room any more.
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
        """Begin to keep a run, or go on with it; returns where."""
        self.finish()
        self._run = run
        self._journal = journal = self._opened(run)
        if journal is None:
            return Resume(jobs=self.jobs)
        window, cycle = journal.following("windows"), journal.following("cycles")
        return Resume(window, cycle, journal.meta.get("origin_ns"), self.jobs)

    def _opened(self, run: int, *, new: bool = False) -> Journal | None:
        """Open a run's journal; None where it cannot be written.

        In a further folder where a controller before has sealed it, or another one writes it, or it
        is of another cell file; also where it has rows, and has to be new.
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
        """Keep rows; a disk that is full costs at most the rows, and not the control."""
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
        """Write what waits, as far as it can be written."""
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
        """Have the log say once that a folder cannot be written."""
        if self.trouble != str(error):
            self._say(
                f"error: {error}; decisions go on, and the run's last {self._most} rows wait for it"
            )
        self.trouble = str(error)

    def finish(self, rows: Rows | None = None) -> Path | None:
        """Write the tables of the run; returns its folder, None where there was none."""
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
