"""The phase of a cell: everything is later by it, and nothing else is otherwise."""

from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.model import Problem, evolve
from tests.live.small_world import World

EXAMPLES = Path(__file__).parents[2] / "examples"


def of_no_clock_but_its_own() -> Problem:
    """A cell in which nothing happens by the run's time alone."""
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    bursts = {
        f"nodes.{name}.bursts": None for name, one in problem.fabric.nodes.items() if one.bursts
    }
    links = enumerate(problem.fabric.links.values())
    return evolve(
        problem, {**bursts, **{f"links[{i}].bursts": None for i, one in links if one.bursts}}
    )


@pytest.mark.parametrize("policy", ["SO", "dtp+corrected"])
def test_every_instant_is_later_by_it_and_every_latency_the_same(policy: str) -> None:
    problem = of_no_clock_but_its_own()
    later = evolve(problem, {"phase_ms": 12.5})
    first, second = (
        dwell.simulate(one, policy=policy, seed=3, windows=8, guard=True)
        for one in (problem, later)
    )
    assert (second.cycles["release_ns"] - first.cycles["release_ns"]).unique().to_list() == [
        12_500_000
    ]
    assert second.cycles["latency_ns"].equals(first.cycles["latency_ns"])
    assert second.cycles["outcome"].equals(first.cycles["outcome"])
    assert second.decisions["placement"].equals(first.decisions["placement"])
    for name in ("l95_ms", "violation_rate", "u_R1", "u_E", "cost"):
        assert second.windows[name].to_list() == pytest.approx(first.windows[name].to_list())


def test_what_happens_by_the_runs_time_is_met_later_in_a_cycle() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    runs = [
        dwell.simulate(one, scenario="edge-cpu-stress", policy="SO", seed=1, windows=8)
        for one in (problem, evolve(problem, {"phase_ms": 20.0}))
    ]
    assert not runs[0].cycles["latency_ns"].equals(runs[1].cycles["latency_ns"])


@pytest.mark.parametrize("phase_ms", [-1.0, 1e3])
def test_it_is_from_0_to_below_the_period(phase_ms: float) -> None:
    with pytest.raises(ProblemError, match="phase_ms"):
        evolve(of_no_clock_but_its_own(), {"phase_ms": phase_ms})


def test_a_live_cell_refuses_it_by_name() -> None:
    with pytest.raises(
        ProblemError, match=r"phase_ms: 5\.0 is not allowed; it must be 0 in a live"
    ):
        World(evolve(of_no_clock_but_its_own(), {"phase_ms": 5.0}))


def test_frames_refuse_it_by_name() -> None:
    with pytest.raises(ProblemError, match=r"live\.release: 'frames' is not allowed"):
        evolve(of_no_clock_but_its_own(), {"phase_ms": 5.0, "live.release": "frames"})
