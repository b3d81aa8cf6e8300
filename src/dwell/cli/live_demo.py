"""`dwell live demo`: the cell on this machine, its scenario, and a live view."""

from __future__ import annotations

import importlib.resources
import math
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import typer

import dwell
from dwell.cli.output import print_json
from dwell.demo.stageplay import Change, Stageplay, changes_of, on_this_machine
from dwell.errors import LiveError
from dwell.live.visiting import Visitor
from dwell.model import Problem

__all__ = ["play"]

#: A folder with this file is a demo's, and may be replaced by the next.
MARK = ".dwell-live-demo"
LOOK_S = 0.5
START_S = 30.0
BAR = 24


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

    Raises
    ------
    DwellError
        If the cell does not come up, or the folder holds something else.
    """
    _make(out)
    with importlib.resources.as_file(importlib.resources.files("dwell.demo") / "cell.yaml") as file:
        problem = on_this_machine(dwell.load(file))
    if policy is not None:
        problem = replace(problem, controller=replace(problem.controller, policy=policy))
    changes = changes_of(problem, scenario)
    with Stageplay(problem, out.resolve(), _cpus(problem), seed=seed) as cell:
        with Visitor(problem) as visitor:
            _come_up(visitor, cell)
            with _view(problem, seconds) as view:
                _watch(visitor, cell, changes, seconds, view)
        cell.stop_controller()
    folder = next(iter(sorted((out / "runs").iterdir())), None)
    if folder is None:
        raise LiveError(f"{out}: the controller has written no run; see {out}/controller*.log")
    _sum_up(problem, folder, out, as_json=as_json)


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
    missing: Mapping[str, str] = dict.fromkeys(awaited, "has not been heard")
    while missing:
        if time.monotonic() > until:
            found = "; ".join(f"{who}: {why}" for who, why in sorted(missing.items()))
            raise LiveError(f"after {START_S:.0f} s the cell is not complete: {found}")
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


class View(Protocol):
    """Shows how the cell is."""

    def show(self, at_s: float, status: Mapping[str, Any], active: list[str]) -> None:
        """Show it."""
        ...


def _watch(
    visitor: Visitor, cell: Stageplay, changes: list[Change], seconds: float, view: View
) -> None:
    """Play the changes at their times, and show how the cell is."""
    begin = time.monotonic()
    waiting, active = list(changes), []
    status: Mapping[str, Any] = {}
    while (at_s := time.monotonic() - begin) < seconds:
        while waiting and waiting[0].at_s <= at_s:
            change = waiting.pop(0)
            cell.apply(change)
            if change.begins:
                active.append(change)
            else:
                active = [other for other in active if other.item is not change.item]
        try:
            status = visitor.ask("status", patience_s=LOOK_S)
        except LiveError:
            status = {**status, "silent": True}
        view.show(at_s, status, [str(change) for change in active])
        following = waiting[0].at_s if waiting else math.inf
        time.sleep(max(min(LOOK_S, following - (time.monotonic() - begin)), 0.0))


@contextmanager
def _view(problem: Problem, seconds: float) -> Iterator[View]:
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.live import Live

    with Live(refresh_per_second=4, transient=True, screen=False) as screen:
        yield _Screen(problem, seconds, screen)


@dataclass(slots=True)
class _Lines:
    """A line whenever something has changed, for logs."""

    last: tuple[object, ...] = ()
    windows: set[int] = field(default_factory=set)

    def show(self, at_s: float, status: Mapping[str, Any], active: list[str]) -> None:
        key = (status.get("placement"), status.get("guard_moves"), tuple(active))
        window = status.get("window") or {}
        if key != self.last:
            self.last = key
            typer.echo(
                f"{at_s:6.1f} s  {status.get('placement')}"
                f"{'  guard' if status.get('fallback') else ''}  "
                f"{window.get('l95_ms') or math.nan:6.1f} ms  "
                f"{100 * (window.get('violation_rate') or 0):5.1f} %  {'; '.join(active)}",
                err=True,
            )


class _Screen:
    """The whole cell on a terminal."""

    def __init__(self, problem: Problem, seconds: float, screen: Any) -> None:
        self.problem, self.seconds, self.screen = problem, seconds, screen
        self.history: list[str] = []

    def show(self, at_s: float, status: Mapping[str, Any], active: list[str]) -> None:
        from rich.console import Group
        from rich.panel import Panel
        from rich.table import Table
        from rich.text import Text

        window = status.get("window") or {}
        placement = status.get("placement") or "?"
        self.history = [*self.history, placement][-60:]
        head = Text(f"{at_s:5.0f} of {self.seconds:.0f} s   ")
        head.append("; ".join(active) or "nothing disturbs it", style="bold")
        stages = Table.grid(padding=(0, 2))
        if placement in self.problem.candidates:
            for task, node in self.problem.candidates[placement].items():
                stages.add_row(task, Text(node, style="bold"))
        numbers = Table.grid(padding=(0, 2))
        numbers.add_row("L95", _number(window.get("l95_ms"), "ms"))
        rate = window.get("violation_rate")
        numbers.add_row("V_D", _number(None if rate is None else 100 * rate, "%"))
        for name, cost in (window.get("estimates") or {}).items():
            numbers.add_row(f"J of {name}", _number(cost, "", 2))
        load = Table.grid(padding=(0, 2))
        for node, share in (window.get("utilisation") or {}).items():
            filled = round(BAR * min(share, 1.0))
            load.add_row(node, "█" * filled + "·" * (BAR - filled), f"{100 * share:.0f} %")
        moved = Text(
            f"{status.get('migrations', 0)} migrations, {status.get('guard_moves', 0)} of the guard"
        )
        if status.get("fallback"):
            moved.append("   on the guard's fallback", style="bold")
        if status.get("silent"):
            moved.append("   the controller does not answer", style="bold red")
        columns = Table.grid(padding=(0, 4))
        columns.add_row(stages, numbers, load)
        title = f"{self.problem.name}: {placement}"
        self.screen.update(Panel(Group(head, Text(), columns, Text(), moved), title=title))


def _number(value: float | None, unit: str, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()


def _sum_up(problem: Problem, folder: Path, out: Path, *, as_json: bool) -> None:
    """Write the report, and print what the run was."""
    from dwell.cli.report import report_run

    run = dwell.open_run(folder)
    cycles = run.cycles
    decisions = run.decisions
    guard = decisions.filter((decisions["reason"] == "guard") & decisions["migrated"])
    lost = cycles.filter(cycles["latency_ns"].is_null())
    rate = float(cycles["missed"].cast(float).mean() or 0.0)  # type: ignore[arg-type]
    found = {
        "cell": problem.name,
        "cycles": len(cycles),
        "violation_rate": rate,
        "lost": len(lost),
        "migrations": int(decisions["migrated"].sum()) - len(guard),
        "guard_moves": len(guard),
        "run": folder,
    }
    if as_json:
        print_json(found)
        return
    typer.echo(
        f"{found['cycles']} cycles, {100 * rate:.1f} % missed, "
        f"{found['lost']} without a command; {found['migrations']} migrations by the controller, "
        f"{found['guard_moves']} by the guard"
    )
    typer.echo(f"run: {folder}")
    report_run(folder, out / "report.html", None, as_json=False)
