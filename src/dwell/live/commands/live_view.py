"""View of a live cell on a terminal while it runs."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby, islice
from typing import Any, Protocol

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from dwell.cli.output import block, proof
from dwell.model import Problem
from dwell.model.disturbed import Disturbed
from dwell.report.palette import Palette

MOST_COLUMNS = 100
LABEL, VALUE = 10, 10
BAR = 12
#: Sparklines reach so many times the deadline, and so much violation rate and error (mm).
DEADLINES, MOST_RATE, MOST_MM = 2.0, 1.0, 20.0
#: An answer of the controller that is older is told.
SILENT_S = 1.5
GREY, MISSED, HELD = "bright_black", "red", "yellow"


@dataclass(frozen=True, slots=True)
class CellState:
    """State of a cell at an instant.

    Parameters
    ----------
    at_s : float
        Time since the cell began.
    status : mapping
        The controller's last answer; empty before the first.
    answered_s : float
        Time of that answer.
    observed : mapping of str to float
        Values of the cell's observer, by names with units; ``error_mm`` is drawn.
    """

    at_s: float
    status: Mapping[str, Any]
    answered_s: float
    observed: Mapping[str, float]
    active: Sequence[Disturbed]

    @property
    def error_mm(self) -> float:
        """Tracking error of the last second; NaN where unknown."""
        return self.observed.get("error_mm", math.nan)

    @property
    def window(self) -> Mapping[str, Any]:
        """The last closed window."""
        window: Mapping[str, Any] = self.status.get("window") or {}
        return window

    @property
    def disturbances(self) -> str:
        """The disturbances that are on, in words."""
        return "; ".join(f"{item.kind} ({item.what})" for item in self.active)

    @property
    def silent_s(self) -> float:
        """How long the controller has not answered; 0 where that is not long."""
        silent_s = self.at_s - self.answered_s
        return silent_s if silent_s > SILENT_S else 0.0


class View(Protocol):
    """Shows a cell."""

    def show(self, state: CellState) -> None:
        """Show how it is now."""


@contextmanager
def live_view(problem: Problem, seconds: float, plan: Sequence[Disturbed]) -> Iterator[View]:
    """Return what shows a cell on stderr: a screen on a terminal, lines elsewhere.

    Parameters
    ----------
    seconds : float
        Length of the run.
    plan : sequence of Disturbed
        All that will disturb it.
    """
    if not sys.stderr.isatty():
        yield Lines()
        return
    console = Console(stderr=True)
    with Live(console=console, auto_refresh=False, transient=True) as screen:
        yield Screen(
            problem, seconds, plan, console, lambda what: screen.update(what, refresh=True)
        )


@dataclass(slots=True)
class Lines:
    """A line whenever something has changed, for logs."""

    last: tuple[object, ...] = ()

    def show(self, state: CellState) -> None:
        """Print a line if there is news."""
        status, window = state.status, state.window
        silent = state.silent_s > 0
        headline = "" if silent else status.get("headline") or ""
        moved = status.get("placement"), status.get("guard_moves")
        key = (*moved, silent, status.get("health"), state.disturbances)
        if key == self.last:
            return
        self.last = key
        by_guard = "  by the guard" if status.get("fallback") else ""
        typer.echo(
            f"{state.at_s:6.1f} s  {status.get('placement') or '-'}{by_guard}"
            f"  L95 {_number(window.get('l95_ms'), 'ms')}"
            f"  V_D {_number(_hundred(window.get('violation_rate')), '%')}"
            f"{_error(state)}"
            f"{'  the controller is silent' if silent else ''}"
            f"  {state.disturbances or 'nothing disturbs it'}"
            f"{f'  {headline}' if headline else ''}",
            err=True,
        )


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns of equal time, which states are laid out in anew: a terminal may change its width."""

    count: int
    seconds: float

    def column(self, at_s: float) -> int:
        """Return the column of an instant."""
        return min(max(int(at_s / self.seconds * self.count), 0), self.count - 1)

    def placements(self, states: Iterable[CellState]) -> list[tuple[str, bool]]:
        """Return the last placement of each column so far, and whether it is a fallback."""
        placed: list[tuple[str, bool]] = []
        for state in states:
            if name := state.status.get("placement"):
                column = self.column(state.at_s)
                newest = name, bool(state.status.get("fallback"))
                placed += [newest] * (column + 1 - len(placed))
                placed[column] = newest
        return placed

    def worst(self, values: Iterable[tuple[float, float]]) -> list[float]:
        """Return the largest value of each column so far; without any it is that before it."""
        worst: list[float] = []
        for at_s, value in values:
            if math.isfinite(value):
                column = self.column(at_s)
                fresh = len(worst) <= column
                worst += [worst[-1] if worst else math.nan] * (column + 1 - len(worst))
                worst[column] = value if fresh else max(worst[column], value)
        return worst


class Screen:
    """The whole cell on a terminal of at least 80 columns and 24 lines.

    Parameters
    ----------
    update : callable
        Shows a drawing in place of the one before.
    """

    def __init__(
        self,
        problem: Problem,
        seconds: float,
        plan: Sequence[Disturbed],
        console: Console,
        update: Callable[[RenderableType], None],
    ) -> None:
        self.problem, self.seconds, self.plan = problem, seconds, plan
        self._console, self._update = console, update
        self._colours = Palette.of(tuple(problem.candidates)).placements
        self._states: list[CellState] = []
        self._last_move = ""

    def show(self, state: CellState) -> None:
        """Draw it anew."""
        if self._states:
            self._note_move(self._states[-1], state)
        self._states.append(state)
        self._update(self.drawn())

    def _note_move(self, before: CellState, state: CellState) -> None:
        old, new = before.status.get("placement"), state.status.get("placement")
        if old and new and old != new:
            who = "the guard" if state.status.get("fallback") else "the controller"
            self._last_move = f"last at {state.at_s:.0f} s by {who}: {old} → {new}"

    def drawn(self) -> RenderableType:
        """Return all that is to be seen."""
        state = self._states[-1]
        width = min(self._console.width, MOST_COLUMNS)
        inner = width - 4
        columns = _Columns(inner - LABEL - VALUE, self.seconds)
        parts: tuple[RenderableType, ...] = (
            self._head(state, inner),
            Text(),
            *self._strips(state, columns),
            Text(),
            self._tables(state),
            Text(),
            *self._foot(state),
        )
        title = f"{self.problem.name}, live"
        return Panel(Group(*parts), title=title, width=width, border_style=GREY, padding=(0, 1))

    def _head(self, state: CellState, width: int) -> Text:
        clock = f"{min(state.at_s, self.seconds):.0f} of {self.seconds:.0f} s"
        head = Text(state.disturbances or "nothing disturbs it", style="bold", no_wrap=True)
        head.truncate(width - len(clock) - 2, overflow="ellipsis", pad=True)
        return head.append(f"  {clock}")

    def _strips(self, state: CellState, columns: _Columns) -> Iterator[Text]:
        deadline_ms = self.problem.pipeline.deadline_ms
        placement = state.status.get("placement") or "-"
        yield self._line("played", self._planned(state, columns), "")
        yield self._line("placed", self._placed(columns), placement, self._colours.get(placement))
        numbered = groupby(self._states, lambda seen: seen.window.get("last_cycle"))
        # Of each decision, the state that saw it first.
        windows = [(seen.at_s, seen.window) for _, states in numbered for seen in islice(states, 1)]
        for name, key, scale, unit, most, limit in (
            ("L95", "l95_ms", 1, "ms", DEADLINES * deadline_ms, deadline_ms),
            ("V_D", "violation_rate", 100, "%", MOST_RATE, 0.05),
        ):
            worst = columns.worst((at_s, _float(window.get(key))) for at_s, window in windows)
            value = _number(scale * _float(state.window.get(key)), unit)
            yield self._line(name, _sparkline(worst, columns.count, most, limit), value)
        if self.problem.live.observer is not None:
            worst = columns.worst((seen.at_s, seen.error_mm) for seen in self._states)
            strip = _sparkline(worst, columns.count, MOST_MM, math.inf)
            yield self._line("error", strip, _number(state.error_mm, "mm"))

    @staticmethod
    def _line(label: str, strip: Text, value: str, style: str | None = None) -> Text:
        line = Text(label.ljust(LABEL), style=GREY, no_wrap=True)
        line.append_text(strip)
        room = " " * max(0, 1 - len(value) + VALUE - 1)
        return line.append(room).append(value, style=f"bold {style}" if style else "bold")

    def _planned(self, state: CellState, columns: _Columns) -> Text:
        """Write the names of the disturbances at their times, dim as long as they are to come."""
        letters = ["·"] * columns.count
        for item in self.plan:
            first = columns.column(item.begin_s)
            length = max(columns.column(min(item.end_s, self.seconds)) - first, 1)
            name = f" {item.kind} " if len(item.kind) + 2 <= length else f" {item.kind.split()[0]} "
            letters[first : first + length] = name[:length].center(length, "━")
        text, now = Text(), columns.column(state.at_s) + 1
        text.append("".join(letters[:now]), style="default")
        return text.append("".join(letters[now:]), style=GREY)

    def _placed(self, columns: _Columns) -> Text:
        text = Text()
        for name, fallback in columns.placements(self._states):
            text.append("▒" if fallback else "█", style=self._colours.get(name, "default"))
        text.append("·" * (columns.count - len(text)), style=GREY)
        return text

    def _tables(self, state: CellState) -> Table:
        columns = Table.grid(padding=(0, 4))
        columns.add_row(self._stages(state), self._costs(state), self._load(state))
        return columns

    def _stages(self, state: CellState) -> Table:
        stages = Table.grid(padding=(0, 1))
        placement = state.status.get("placement")
        placed: Mapping[str, str] = self.problem.candidates.get(placement or "", {})
        colour = self._colours.get(placement or "", "default")
        for task in self.problem.pipeline.tasks.values():
            style = f"bold {colour}" if len(task.on) > 1 else GREY
            node = str(placed.get(task.name, "-"))
            stages.add_row(Text(task.name, no_wrap=True), Text(node, style=style, no_wrap=True))
        return stages

    def _costs(self, state: CellState) -> Table:
        """Write J of every candidate: measured, or estimated."""
        costs = Table.grid(padding=(0, 1))
        placement, moving = state.status.get("placement"), state.status.get("moving_to")
        for name in self.problem.candidates:
            value = (state.window.get("estimates") or {}).get(name)
            mark = "◀" if name == placement else "…" if name == moving else " "
            costs.add_row(
                Text("J", style=GREY),
                Text(name, style=self._colours[name], no_wrap=True),
                Text(_number(value, "", 2).rjust(6), style="bold" if mark == "◀" else ""),
                Text(mark, style=self._colours[name]),
            )
        return costs

    def _load(self, state: CellState) -> Table:
        load = Table.grid(padding=(0, 1))
        used = state.window.get("utilisation") or {}
        for name, one in self.problem.fabric.resources.items():
            share = used.get(name)
            filled = round(BAR * min(max(_float(share), 0.0), 1.0)) if share is not None else 0
            bar = Text("█" * filled).append("·" * (BAR - filled), style=GREY)
            percent = _number(_hundred(share), "%", 0).rjust(5)
            kind = Text(one.kind or "CPU", style=GREY, no_wrap=True)
            load.add_row(kind, Text(one.node, no_wrap=True), bar, percent)
        return load

    def _foot(self, state: CellState) -> Iterator[Text]:
        status = state.status
        moved, guarded = status.get("migrations", 0), status.get("guard_moves", 0)
        foot = Text(no_wrap=True, overflow="ellipsis")
        foot.append(f"{moved} migration{'' if moved == 1 else 's'}", style="bold")
        foot.append(f", {guarded} by the guard", style=f"bold {HELD}" if guarded else GREY)
        yield foot.append(f"   {self._last_move}", style=GREY)
        remark = Text(no_wrap=True, overflow="ellipsis")
        if state.silent_s:
            remark.append(f"no answer from the controller for {state.silent_s:.0f} s", "bold red")
        elif status.get("headline"):
            remark.append(status["headline"], "bold" if status["health"] == "ok" else "bold red")
        elif status.get("fallback"):
            proving = status.get("proving")
            progress = f"; {proof(proving)}" if proving else ""
            remark.append(f"where the guard has put it{progress}", f"bold {HELD}")
        elif status.get("moving_to"):
            remark.append(f"moving to {status['moving_to']}", GREY)
        elif state.window.get("reason"):
            remark.append(f"last decision: {state.window['reason']}", GREY)
        yield remark


def _sparkline(values: Sequence[float], columns: int, most: float, limit: float) -> Text:
    text = Text()
    for value in values:
        if math.isnan(value):
            text.append(" ")
            continue
        text.append(block(value / most), style=MISSED if value > limit else "default")
    text.append(" " * (columns - len(text)))
    return text


def _error(state: CellState) -> str:
    return "" if math.isnan(state.error_mm) else f"  error {_number(state.error_mm, 'mm')}"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _hundred(value: object) -> float:
    return 100 * _float(value)


def _number(value: object, unit: str, digits: int = 1) -> str:
    known = _float(value)
    return "-" if math.isnan(known) else f"{known:.{digits}f} {unit}".rstrip()
