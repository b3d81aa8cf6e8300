"""What a live run shows: a screen on a terminal, lines in a log."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import dwell
from dwell.live.commands.live_view import CellState, Lines, Screen
from dwell.model import Problem
from dwell.model.disturbed import Disturbed, disturbed

CELL = Path(__file__).parents[3] / "examples" / "visual_servoing" / "cell.yaml"

SECONDS = 116.0


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load(CELL)


@pytest.fixture
def plan(problem: Problem) -> list[Disturbed]:
    return disturbed(problem.scenario("demo"), problem.fabric)


def status(window: int, **more: Any) -> dict[str, Any]:
    return {
        "placement": "LOC",
        "fallback": False,
        "migrations": 3,
        "guard_moves": 0,
        "window": {
            "number": window,
            "last_cycle": window,
            "l95_ms": 31.25,
            "violation_rate": 0.025,
            "estimates": {"LOC": 1.0, "SO": 1.25, "HYB": None},
            "utilisation": {"R1": 0.6, "E": 0.3, "R2": 1.02},
            "reason": "hold",
        },
        **more,
    }


class Terminal:
    """A screen drawn on paper of a given size."""

    def __init__(self, problem: Problem, plan: list[Disturbed], columns: int) -> None:
        self.console = Console(
            file=io.StringIO(), width=columns, force_terminal=True, color_system=None
        )
        self.screen = Screen(problem, SECONDS, plan, self.console, lambda _: None)

    def lines(self) -> list[str]:
        with self.console.capture() as capture:
            self.console.print(self.screen.drawn())
        return capture.get().splitlines()


def state(at_s: float, told: dict[str, Any], active: list[Disturbed], **more: float) -> CellState:
    answered_s = more.get("answered_s", at_s)
    return CellState(at_s, told, answered_s, {"error_mm": 3.25, "error_px": 5.5}, active)


@pytest.mark.parametrize(("columns", "width"), [(80, 80), (100, 100), (180, 100)])
def test_it_fits_a_terminal_at_every_moment(
    columns: int, width: int, problem: Problem, plan: list[Disturbed]
) -> None:
    terminal = Terminal(problem, plan, columns)
    heights = set()
    for second in range(0, 117, 3):
        active = [one for one in plan if one.begin_s <= second < one.end_s]
        placement = ("LOC", "SO", "HYB")[second % 3]
        moved = status(second, placement=placement, fallback=second % 2 == 0)
        terminal.screen.show(state(second, moved, active))
        lines = terminal.lines()
        assert {len(line) for line in lines} == {width}
        heights.add(len(lines))
    # It never jumps, and leaves room for a prompt.
    assert len(heights) == 1
    assert max(heights) < 23


def test_it_shows_what_is_known_of_the_cell(problem: Problem, plan: list[Disturbed]) -> None:
    terminal = Terminal(problem, plan, 80)
    terminal.screen.show(state(10, {}, []))
    assert "nothing disturbs it" in "\n".join(terminal.lines())
    terminal.screen.show(state(20, status(4), plan[:1]))
    terminal.screen.show(state(21, status(5, placement="SO", guard_moves=1, fallback=True), []))
    text = "\n".join(terminal.lines())
    for part in ("31.2 ms", "2.5 %", "3.2 mm", "3 migrations, 1 by the guard", "R1 ", " 60 %"):
        assert part in text, part
    assert "at 21 s by the guard: LOC → SO" in text
    assert "perception E" in text
    assert "▒" in text
    terminal.screen.show(state(30, status(5), [], answered_s=21))
    assert "no answer from the controller for 9 s" in "\n".join(terminal.lines())


def test_logs_get_a_line_whenever_something_has_changed(
    plan: list[Disturbed], capsys: pytest.CaptureFixture[str]
) -> None:
    lines = Lines()
    for second in range(10):
        active = plan[:1] if second >= 5 else []
        lines.show(state(second, status(second, placement="LOC" if second < 7 else "SO"), active))
    told = capsys.readouterr().err.splitlines()
    assert [line.split()[0] for line in told] == ["0.0", "5.0", "7.0"]
    assert "robot stress (R1: 2 busy threads)" in told[1]
