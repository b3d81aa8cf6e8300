"""Runs of the small cell, and of a fleet of them, in folders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import dwell
from dwell.model import Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun, Journal, Run, column_types
from tests.cells.once import once
from tests.cli.small_cell import SMALL


def small_run(
    folder: Path, *, policy: str = "dtp", seed: int = 1, windows: int = 60, jobs: bool = True
) -> Run:
    """Simulate the small cell under stress, and save the run."""
    folder.parent.mkdir(exist_ok=True)
    file = folder.parent / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    problem = deciding_once(dwell.load(file))
    run = dwell.simulate(
        problem, scenario="stress", policy=policy, seed=seed, windows=windows, jobs=jobs
    )
    run.save(folder)
    return run


def small_fleet(folder: Path, *, cells: int = 3, windows: int = 40, jobs: bool = True) -> FleetRun:
    """Simulate a fleet of small cells under stress, and save its runs."""
    folder.parent.mkdir(exist_ok=True)
    file = folder.parent / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    problem = deciding_once(dwell.load(file))
    entries = (FleetEntry(problem, cells - 1, scenario="stress"), FleetEntry(problem))
    fleet = Fleet("pack", entries, ("E",), phases="even")
    run = dwell.simulate_fleet(fleet, seed=1, windows=windows, jobs=jobs)
    run.save(folder)
    return run


def deciding_once(problem: Problem) -> Problem:
    return replace(problem, controller=once(problem.controller, problem.window_cycles))


class WrittenRun:
    """A run that is being written: the rows of another one, in a journal, as far as it has come."""

    def __init__(self, folder: Path, run: Run) -> None:
        self._run, self._upto = run, 0
        columns = {name: column_types(name, run.problem, []) for name in TABLES}
        self._journal = Journal(folder, run="1", meta=run.meta, columns=columns)

    def go_on(self, windows: int) -> None:
        """Write some windows more, with their cycles and decisions."""
        begin, self._upto = self._upto, self._upto + windows
        size = self._run.problem.window_cycles
        cycles = self._run.cycles.slice(begin * size, windows * size)
        tables = {name: getattr(self._run, name) for name in TABLES[1:]}
        rows = {
            name: table.filter(table["window"].is_between(begin, self._upto - 1)).rows()
            for name, table in tables.items()
        }
        self._journal.append({"cycles": cycles.rows(), **rows})

    def close(self) -> None:
        """End, without tables."""
        self._journal.close()


TABLES = ("cycles", "windows", "decisions")
