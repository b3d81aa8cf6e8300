"""Recording: the folder of a live run, written while it goes on."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Callable
from pathlib import Path

from dwell.control import Controller
from dwell.errors import RunError
from dwell.live.tables import columns_of, job_columns
from dwell.live.windows import Resume, Rows
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.record import seal_run
from dwell.record.journal import Journal

__all__ = ["RunRecorder"]


class RunRecorder:
    """Keeps the rows of a cell's runs, one folder a run id.

    Parameters
    ----------
    out : Path
        Folder of folders.
    problem : Problem
    controller : Controller
    say : callable
        Takes lines for the log.
    jobs : bool
        Whether to keep the jobs, and what each process took of the CPUs, too.
    """

    def __init__(
        self,
        out: Path,
        problem: Problem,
        controller: Controller,
        say: Callable[[str], None],
        *,
        jobs: bool = False,
    ) -> None:
        self.out, self.problem, self.controller, self.jobs = out, problem, controller, jobs
        self._say = say
        self._journal: Journal | None = None

    def open(self, run: int) -> Resume:
        """Begin to keep a run, or go on with it; returns where."""
        self.finish()
        folder = self._free(f"{self.problem.name}-{run}")
        more = job_columns(self.problem) if self.jobs else {}
        columns = {**columns_of(self.controller), **more}
        journal = Journal(folder, run=str(run), meta=self._meta(), columns=columns)
        self._journal = journal
        self._say(f"{self.problem.name}: the run is kept in {folder}")
        window, cycle = journal.following("windows"), journal.following("cycles")
        return Resume(window, cycle, journal.meta.get("origin_ns"), self.jobs)

    def _free(self, name: str) -> Path:
        """Return the run's folder; a further one where a controller before has sealed it."""
        folder, count = self.out / name, 1
        while (folder / "run.json").exists():
            count += 1
            folder = self.out / f"{name}-{count}"
        return folder

    def append(self, rows: Rows, **meta: object) -> None:
        """Keep rows; a disk that is full costs the rows and not the control."""
        if self._journal is None:
            return
        try:
            self._journal.append(rows, **meta)
        except RunError as error:
            self._say(f"error: {error}")

    def finish(self, rows: Rows | None = None) -> Path | None:
        """Write the tables of the run; returns its folder, None where there was none."""
        journal, self._journal = self._journal, None
        if journal is None:
            return None
        try:
            if rows is not None:
                journal.append(rows)
            journal.close()
            seal_run(journal.folder)
        except RunError as error:
            self._say(f"error: {error}")
        return journal.folder

    def _meta(self) -> dict[str, object]:
        packages = ("dwell", "numpy", "eclipse-zenoh")
        return {
            "kind": "live",
            "cell": self.problem.name,
            "scenario": "live",
            **self.controller.described(),
            "problem": to_document(self.problem),
            "versions": {
                **{name: importlib.metadata.version(name) for name in packages},
                "python": platform.python_version(),
            },
        }
