"""`dwell live run`: runs a cell on this machine under a scenario, and reports the results."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import typer

import dwell
from dwell.cli.check import class_faults
from dwell.cli.output import mark_of_run, print_json, working, write_file
from dwell.errors import ExitCode, LiveError, ProblemError, installing, lacking
from dwell.live.commands.live_view import CellState, Lines
from dwell.live.host.stage_modules import require_stages
from dwell.live.local.cell_observer import CellObserver, load_observer
from dwell.live.local.loopback import Loopback, on_this_machine
from dwell.live.local.playing import (
    LOOK_S,
    Played,
    begun,
    crowded,
    interruptible,
    longest_journal,
    longest_run,
    make_folder,
    play_on,
)
from dwell.live.local.timeline import timeline_of
from dwell.live.wire.wiring import require_candidates
from dwell.model import Problem
from dwell.model.bounds import counted
from dwell.model.disturbed import Disturbed, disturbed
from dwell.record import Run, moves_in, open_run, seal_run
from dwell.record.journal import note_in_journal, read_plain_journal
from dwell.report import run_html
from dwell.report.palette import Palette
from dwell.report.phases import PhaseRow, phase_rows, phase_table
from dwell.report.run_header import RunHeader
from dwell.report.table import table_text
from dwell.study.metric import METRICS

#: File that marks the folder of a live run, which the next run may replace.
MARK = ".dwell-live-run"
#: Longest time before all processes are ready that belongs to the run.
MOST_BEFORE_S = 4.0
#: Length of a run without disturbances, and time after the last change of a scenario.
USUAL_S, AFTER_S = 60.0, 16.0


def run_live(
    file: Path,
    *,
    scenario: str | None,
    seconds: float | None,
    policy: str | None,
    estimator: str | None,
    seed: int,
    out: Path | None,
    as_json: bool,
) -> None:
    """Run the cell, save the run, write its report, print a summary (see `dwell live run`).

    An interrupt ends the cell and reports the run so far. Raises a DwellError if a task has no
    stage, a process does not start, or the folder has other content.
    """
    problem = dwell.load(file)
    require_candidates(problem)
    if policy is not None or estimator is not None:
        names = (policy or problem.controller.policy, estimator)
        problem = problem.under("+".join(name for name in names if name is not None))
    if scenario is None:
        disturbing = (name for name, items in problem.scenarios.items() if items)
        scenario = next(disturbing, next(iter(problem.scenarios)))
    ends_s = [item.end_s for item in problem.scenario(scenario) if math.isfinite(item.end_s)]
    seconds = seconds or max(ends_s, default=USUAL_S - AFTER_S) + AFTER_S
    timeline = timeline_of(problem, scenario, seed=seed, seconds=seconds)
    if faults := tuple(class_faults(problem)):
        raise ProblemError(faults)
    require_stages(problem, file, problem.fabric.nodes)
    out = out or Path("live-out", problem.name)
    reported, told = _announce_left_out()
    if (out / MARK).is_file():
        typer.echo(f"note: the earlier run in {out}, and its report, are replaced", err=True)
    make_folder(out, MARK, "a live run's")
    problem = on_this_machine(problem)
    played = ObservedRun(problem, scenario, seed, timeline)
    interrupted = False
    cell = Loopback(problem, out.resolve(), _cpus(problem), seed=seed)
    with interruptible():
        try:
            _watch_from_start(cell, seconds, played)
        except KeyboardInterrupt:
            interrupted = True
            typer.echo("interrupted; ending the cell", err=True)
        finally:
            with working("ending the cell"):
                cell.stop()
    folder = longest_run(out / "runs") if told else longest_journal(out / "runs")
    if folder is None and interrupted:
        raise typer.Exit(ExitCode.INTERRUPTED)
    if folder is None:
        raise LiveError(f"{out}: the controller has written no run; see {out}/controller*.log")
    if told:
        run = played.note(folder, **played.observed(begun(open_run(folder))))
        outcome = _told(seal_run(folder, warnings=crowded(run, problem)), out, reported=reported)
    else:
        outcome = _counted(played, folder)
    _print(outcome, folder, problem.candidates, interrupted=interrupted, as_json=as_json)
    if interrupted:
        raise typer.Exit(ExitCode.INTERRUPTED)


def _announce_left_out() -> tuple[bool, bool]:
    """Print which results will be missing because of missing packages.

    Returns whether the run will have a report, and whether it will have tables.
    """
    packages = lacking("sim", "report")
    if not packages:
        return True, True
    tables = "Polars" not in packages
    left_out = "no report" if tables else "no report, and no tables: the run stays a journal"
    typer.echo(f"note: there will be {left_out}, for {packages}", err=True)
    return False, tables


@dataclass(slots=True)
class ObservedRun(Played):
    """Record of the applied changes and the observer, which the controller does not know."""

    observer: CellObserver | None = None

    def on(self) -> list[Disturbed]:
        """Return the active disturbances for the printed lines."""
        return disturbed(self.active(), self.problem.fabric)

    def observed(self, span: tuple[int, int] | None) -> dict[str, Any]:
        """Return the observer's notes about a run with this first and last release."""
        if self.observer is None or span is None:
            return {}
        return dict(self.observer.told(span[0]))

    def look(self) -> Mapping[str, float]:
        """Return the present values of the cell's observer."""
        return {} if self.observer is None else self.observer.look(time.monotonic_ns())


def _cpus(problem: Problem) -> dict[str, int]:
    """Return the CPU of each node: the first for robots, the last for other nodes."""
    there = sorted(os.sched_getaffinity(0))
    if len(there) < 2:
        typer.echo("note: there is one CPU only; robots and edge share it", err=True)
    return {
        name: there[0] if node.tier == "robot" else there[-1]
        for name, node in problem.fabric.nodes.items()
    }


def _watch_from_start(cell: Loopback, seconds: float, played: ObservedRun) -> None:
    """Start the cell, load its observer, and apply the scenario."""
    with working("starting the cell"):
        cell.start()
    earliest_ns = time.monotonic_ns() - round(MOST_BEFORE_S * 1e9)
    cell.begun_ns = max(cell.begun_ns, earliest_ns)
    name = cell.problem.live.observer
    if name is not None:
        played.observer = load_observer(name, cell.problem, cell.folder, cell.begun_ns)
    try:
        _watch(cell, seconds, played)
    finally:
        if played.observer is not None:
            played.look()
            played.observer.close()


def _watch(cell: Loopback, seconds: float, played: ObservedRun) -> None:
    """Apply the changes at their times, and print the state of the cell."""
    status: Mapping[str, Any] = {}
    answered_s, lines = 0.0, Lines()

    def show(at_s: float) -> None:
        nonlocal status, answered_s
        try:
            status = cell.sample(LOOK_S)
            answered_s = (time.monotonic_ns() - cell.begun_ns) / 1e9
        except LiveError:
            pass  # the next line shows that the controller is silent
        lines.show(CellState(at_s, status, answered_s, played.look(), played.on()))

    play_on(cell, played, seconds, show)


class _Table(Protocol):
    """Columns of a run's table, in Polars or in plain lists."""

    def __getitem__(self, column: str, /) -> Sequence[Any] | Any: ...


@dataclass(frozen=True, slots=True)
class _Outcome:
    """Printed results of a run; without tables, `phases` and `report` are empty."""

    meta: Mapping[str, Any]
    cycles: int
    missed: float
    lost: int
    migrations: int
    guard_moves: int
    phases: Sequence[PhaseRow] = ()
    report: Path | None = None
    instead: str = ""

    @classmethod
    def of(cls, meta: Mapping[str, Any], cycles: _Table, decisions: _Table) -> _Outcome:
        """Count missed deadlines, lost cycles and moves."""
        missed, moved = list(cycles["missed"]), moves_in(decisions)
        guard_moves = sum(move.by_guard for move in moved)
        return cls(
            meta,
            cycles=len(missed),
            missed=sum(map(bool, missed)) / len(missed) if missed else math.nan,
            lost=sum(latency is None for latency in cycles["latency_ns"]),
            migrations=len(moved) - guard_moves,
            guard_moves=guard_moves,
        )


def _told(run: Run, out: Path, *, reported: bool) -> _Outcome:
    """Return the results of a run from its tables, and write its report."""
    outcome = _Outcome.of(run.meta, run.cycles, run.decisions)
    phases = phase_rows(run, RunHeader.of(run))
    page = out / "report.html"
    # A run that ended during its warm-up gets no report.
    if run.windows.filter(~run.windows["warmup"]).is_empty():
        return replace(outcome, phases=phases, instead="no report: it ended within its warm-up")
    if not reported:
        return replace(outcome, phases=phases, instead=f"no report; {installing('report')}")
    write_file(page, run_html(run) + mark_of_run(run))
    return replace(outcome, phases=phases, report=page)


def _counted(played: ObservedRun, folder: Path) -> _Outcome:
    """Return the results of a run from its journal, and record the scenario in it."""
    meta, tables = read_plain_journal(folder)
    releases, span = tables["cycles"]["release_ns"], None
    if releases and "origin_ns" in meta:
        span = meta["origin_ns"], meta["origin_ns"] + releases[-1]
    notes = {**played.notes(span), **played.observed(span)}
    note_in_journal(folder, **notes)
    outcome = _Outcome.of({**meta, **notes}, tables["cycles"], tables["decisions"])
    instead = f"no report; {installing('report')}, then: dwell report {folder}"
    return replace(outcome, instead=instead)


def _print(
    outcome: _Outcome,
    folder: Path,
    candidates: Iterable[str],
    *,
    interrupted: bool,
    as_json: bool,
) -> None:
    warnings = outcome.meta.get("warnings", [])
    if as_json:
        print_json(
            {
                "cell": outcome.meta["cell"],
                "scenario": outcome.meta["scenario"],
                "seed": outcome.meta["seed"],
                "interrupted": interrupted,
                "cycles": outcome.cycles,
                "violation_rate": outcome.missed,
                "lost": outcome.lost,
                "migrations": outcome.migrations,
                "guard_moves": outcome.guard_moves,
                "warnings": warnings,
                "phases": [row._asdict() for row in outcome.phases],
                "run": folder,
                "report": outcome.report,
            }
        )
        return
    missed = METRICS["violation_rate"].text(outcome.missed)
    share = f"{missed} missed, " if outcome.cycles else ""
    typer.echo(
        f"{counted(outcome.cycles, 'cycle')} with the warm-up, {share}{outcome.lost} without a "
        "command; "
        f"{counted(outcome.migrations, 'migration')} by the controller, "
        f"{outcome.guard_moves} by the guard\n"
    )
    if outcome.phases:
        typer.echo(table_text(phase_table(outcome.phases, Palette.of(candidates))))
    for warning in warnings:
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(f"run: {folder}")
    typer.echo(f"report: {outcome.report}" if outcome.report else outcome.instead)
