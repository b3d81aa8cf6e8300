"""What a live cell looks like on a terminal while it runs."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from dwell.cli.live import proof
from dwell.model import Problem
from dwell.report.palette import Palette
from dwell.report.phases import Disturbed

MOST_COLUMNS = 100
LABEL, VALUE = 10, 10
BAR = 12
BLOCKS = "▁▂▃▄▅▆▇█"
#: Sparklines reach so many times the deadline, and so much violation rate and error (mm).
DEADLINES, MOST_RATE, MOST_MM = 2.0, 1.0, 20.0
#: An answer of the controller that is older is told.
SILENT_S = 1.5
GREY, MISSED, HELD = "bright_black", "red", "yellow"


@dataclass(frozen=True, slots=True)
class Look:
    """One look at a cell.

    Parameters
    ----------
    at_s : float
        Since the beginning.
    status : mapping
        The controller's last answer; empty before the first.
    answered_s : float
        When that was.
    observed : mapping of str to float
        What the cell's observer sees, by names with units; ``error_mm`` is drawn.
    active : sequence of Disturbed
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
    def silent_s(self) -> float:
        """How long the controller has not answered; 0 where that is not long."""
        silent_s = self.at_s - self.answered_s
        return silent_s if silent_s > SILENT_S else 0.0


class View(Protocol):
    """Shows a cell."""

    def show(self, look: Look) -> None:
        """Show how it is now."""
        ...


@contextmanager
def live_view(problem: Problem, seconds: float, plan: Sequence[Disturbed]) -> Iterator[View]:
    """Return what shows a cell on stderr: a screen on a terminal, lines elsewhere.

    Parameters
    ----------
    seconds : float
        How long it will be shown.
    plan : sequence of Disturbed
        What will be done to it.
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

    def show(self, look: Look) -> None:
        """Print a line if there is news."""
        status, window = look.status, look.window
        silent = look.silent_s > 0
        active = tuple(f"{one.kind} ({one.what})" for one in look.active)
        headline = "" if silent else status.get("headline") or ""
        moved = status.get("placement"), status.get("guard_moves")
        key = (*moved, silent, status.get("health"), active)
        if key == self.last:
            return
        self.last = key
        by_guard = "  by the guard" if status.get("fallback") else ""
        typer.echo(
            f"{look.at_s:6.1f} s  {status.get('placement') or '-'}{by_guard}"
            f"  L95 {_number(window.get('l95_ms'), 'ms')}"
            f"  V_D {_number(_hundred(window.get('violation_rate')), '%')}"
            f"{_error(look)}"
            f"{'  the controller is silent' if silent else ''}"
            f"  {'; '.join(active) or 'nothing disturbs it'}"
            f"{f'  {headline}' if headline else ''}",
            err=True,
        )


@dataclass(slots=True)
class _Course:
    """What was seen so far, in columns of equal time."""

    columns: int
    seconds: float
    placed: list[tuple[str, bool]] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=dict)

    def column(self, at_s: float) -> int:
        """Return the column of an instant."""
        return min(max(int(at_s / self.seconds * self.columns), 0), self.columns - 1)

    def place(self, at_s: float, name: str, *, fallback: bool) -> None:
        """Note where the cell is."""
        column = self.column(at_s)
        while len(self.placed) <= column:
            self.placed.append((name, fallback))
        self.placed[column] = name, fallback

    def value(self, name: str, at_s: float, value: float) -> None:
        """Note a value; of several in a column, the worst is shown."""
        if not math.isfinite(value):
            return
        values, column = self.values.setdefault(name, []), self.column(at_s)
        fresh = len(values) <= column
        while len(values) <= column:
            values.append(values[-1] if values else math.nan)
        values[column] = value if fresh else max(values[column], value)


class Screen:
    """The whole cell on a terminal of at least 80 columns and 24 lines.

    Parameters
    ----------
    plan : sequence of Disturbed
    update : callable
        Takes what is to be seen now.
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
        self._looks: list[Look] = []
        self._last_move = ""

    def show(self, look: Look) -> None:
        """Draw it anew."""
        if self._looks:
            self._note_move(self._looks[-1], look)
        self._looks.append(look)
        self._update(self.drawn())

    def _note_move(self, before: Look, look: Look) -> None:
        old, new = before.status.get("placement"), look.status.get("placement")
        if old and new and old != new:
            who = "the guard" if look.status.get("fallback") else "the controller"
            self._last_move = f"last at {look.at_s:.0f} s by {who}: {old} → {new}"

    def drawn(self) -> RenderableType:
        """Return all that is to be seen."""
        look = self._looks[-1]
        width = min(self._console.width, MOST_COLUMNS)
        inner = width - 4
        course = self._course(inner - LABEL - VALUE)
        parts: tuple[RenderableType, ...] = (
            self._head(look, inner),
            Text(),
            *self._strips(look, course),
            Text(),
            self._tables(look),
            Text(),
            *self._foot(look),
        )
        title = f"{self.problem.name}, live"
        return Panel(Group(*parts), title=title, width=width, border_style=GREY, padding=(0, 1))

    def _course(self, columns: int) -> _Course:
        """Lay what was seen out in columns: a terminal may change its width."""
        course = _Course(columns, self.seconds)
        seen = -1
        for look in self._looks:
            placement = look.status.get("placement")
            if placement:
                course.place(look.at_s, placement, fallback=bool(look.status.get("fallback")))
            course.value("error", look.at_s, look.error_mm)
            number = look.window.get("number", -1)
            if number != seen:
                seen = number
                course.value("L95", look.at_s, _float(look.window.get("l95_ms")))
                course.value("V_D", look.at_s, _float(look.window.get("violation_rate")))
        return course

    def _head(self, look: Look, width: int) -> Text:
        clock = f"{min(look.at_s, self.seconds):.0f} of {self.seconds:.0f} s"
        what = "; ".join(f"{one.kind} ({one.what})" for one in look.active)
        head = Text(what or "nothing disturbs it", style="bold", no_wrap=True)
        head.truncate(width - len(clock) - 2, overflow="ellipsis", pad=True)
        return head.append(f"  {clock}")

    def _strips(self, look: Look, course: _Course) -> Iterator[Text]:
        deadline_ms = self.problem.pipeline.deadline_ms
        window = look.window
        placement = look.status.get("placement") or "-"
        yield self._line("played", self._planned(look, course), "")
        yield self._line("placed", self._placed(course), placement, self._colours.get(placement))
        for name, value, most, limit in (
            ("L95", _number(window.get("l95_ms"), "ms"), DEADLINES * deadline_ms, deadline_ms),
            ("V_D", _number(_hundred(window.get("violation_rate")), "%"), MOST_RATE, 0.05),
            ("error", _number(look.error_mm, "mm"), MOST_MM, math.inf),
        ):
            if name == "error" and self.problem.live.observer is None:
                continue
            strip = _sparkline(course.values.get(name, []), most, limit)
            strip.append(" " * (course.columns - len(strip)))
            yield self._line(name, strip, value)

    @staticmethod
    def _line(label: str, strip: Text, value: str, style: str | None = None) -> Text:
        line = Text(label.ljust(LABEL), style=GREY, no_wrap=True)
        line.append_text(strip)
        room = " " * max(0, 1 - len(value) + VALUE - 1)
        return line.append(room).append(value, style=f"bold {style}" if style else "bold")

    def _planned(self, look: Look, course: _Course) -> Text:
        """Write when what is done to it, dim as long as it is to come."""
        letters = ["·"] * course.columns
        for one in self.plan:
            first, last = course.column(one.begin_s), course.column(min(one.end_s, self.seconds))
            length = max(last - first, 1)
            name = f" {one.kind} " if len(one.kind) + 2 <= length else f" {one.kind.split()[0]} "
            letters[first : first + length] = name[:length].center(length, "━")
        text, now = Text(), course.column(look.at_s) + 1
        text.append("".join(letters[:now]), style="default")
        return text.append("".join(letters[now:]), style=GREY)

    def _placed(self, course: _Course) -> Text:
        text = Text()
        for name, fallback in course.placed:
            text.append("▒" if fallback else "█", style=self._colours.get(name, "default"))
        text.append("·" * (course.columns - len(text)), style=GREY)
        return text

    def _tables(self, look: Look) -> Table:
        columns = Table.grid(padding=(0, 4))
        columns.add_row(self._stages(look), self._costs(look), self._load(look))
        return columns

    def _stages(self, look: Look) -> Table:
        stages = Table.grid(padding=(0, 1))
        placement = look.status.get("placement")
        placed: Mapping[str, str] = self.problem.candidates.get(placement or "", {})
        colour = self._colours.get(placement or "", "default")
        for task in self.problem.pipeline.tasks.values():
            style = f"bold {colour}" if len(task.on) > 1 else GREY
            node = str(placed.get(task.name, "-"))
            stages.add_row(Text(task.name, no_wrap=True), Text(node, style=style, no_wrap=True))
        return stages

    def _costs(self, look: Look) -> Table:
        """Write J of every candidate: measured, or estimated."""
        costs = Table.grid(padding=(0, 1))
        placement, moving = look.status.get("placement"), look.status.get("moving_to")
        for name in self.problem.candidates:
            value = (look.window.get("estimates") or {}).get(name)
            mark = "◀" if name == placement else "…" if name == moving else " "
            costs.add_row(
                Text("J", style=GREY),
                Text(name, style=self._colours[name], no_wrap=True),
                Text(_number(value, "", 2).rjust(6), style="bold" if mark == "◀" else ""),
                Text(mark, style=self._colours[name]),
            )
        return costs

    def _load(self, look: Look) -> Table:
        load = Table.grid(padding=(0, 1))
        used = look.window.get("utilisation") or {}
        for node in self.problem.fabric.nodes:
            share = used.get(node)
            filled = round(BAR * min(max(_float(share), 0.0), 1.0)) if share is not None else 0
            bar = Text("█" * filled).append("·" * (BAR - filled), style=GREY)
            percent = _number(_hundred(share), "%", 0).rjust(5)
            load.add_row(Text("CPU", style=GREY), Text(node, no_wrap=True), bar, percent)
        return load

    def _foot(self, look: Look) -> Iterator[Text]:
        status = look.status
        moved, guarded = status.get("migrations", 0), status.get("guard_moves", 0)
        foot = Text(no_wrap=True, overflow="ellipsis")
        foot.append(f"{moved} migration{'' if moved == 1 else 's'}", style="bold")
        foot.append(f", {guarded} by the guard", style=f"bold {HELD}" if guarded else GREY)
        yield foot.append(f"   {self._last_move}", style=GREY)
        remark = Text(no_wrap=True, overflow="ellipsis")
        if look.silent_s:
            remark.append(f"no answer from the controller for {look.silent_s:.0f} s", "bold red")
        elif status.get("headline"):
            remark.append(status["headline"], "bold red")
        elif status.get("fallback"):
            proving = status.get("proving")
            progress = f"; {proof(proving)}" if proving else ""
            remark.append(f"where the guard has put it{progress}", f"bold {HELD}")
        elif status.get("moving_to"):
            remark.append(f"moving to {status['moving_to']}", GREY)
        elif look.window.get("reason"):
            remark.append(f"last decision: {look.window['reason']}", GREY)
        yield remark


def _sparkline(values: Sequence[float], most: float, limit: float) -> Text:

    text = Text()
    for value in values:
        if math.isnan(value):
            text.append(" ")
            continue
        step = min(max(int(value / most * len(BLOCKS)), 0), len(BLOCKS) - 1)
        text.append(BLOCKS[step], style=MISSED if value > limit else "default")
    return text


def _error(look: Look) -> str:
    return "" if math.isnan(look.error_mm) else f"  error {_number(look.error_mm, 'mm')}"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _hundred(value: object) -> float:
    return 100 * _float(value)


def _number(value: object, unit: str, digits: int = 1) -> str:
    known = _float(value)
    return "-" if math.isnan(known) else f"{known:.{digits}f} {unit}".rstrip()
