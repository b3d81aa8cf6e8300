"""What a scenario does when, and what nodes and links are like then."""

from __future__ import annotations

from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.errors import LiveError, ProblemError
from dwell.model import Constant, Disturbance, Problem
from dwell.testbed.timeline import changes_of, is_down, link_changes, link_with, threads_on
from tests.testbed.light_cell import document


def cell(*items: dict[str, Any]) -> Problem:
    return from_document(document(scenarios={"some": list(items)}))


def test_changes_come_in_the_order_of_time_ends_before_beginnings() -> None:
    problem = cell(
        {"node": "E", "at_s": 5, "stress_threads": 1},
        {"node": "R1", "at_s": 2, "for_s": 3, "stress_threads": 2},
    )
    found = [(change.at_s, change.begins) for change in changes_of(problem, "some")]
    # What lasts for ever never ends.
    assert found == [(2, True), (5, False), (5, True)]


def test_equal_items_are_told_apart_by_their_places() -> None:
    twice = {"node": "E", "at_s": 1, "for_s": 2, "stress_threads": 1}
    problem = cell(twice, {**twice})
    on: dict[int, Disturbance] = {}
    threads = []
    for change in changes_of(problem, "some"):
        on = change.made(on)
        threads.append(threads_on("E", on.values()))
    assert threads == [1, 2, 1, 0]


def test_threads_of_a_node_add_up() -> None:
    problem = cell(
        {"node": "E", "stress_threads": 1},
        {"node": "E", "stress_threads": 2},
        {"node": "R1", "stress_threads": 4},
    )
    assert threads_on("E", problem.scenario("some")) == 3
    assert threads_on("R2", problem.scenario("some")) == 0


def test_a_link_is_what_all_that_is_on_makes_of_it() -> None:
    problem = cell(
        {"link": "R1->E", "loss": 0.5, "rate_mbps": 20},
        {"link": "R1->E", "loss": 0.5, "rate_mbps": 10, "add_delay_ms": 25},
        {"link": "E->R1", "loss": 0.9},
    )
    link = problem.fabric.links["R1->E"]
    on = problem.scenario("some")
    found = link_with(link, on)
    assert found.loss == pytest.approx(0.75)
    assert found.rate_mbps == 10
    assert found.add_delay_ms == Constant(25.0)
    usual = link_with(link, ())
    assert (usual.loss, usual.rate_mbps, usual.delay_ms) == (0.0, 1000, link.delay_ms)
    # A delay that stays is not set anew: it may have a memory.
    assert link_changes(link, on[:1], on[:2]).keys() == {"add_delay_ms", "rate_mbps", "loss"}
    assert link_changes(link, on[1:], on) == {"loss": pytest.approx(0.75)}
    assert link_changes(link, on, on) == {}


def test_an_outage_is_played_where_it_can_be() -> None:
    problem = cell({"node": "R2", "down": True, "for_s": 3}, {"link": "R1->E", "down": True})
    with pytest.raises(LiveError, match=r"R2 cannot be taken down here; R1->E cannot be taken"):
        changes_of(problem, "some")
    changes = changes_of(problem, "some", outages=True)
    assert len(changes) == 3
    assert is_down("R2", problem.scenario("some"))
    assert is_down("R1->E", problem.scenario("some"))
    assert not is_down("E->R1", problem.scenario("some"))


def test_what_cannot_be_played_is_told_all_at_once() -> None:
    problem = cell(
        {"node": "E", "stress_threads": 4, "at_s": 0, "for_s": 60, "ramp_s": 10},
        {"link": "R1->E", "loss": 0.1, "episodes": {"name": "x", "every_s": 10, "for_s": 2}},
        {"link": "E->R2", "add_delay_ms": 5, "at_s": 0, "for_s": 10},
        {"link": "E->R2", "add_delay_ms": 5, "at_s": 5},
    )
    with pytest.raises(LiveError) as caught:
        changes_of(problem, "some")
    for part in ("ramp of 10 s", "episodes", "E->R2 gets two extra delays"):
        assert part in str(caught.value)


def test_delays_one_after_the_other_are_fine() -> None:
    problem = cell(
        {"link": "E->R2", "add_delay_ms": 5, "at_s": 0, "for_s": 10},
        {"link": "E->R2", "add_delay_ms": 9, "at_s": 10},
    )
    assert len(changes_of(problem, "some")) == 3


def test_an_unknown_scenario_is_an_error() -> None:
    with pytest.raises(ProblemError, match="unknown scenario 'nome'"):
        changes_of(cell({"node": "E", "stress_threads": 1}), "nome")
