"""Lines of a live run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import dwell
from dwell.live.commands.live_view import CellState, Lines
from dwell.model import Problem
from dwell.model.disturbed import Disturbed, disturbed

CELL = Path(__file__).parents[3] / "examples" / "visual_servoing" / "cell.yaml"


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


def state(at_s: float, told: dict[str, Any], active: list[Disturbed], **more: float) -> CellState:
    answered_s = more.get("answered_s", at_s)
    return CellState(at_s, told, answered_s, {"error_mm": 3.25, "error_px": 5.5}, active)


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


def test_lines_have_the_last_window_the_guard_and_a_silent_controller(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = Lines()
    lines.show(state(20, status(4, placement="SO", guard_moves=1, fallback=True), []))
    lines.show(
        state(30, status(4, placement="SO", guard_moves=1, fallback=True), [], answered_s=21)
    )
    placed, silent = capsys.readouterr().err.splitlines()
    for part in ("SO  by the guard", "L95 31.2 ms", "V_D 2.50 %", "error 3.2 mm"):
        assert part in placed, part
    assert "silent" not in placed
    assert "the controller is silent" in silent
