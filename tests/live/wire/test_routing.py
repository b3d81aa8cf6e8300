"""Where messages go, by the stamp alone."""

from __future__ import annotations

import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.wire.messages import Stamp
from dwell.live.wire.routing import STAMPER, Destination, Routes
from dwell.model import Problem


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


def test_an_unknown_candidate_says_that_cell_files_differ(problem: Problem) -> None:
    with pytest.raises(LiveError, match=r"'NEW', which is no candidate here .*cell files differ"):
        Routes(problem).destinations("sensing", stamp("NEW"))
    with pytest.raises(LiveError, match="cell files differ"):
        Routes(problem).destinations("sensing", stamp("LOC", "NEW"))
