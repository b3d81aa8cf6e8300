"""A lower rate of a link is distinguished from a longer delay, by messages of several loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

import dwell
from dwell.estimators.link_rates import better_rate
from dwell.model import (
    Constant,
    ControllerSettings,
    Disturbance,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    Problem,
    Task,
    Uniform,
)
from tests.cells.generated import make_problem

Floats: TypeAlias = NDArray[np.float64]

#: Rate of the slow link.
SLOW_MBPS = 20.0
#: Delay of the links, milliseconds.
DELAY = Uniform(0.8, 1.2)


def cell(scenario: Sequence[Disturbance], camera: int = 100_000, lidar: int = 100_000) -> Problem:
    """Two sensors whose messages of some bytes share the way to the edge."""
    both = {"R": Execution(LogNormal(50.0, 0.1)), "E": Execution(LogNormal(10.0, 0.1))}
    here = {"R": Execution(Constant(1.0))}
    return make_problem(
        [Node("R", "robot", 2), Node("E", "edge", 8)],
        [
            Task("camera", here),
            Task("lidar", here),
            Task("detect", both),
            Task("segment", both),
            Task("act", here),
        ],
        [
            Flow("camera", "detect", camera),
            Flow("lidar", "segment", lidar),
            Flow("detect", "act", 1000),
            Flow("segment", "act", 1000),
        ],
        links=[Link("R", "E", DELAY, rate_mbps=940.0), Link("E", "R", DELAY, rate_mbps=940.0)],
        candidates={
            "LOC": {},
            "SO": {"detect": "E", "segment": "E"},
            "HALF": {"detect": "E"},
        },
        scenario=scenario,
        period_ms=100.0,
        deadline_ms=70.0,
        window_cycles=50,
        controller=ControllerSettings(estimator="corrected", shadow_fraction=0.05),
    )


SLOW = (LinkDisturbance("R", "E", rate_mbps=SLOW_MBPS),)


def true_l95_ms(problem: Problem, name: str) -> float:
    run = dwell.simulate(problem, scenario="disturbed", policy=name, seed=9, windows=60)
    return float(run.windows["seen_l95_ms"].to_numpy()[30:].mean())


def estimated_ms(problem: Problem, incumbent: str, name: str, windows: int = 12) -> list[float]:
    """Return estimates of L95 of a candidate while the cell stays on another."""
    run = dwell.simulate(
        problem,
        scenario="disturbed",
        policy=incumbent,
        estimator="corrected",
        seed=1,
        windows=windows,
    )
    return [float(ms) for ms in run.decisions[f"est_l95_ms_{name}"]]


@pytest.mark.parametrize("incumbent", ["LOC", "HALF"])
def test_messages_that_fill_a_slow_link_together(incumbent: str) -> None:
    # 40 and 120 ms of 100: the link has more to send than it can, which single shadows do not show.
    problem = cell(SLOW, lidar=300_000)
    estimates = estimated_ms(problem, incumbent, "SO")
    assert estimates[4:] == pytest.approx([true_l95_ms(problem, "SO")] * 8, rel=0.02)


@pytest.mark.parametrize("lidar", [20_000, 100_000])
def test_messages_that_a_slow_link_can_send(lidar: int) -> None:
    problem = cell(SLOW, lidar=lidar)
    for name in ("SO", "HALF"):
        estimates = estimated_ms(problem, "LOC", name)
        assert estimates[4:] == pytest.approx([true_l95_ms(problem, name)] * 8, rel=0.02)


def test_a_rate_that_is_as_declared_again() -> None:
    slow = [LinkDisturbance("R", "E", at_s=0.0, for_s=50.0, rate_mbps=SLOW_MBPS)]
    problem = cell(slow, lidar=300_000)
    usual_ms = true_l95_ms(cell(()), "SO")
    assert estimated_ms(problem, "LOC", "SO", 24)[14:] == pytest.approx([usual_ms] * 10, rel=0.1)


def test_a_longer_delay_is_no_rate() -> None:
    late = [LinkDisturbance("R", "E", add_delay_ms=Uniform(20.0, 24.0))]
    problem = cell(late, lidar=300_000)
    estimates = estimated_ms(problem, "LOC", "SO")
    assert estimates[4:] == pytest.approx([true_l95_ms(problem, "SO")] * 8, rel=0.02)


# ------------------------------------------------------------------------------ the rate alone


def extra_ms(loads: Sequence[int], mbps: float, delay_ms: float = 0.0) -> Callable[[float], Floats]:
    """Extra delays of messages that were sent at a rate, with a delay and some noise."""
    noise_ms = np.random.default_rng(1).uniform(-0.2, 0.2, len(loads))
    bits = 8.0 * np.array(loads)
    return lambda at: bits / 1e3 / mbps - bits / 1e3 / at + delay_ms + noise_ms


@pytest.mark.parametrize("delay_ms", [0.0, 15.0])
@pytest.mark.parametrize("mbps", [3.0, 20.0, 300.0])
def test_two_loads_show_the_rate(mbps: float, delay_ms: float) -> None:
    extra = extra_ms([500, 200_000] * 5, mbps, delay_ms)
    found = better_rate(extra, 940.0, 940.0, 0.1)
    assert found is not None
    assert found.mbps == pytest.approx(mbps, rel=max(4 * found.error, 0.001))
    assert 0 < found.error < 0.05
    # Another rate than the one that is known is looked for only where it explains more.
    assert better_rate(extra, found.mbps, 940.0, 0.1) is None


def test_one_load_does_not_show_the_rate() -> None:
    assert better_rate(extra_ms([200_000] * 10, 20.0), 940.0, 940.0, 0.1) is None


def test_no_message_shows_nothing() -> None:
    assert better_rate(extra_ms([], 20.0), 940.0, 940.0, 0.1) is None


def test_messages_at_the_declared_rate_show_that_rate() -> None:
    found = better_rate(extra_ms([500, 200_000] * 5, 940.0), 20.0, 940.0, 0.1)
    assert found is not None
    assert found.mbps == 940.0
