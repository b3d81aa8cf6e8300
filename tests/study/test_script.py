"""Scripts: the list is followed window by window, through delays of orders and outages."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dwell.errors import PolicyError
from dwell.model import NodeDisturbance, Problem, Uniform
from dwell.record import Run
from dwell.sim import draw, simulate_realisation
from dwell.study.script import Script
from tests.cells.small import make_problem

WINDOWS = 24
# The controller's node is down for these spans, in seconds; a window is 0.33 s, so that the first
# span begins as one closes.
OUTAGES = ((0.99, 0.9), (4.0, 0.5), (6.2, math.inf))


def make_cell(*, outages: bool, jitter_ms: float = 0.0, **settings: float) -> Problem:
    problem = make_problem()
    down = tuple(
        NodeDisturbance("E", at_s=at_s, for_s=for_s, down=True)
        for at_s, for_s in (OUTAGES if outages else ())
    )
    return replace(
        problem,
        pipeline=replace(problem.pipeline, release_jitter_ms=Uniform(0.0, jitter_ms)),
        scenarios={"outages": down},
        controller=replace(problem.controller, **settings),  # type: ignore[arg-type]
    )


def follow(problem: Problem, names: list[str]) -> Run:
    realisation = draw(problem, scenario="outages", seed=1, windows=WINDOWS)
    script = Script(names, problem, realisation)
    return simulate_realisation(problem, realisation, policy=script)


TURNS = [("LOC", "SO", "HYB")[k % 3] for k in range(WINDOWS)]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"order_delay_ms": 40.0},
        {"order_lead_cycles": 5},
        {"close_grace_ms": 70.0},
        {"order_delay_ms": 100.0, "order_lead_cycles": 1, "close_grace_ms": 15.0},
        {"jitter_ms": 70.0},
        {"jitter_ms": 20.0, "order_delay_ms": 40.0, "close_grace_ms": 15.0},
    ],
)
@pytest.mark.parametrize("outages", [False, True])
def test_every_window_has_the_placement_of_the_list(
    settings: dict[str, float], outages: bool
) -> None:
    run = follow(make_cell(outages=outages, **settings), TURNS)
    windows = run.windows
    # What is due after a close that nobody sees waits for the next one, and then is out of date.
    expected, seen = [TURNS[0]], windows["cost"].is_not_null().to_list()
    for k in range(windows.height - 1):
        expected.append(TURNS[k + 1] if seen[k] else expected[-1])
    assert windows["placement"].to_list() == expected
    assert (outages and not all(seen)) or (not outages and all(seen))
    assert windows.height > 10
    assert run.decisions["window"].to_list() == [k for k, known in enumerate(seen) if known]


def test_a_run_longer_than_the_list_stays_on_the_last() -> None:
    run = follow(make_cell(outages=False), ["SO", "LOC", "HYB"])
    assert run.windows["placement"].to_list() == ["SO", "LOC"] + ["HYB"] * (WINDOWS - 2)


def test_a_script_can_be_played_twice() -> None:
    problem = make_cell(outages=False)
    realisation = draw(problem, scenario="outages", seed=1, windows=WINDOWS)
    script = Script(TURNS, problem, realisation)
    first, second = (
        simulate_realisation(problem, realisation, policy=script).windows for _ in range(2)
    )
    assert first.equals(second)
    assert repr(script) == f"Script({WINDOWS} placements, {WINDOWS - 1} migrations)"
    assert first["placement"].to_list() == TURNS


def test_a_script_of_no_candidates_is_refused() -> None:
    problem = make_cell(outages=False)
    realisation = draw(problem, scenario="baseline", seed=1, windows=2)
    with pytest.raises(PolicyError, match=r"names\[1\] is 'S0', which is no candidate"):
        Script(["LOC", "S0"], problem, realisation)
    with pytest.raises(PolicyError, match="names is empty"):
        Script([], problem, realisation)
