"""`dwell live demo`: the cell on this machine, its scenario, and what came of it."""

from __future__ import annotations

import importlib.resources
import math
import os
import shutil
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import typer

import dwell
from dwell.cli.live_view import Look, View, live_view
from dwell.cli.output import aligned, print_json, working, write_file
from dwell.demo.error_sampler import ErrorSampler
from dwell.demo.stageplay import Change, Stageplay, changes_of, on_this_machine
from dwell.demo.world import World
from dwell.errors import DwellError, LiveError
from dwell.live.visiting import Visitor
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.record import Run, open_run, seal_run
from dwell.report import run_html
from dwell.report.facts import Facts
from dwell.report.phase_rows import PhaseRow, phase_rows
from dwell.report.phases import Disturbed, disturbed
from dwell.report.wording import listed, percent, write_number

__all__ = ["play"]

#: A folder with this file is a demo's, and may be replaced by the next.
MARK = ".dwell-live-demo"
LOOK_S = 0.5
START_S = 30.0
#: What the cell did before everybody was there belongs to the run, up to so many seconds of it.
MOST_BEFORE_S = 4.0
#: The arm comes from its home, and first has to get to the tag.
SETTLED_S = 3.0
INTERRUPTED = 130


def play(
    out: Path,
    scenario: str,
    seconds: float,
    policy: str | None,
    seed: int,
    *,
    as_json: bool,
) -> None:
    """Run the demo, save the run, write its report, print what happened.

    Interrupted, it ends everything and reports on what there is.

    Raises
    ------
    DwellError
        If the cell does not come up, or the folder holds something else.
    """
    with importlib.resources.as_file(importlib.resources.files("dwell.demo") / "cell.yaml") as file:
        problem = dwell.load(file)
    if policy is not None:
        problem = replace(problem, controller=replace(problem.controller, policy=policy))
    changes = changes_of(problem, scenario)
    _make(out)
    problem = on_this_machine(problem)
    told = _Told(problem, scenario, seed)
    interrupted = False
    with _interruptible(), Stageplay(problem, out.resolve(), _cpus(problem), seed=seed) as cell:
        try:
            _watch_from_start(cell, changes, seconds, told)
        except KeyboardInterrupt:
            interrupted = True
            typer.echo("interrupted; ending the cell", err=True)
        with working("ending the cell"):
            cell.stop_controller()
            cell.close()
    folder = _run_folder(out)
    if folder is None and interrupted:
        raise typer.Exit(INTERRUPTED)
    if folder is None:
        raise LiveError(f"{out}: the controller has written no run; see {out}/controller*.log")
    run = told.note(folder)
    _sum_up(run, folder, out, interrupted=interrupted, as_json=as_json)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Have whoever ends this process, or closes its terminal, interrupt it as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(slots=True)
class _Told:
    """What the demo knows of a run, and its controller does not.

    Instants are of the machine's monotonic clock, which the nodes of the demo have, too.
    """

    problem: Problem
    scenario: str
    seed: int
    begun_ns: dict[int, int] = field(default_factory=dict)
    ended_ns: dict[int, int] = field(default_factory=dict)
    sampler: ErrorSampler | None = None

    def changed(self, change: Change) -> None:
        """Note that a change has been made."""
        instants = self.begun_ns if change.begins else self.ended_ns
        instants[id(change.item)] = time.monotonic_ns()

    def items(self) -> list[tuple[object, Mapping[str, Any]]]:
        """Return the scenario's items, each as the cell file has it."""
        written = to_document(self.problem)["scenarios"].get(self.scenario, [])
        return list(zip(self.problem.scenario(self.scenario), written, strict=True))

    def plan(self) -> list[Disturbed]:
        """Return what is to be played."""
        return self._disturbed([written for _, written in self.items()])

    def active(self) -> list[Disturbed]:
        """Return what is on now."""
        on = self.begun_ns.keys() - self.ended_ns.keys()
        return self._disturbed([written for item, written in self.items() if id(item) in on])

    def _disturbed(self, items: Sequence[Mapping[str, Any]]) -> list[Disturbed]:
        tiers = {name: node.tier for name, node in self.problem.fabric.nodes.items()}
        return disturbed(items, tiers)

    def note(self, folder: Path) -> Run:
        """Add it to the run, whose time begins with the first release."""
        run = open_run(folder)
        origin_ns, cycles = run.meta.get("origin_ns"), run.cycles
        notes: dict[str, object] = {"scenario": self.scenario, "seed": self.seed}
        if isinstance(origin_ns, int) and not cycles.is_empty():
            end_ns = origin_ns + int(cycles["release_ns"][-1])
            notes["played"] = [
                {
                    **written,
                    "at_s": round((begun_ns - origin_ns) / 1e9, 3),
                    "for_s": round((self.ended_ns.get(id(item), end_ns) - begun_ns) / 1e9, 3),
                }
                for item, written in self.items()
                if (begun_ns := self.begun_ns.get(id(item))) is not None
            ]
            if self.sampler is not None:
                notes["tracking"] = self.sampler.told(origin_ns)
        return seal_run(folder, **notes)


def _make(out: Path) -> None:
    if (out / MARK).is_file():
        shutil.rmtree(out)
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise LiveError(f"{out} exists and is not a demo's; choose another folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    (out / MARK).touch()


def _cpus(problem: Problem) -> dict[str, int]:
    """Give the robots one CPU, and the edge another where there is one."""
    there = sorted(os.sched_getaffinity(0))
    if len(there) < 2:
        typer.echo("note: there is one CPU only; robots and edge share it", err=True)
    return {
        name: there[0] if node.tier == "robot" else there[-1]
        for name, node in problem.fabric.nodes.items()
    }


def _come_up(visitor: Visitor, cell: Stageplay) -> None:
    """Wait until everybody is there."""
    until = time.monotonic() + START_S
    awaited = {who for node in cell.problem.fabric.nodes for who in cell.expected(node)}
    missing: Mapping[str, str] = {"the controller": "has not answered"}
    while missing:
        if time.monotonic() > until:
            found = "; ".join(f"{who} {why}" for who, why in sorted(missing.items()))
            raise LiveError(
                f"after {START_S:.0f} s the cell is not complete: {found}; see the logs in "
                f"{cell.folder}"
            )
        try:
            heard = visitor.ask("status", patience_s=1.0)["processes"]
        except LiveError:
            continue
        missing = {
            who: heard[who]["note"] or "is not ready" if who in heard else "has not been heard"
            for who in awaited
            if who not in heard or not heard[who]["ready"]
        }
        time.sleep(0.1)


def _watch_from_start(
    cell: Stageplay, changes: Sequence[Change], seconds: float, told: _Told
) -> None:
    """Wait until everybody is there, and play the scenario."""
    with Visitor(cell.problem) as visitor:
        with working("starting the cell"):
            _come_up(visitor, cell)
        now_ns = time.monotonic_ns()
        origin_ns = visitor.ask("status").get("origin_ns") or now_ns
        begin_ns = max(int(origin_ns), now_ns - round(MOST_BEFORE_S * 1e9))
        world = World.open(cell.world, now_ns)
        told.sampler = ErrorSampler(world, begin_ns + round(SETTLED_S * 1e9))
        try:
            with live_view(cell.problem, seconds, told.plan()) as view:
                _watch(visitor, cell, changes, begin_ns, seconds, told, view)
        finally:
            told.sampler.sample(time.monotonic_ns())
            world.close()


def _watch(
    visitor: Visitor,
    cell: Stageplay,
    changes: Sequence[Change],
    begin_ns: int,
    seconds: float,
    told: _Told,
    view: View,
) -> None:
    """Play the changes at their times, and show how the cell is."""
    waiting = list(changes)
    status: Mapping[str, Any] = {}
    answered_s = 0.0
    while (at_s := (time.monotonic_ns() - begin_ns) / 1e9) < seconds:
        while waiting and waiting[0].at_s <= at_s:
            change = waiting.pop(0)
            cell.apply(change)
            told.changed(change)
        try:
            status = visitor.ask("status", patience_s=LOOK_S)
            answered_s = (time.monotonic_ns() - begin_ns) / 1e9
        except LiveError:
            pass  # the view shows for how long nobody has answered
        error = math.nan, math.nan
        if told.sampler is not None:
            told.sampler.sample(time.monotonic_ns())
            error = told.sampler.newest()
        view.show(Look(at_s, status, answered_s, *error, told.active()))
        # Looks do not drift, and what begins or ends in between does so in time.
        following_s = (math.floor(at_s / LOOK_S) + 1) * LOOK_S
        if waiting:
            following_s = min(following_s, waiting[0].at_s)
        time.sleep(max(following_s - (time.monotonic_ns() - begin_ns) / 1e9, 0.0))


def _run_folder(out: Path) -> Path | None:
    """Return the longest of the runs that were written; None where there is none."""
    found: list[tuple[int, Path]] = []
    runs = out / "runs"
    for folder in sorted(runs.iterdir()) if runs.is_dir() else ():
        try:
            found.append((int(open_run(folder).meta.get("windows", 0)), folder))
        except DwellError:
            continue
    return max(found)[1] if found else None


def _sum_up(run: Run, folder: Path, out: Path, *, interrupted: bool, as_json: bool) -> None:
    """Write the report, and print what the run was."""
    cycles, decisions = run.cycles, run.decisions
    guard = decisions.filter((decisions["reason"].cast(str) == "guard") & decisions["migrated"])
    missed = cycles["missed"].to_numpy()
    phases = phase_rows(run, Facts.of(run))
    page = out / "report.html"
    report: Path | None = page
    # A run that ended within its warm-up has nothing to report on.
    if run.windows.filter(~run.windows["warmup"]).is_empty():
        report = None
    else:
        write_file(page, run_html(run))
    rate = float(missed.mean()) if len(missed) else math.nan
    lost = int(cycles["latency_ns"].is_null().sum())
    migrations = int(decisions["migrated"].sum()) - len(guard)
    if as_json:
        print_json(
            {
                "cell": run.meta["cell"],
                "scenario": run.meta["scenario"],
                "seed": run.meta["seed"],
                "interrupted": interrupted,
                "cycles": len(cycles),
                "violation_rate": rate,
                "lost": lost,
                "migrations": migrations,
                "guard_moves": len(guard),
                "phases": [row._asdict() for row in phases],
                "run": folder,
                "report": report,
            }
        )
        return
    typer.echo(
        f"{len(cycles)} cycles, {100 * rate:.1f} % missed, {lost} without a command; "
        f"{migrations} migrations by the controller, {len(guard)} by the guard\n"
    )
    if phases:
        typer.echo(f"{_table(phases)}\n")
    typer.echo(f"run: {folder}")
    typer.echo(f"report: {report}" if report else "no report: the run ended within its warm-up")


def _table(phases: Sequence[PhaseRow]) -> str:
    head = ("phase", "from", "to", "V_D", "L95", "lost", "moves", "guard", "error", "", "placed")
    rows = [
        (
            row.name,
            f"{row.begin_s:.0f} s",
            f"{row.end_s:.0f} s",
            f"{100 * row.violation_rate:.1f} %",
            f"{write_number(row.l95_ms)} ms",
            str(row.lost),
            str(row.migrations),
            str(row.guard_moves),
            _known(row.rms_mm, "mm", 2),
            _known(row.rms_px, "px", 1),
            listed(f"{name} {percent(share)}" for name, share in row.shares.items()),
        )
        for row in phases
    ]
    return aligned(head, rows)


def _known(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}" if math.isfinite(value) else "-"
