"""Where messages go, by the stamp alone."""

from __future__ import annotations

from dataclasses import replace

import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.wire.messages import Stamp
from dwell.live.wire.routing import STAMPER, Destination, Routes
from dwell.model import Problem, Replicas


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load("examples/canonical.yaml")


def stamp(placement: str, shadow: str = "", forks: tuple[tuple[str, str], ...] = ()) -> Stamp:
    return Stamp(1, 7, 1, placement, 0, shadow, forks)


def test_a_message_goes_only_to_the_node_that_needs_it(problem: Problem) -> None:
    routes = Routes(problem)
    expected = {"LOC": ("R1", "R2"), "SO": ("E", "E"), "HYB": ("E", "R2")}
    for name, (perception, planning) in expected.items():
        found = [routes.destinations(task, stamp(name)) for task in problem.pipeline.tasks]
        assert found == [
            (Destination("perception", perception, "main"),),
            (Destination("planning", planning, "main"),),
            (Destination("control", "R2", "main"),),
            (),
        ]
    assert routes.destinations(STAMPER, stamp("SO")) == (Destination("sensing", "R1", "main"),)


@pytest.mark.parametrize(("active", "other"), [("LOC", "SO"), ("HYB", "LOC"), ("SO", "HYB")])
def test_a_shadow_is_joined_once_by_every_task_of_its_own(
    problem: Problem, active: str, other: str
) -> None:
    """Behind the parting a task gets one message a flow, from the shadow if it has the source."""
    routes, pipeline = Routes(problem), problem.pipeline
    marked = stamp(active, other)
    here, there = (problem.candidates[name].first for name in (active, other))
    apart = pipeline.diverging(here, there)
    sent = {
        (task, shadow): routes.destinations(task, marked, shadow=shadow)
        for task in pipeline.tasks
        for shadow in (False, True)
        if not shadow or task in apart
    }
    for flow in pipeline.flows:
        by = [
            (task, shadow)
            for (task, shadow), found in sent.items()
            if task == flow.source
            and Destination(flow.target, there[flow.target], "shadow") in found
        ]
        assert by == ([(flow.source, flow.source in apart)] if flow.target in apart else [])
        usual = Destination(flow.target, here[flow.target], "main")
        assert usual in sent[flow.source, False]


def test_inputs_are_forked_to_where_a_state_goes(problem: Problem) -> None:
    routes = Routes(problem)
    forked = stamp("LOC", forks=(("planning", "E"),))
    assert routes.destinations("perception", forked) == (
        Destination("planning", "R2", "main"),
        Destination("planning", "E", "main"),
    )
    impossible = stamp("LOC", forks=(("planning", "R1"),))
    assert len(routes.destinations("perception", impossible)) == 1


def test_each_copy_of_a_cycle_stays_within_its_own_placement(problem: Problem) -> None:
    members = {name: problem.candidates[name] for name in ("LOC", "SO")}
    both = Replicas(members, after_ms=10)
    routes = Routes(replace(problem, candidates={**problem.candidates, "BOTH": both}))
    known, twice = stamp("BOTH"), (("perception", "R1"), ("perception", "E"))
    assert routes.destinations(STAMPER, known) == (Destination("sensing", "R1", "main"),)
    # A common task sends to both copies, and holds the messages that only the second one gets.
    assert routes.destinations("sensing", known, "R1") == tuple(
        Destination(*to, "main", after_ns)
        for to, after_ns in zip(twice, (0, 10_000_000), strict=True)
    )
    for node, target in {"R1": "R2", "E": "E"}.items():
        found = routes.destinations("perception", known, node)
        assert found == (Destination("planning", target, "main"),)
        assert routes.runs("perception", node, known)
    for node in ("R2", "E"):
        assert routes.destinations("planning", known, node) == (
            Destination("control", "R2", "main"),
        )
    # A state leaves from the first copy.
    forked = stamp("BOTH", forks=(("planning", "R1"), ("planning", "R2")))
    assert routes.destinations("perception", forked, "E") == (Destination("planning", "E", "main"),)
    assert routes.destinations("perception", forked, "R1") == (
        Destination("planning", "R2", "main"),
    )


def test_an_unknown_candidate_says_that_cell_files_differ(problem: Problem) -> None:
    with pytest.raises(LiveError, match=r"'NEW', which is no candidate here .*cell files differ"):
        Routes(problem).destinations("sensing", stamp("NEW"))
    with pytest.raises(LiveError, match="cell files differ"):
        Routes(problem).destinations("sensing", stamp("LOC", "NEW"))
