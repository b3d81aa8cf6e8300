"""What a scenario's realisation does when, and what nodes and links are like then."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.errors import LiveError, ProblemError
from dwell.live.local.conditions import Conditions
from dwell.live.local.playing import play
from dwell.live.local.timeline import (
    Change,
    NodeState,
    Timeline,
    last_ns,
    timeline_of,
    usual_conditions,
)
from dwell.model import Constant, NodeDisturbance, Problem
from dwell.model.instants import NEVER_NS
from dwell.sim import Realisation, draw
from tests.cells.light import document

EPISODES = {
    "name": "wind",
    "every_s": {"exponential": {"mean": 2}},
    "for_s": {"normal": {"mean": 1, "std": 0.2}},
}
#: Episodes on a node and a link, ramps on both, and two delays at once.
MIXED: list[dict[str, Any]] = [
    {"link": "R1->E", "add_delay_ms": 5, "loss": 0.1, "episodes": EPISODES},
    {"link": "R1->E", "add_delay_ms": 31, "at_s": 4, "for_s": 20, "ramp_s": 6, "rate_mbps": 10},
    {"link": "R1->E", "add_delay_ms": 7, "loss": 0.2, "at_s": 2, "for_s": 12},
    {"link": "E->R1", "down": True, "at_s": 3, "for_s": 2},
    {"node": "E", "stress_threads": 1, "episodes": EPISODES},
    {"node": "E", "stress_threads": 4, "at_s": 1, "for_s": 24, "ramp_s": 8},
    {"node": "R2", "down": True, "at_s": 6, "for_s": 3},
]
SECONDS = 30.0
LINK = from_document(document()).fabric.links["R1->E"]


def cell(*items: dict[str, Any], **more: Any) -> Problem:
    return from_document(document(scenarios={"some": list(items)}, **more))


def planned(*items: dict[str, Any], seconds: float = SECONDS) -> Timeline:
    return timeline_of(cell(*items), "some", seed=1, seconds=seconds, outages=True)


def threads_of(timeline: Timeline, node: str) -> list[tuple[float, int]]:
    return [
        (change.at_s, change.state.threads)
        for change in timeline.changes
        if change.place == node and not isinstance(change.state, Conditions)
    ]


def conditions_of(timeline: Timeline, link: str) -> list[Conditions]:
    return [
        change.state
        for change in timeline.changes
        if change.place == link and isinstance(change.state, Conditions)
    ]


class Recording:
    """A testbed that writes down what it is made to do."""

    def __init__(self) -> None:
        self.at_s = 0.0
        self.applied: list[Change] = []

    def sleep(self, seconds: float) -> None:
        self.at_s += seconds

    def play(self, timeline: Timeline, seconds: float) -> None:
        play(timeline.changes, seconds, lambda: self.at_s, self.applied.append, lambda at_s: None)


def extra_ns(drawn: Realisation, link: str, layers: tuple[int, ...]) -> int:
    """Extra delay of a link's messages, whose processes are constant, in some of its layers."""
    if not layers:
        return 0
    hop = next(hop for hop, (_, _, name) in enumerate(drawn.hops) if name == link)
    rows = [drawn.layers.index((hop, layer)) for layer in layers]
    return int(drawn.extra_ns[rows, 0].sum())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_is_applied_is_what_the_simulator_draws(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = cell(*MIXED)
    testbed = Recording()
    # Of this module only: threads that other tests have left behind sleep on.
    monkeypatch.setattr("dwell.live.local.playing.time", SimpleNamespace(sleep=testbed.sleep))
    timeline = timeline_of(problem, "some", seed=seed, seconds=SECONDS, outages=True)
    testbed.play(timeline, SECONDS)
    drawn = draw(problem, scenario="some", seed=seed, windows=40)
    # It has episodes, and all of a ramp.
    assert len(testbed.applied) > 60
    nodes = [
        (change.at_ns, change.place, change.state.threads, change.state.down)
        for change in testbed.applied
        if isinstance(change.state, NodeState)
    ]
    assert nodes == [tuple(one) for one in drawn.node_changes if one.at_ns < SECONDS * 1e9]
    for link in ("R1->E", "E->R1"):
        segments = [
            segment
            for segment in drawn.link_segments
            if segment.link == link and 0 < segment.at_ns < SECONDS * 1e9
        ]
        applied = [change for change in testbed.applied if change.place == link]
        assert [change.at_ns for change in applied] == [segment.at_ns for segment in segments]
        for change, segment in zip(applied, segments, strict=True):
            state = change.state
            assert isinstance(state, Conditions)
            assert (state.loss, state.rate_mbps) == (segment.loss, segment.rate_mbps)
            assert state.down == segment.down
            pairs = zip(state.add_delays_ms, state.shares, strict=True)
            delay_ns = sum(delay.expectation * share for delay, share in pairs) * 1e6
            assert delay_ns == pytest.approx(extra_ns(drawn, link, segment.layers), abs=5)


def test_episodes_are_drawn_by_the_seed() -> None:
    problem = cell(*MIXED)
    found = [timeline_of(problem, "some", seed=s, seconds=30, outages=True) for s in (1, 1, 2)]
    assert found[0] == found[1]
    assert found[0] != found[2]
    assert all(item.episodes is None for item in found[0].items)


def test_bursts_are_no_part_of_it() -> None:
    nodes = document()["nodes"]
    nodes["E"]["bursts"] = {"every_ms": 100, "for_ms": 10, "threads": 1}
    links = [dict(link) for link in document()["links"]]
    links[0]["bursts"] = {"every_ms": 100, "for_ms": 10, "add_delay_ms": 5}
    bursty = cell(*MIXED, nodes=nodes, links=links)
    found = timeline_of(bursty, "some", seed=1, seconds=SECONDS, outages=True)
    assert found == planned(*MIXED)


def test_threads_of_a_node_add_up() -> None:
    twice = {"node": "E", "at_s": 1, "for_s": 2, "stress_threads": 1}
    found = planned(twice, {**twice, "at_s": 2}, {"node": "R1", "stress_threads": 4})
    assert threads_of(found, "E") == [(1, 1), (2, 2), (3, 1), (4, 0)]
    # What lasts for ever never ends.
    assert threads_of(found, "R1") == [(0, 4)]
    assert threads_of(found, "R2") == []


def test_a_link_is_what_all_that_is_on_makes_of_it() -> None:
    (both,) = conditions_of(
        planned(
            {"link": "R1->E", "loss": 0.5, "rate_mbps": 20, "add_delay_ms": 5},
            {"link": "R1->E", "loss": 0.5, "rate_mbps": 10, "add_delay_ms": 25},
            {"link": "E->R1", "loss": 0.9},
        ),
        "R1->E",
    )[:1]
    assert both.loss == pytest.approx(0.75)
    assert both.rate_mbps == 10
    assert both.add_delays_ms == (Constant(5.0), Constant(25.0))
    assert both.shares == (1.0, 1.0)


def test_a_link_is_as_it_was_when_all_is_over() -> None:
    problem = cell({"link": "R1->E", "rate_mbps": 10, "at_s": 1, "for_s": 2, "add_delay_ms": 5})
    timeline = timeline_of(problem, "some", seed=1, seconds=SECONDS)
    usual = usual_conditions(problem.fabric.links["R1->E"])
    begun, ended = conditions_of(timeline, "R1->E")
    assert begun.rate_mbps < usual.rate_mbps
    assert replace(begun, rate_mbps=usual.rate_mbps, add_delays_ms=(), shares=()) == usual
    # A delay that stays is not set anew: it may have a memory.
    assert ended == replace(begun, rate_mbps=usual.rate_mbps, shares=(0.0,))


def test_an_outage_is_played_where_it_can_be() -> None:
    problem = cell({"node": "R2", "down": True, "for_s": 3}, {"link": "R1->E", "down": True})
    with pytest.raises(LiveError, match=r"R2 cannot be taken down here; R1->E .*; a link with"):
        timeline_of(problem, "some", seed=1, seconds=SECONDS)
    found = timeline_of(problem, "some", seed=1, seconds=SECONDS, outages=True)
    states = [change.state for change in found.changes if change.place == "R2"]
    assert [getattr(state, "down", None) for state in states] == [True, False]
    assert conditions_of(found, "R1->E")[0].down
    assert conditions_of(found, "E->R1") == []


def test_an_unknown_scenario_is_an_error() -> None:
    with pytest.raises(ProblemError, match="unknown scenario 'nome'"):
        timeline_of(cell({"node": "E", "stress_threads": 1}), "nome", seed=1, seconds=1)


def test_a_loss_of_1_is_played_beside_the_own_of_its_link() -> None:
    links = conditions_of(planned({"link": "R1->E", "loss": 1, "at_s": 3, "for_s": 4}), "R1->E")
    assert [conditions.loss for conditions in links] == [1, usual_conditions(LINK).loss]


def test_a_disturbance_of_any_length_lasts() -> None:
    ends = [last_ns(NodeDisturbance("E", 1.0, for_s)) for for_s in (1e300, math.inf)]
    assert ends == [NEVER_NS, NEVER_NS]


def test_a_length_that_64_bits_do_not_hold_is_refused() -> None:
    with pytest.raises(ProblemError, match=r"seconds = 1e[+]18: .*a run"):
        planned({"node": "E", "stress_threads": 1}, seconds=1e18)
