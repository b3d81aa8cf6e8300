"""Who may put what: by the cell file and the roster."""

from __future__ import annotations

from dataclasses import replace

import pytest

import dwell
from dwell.live.trust.permissions import senders, subjects
from dwell.live.wire import channels
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from tests.live.trust.rosters import roster_of


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load("examples/canonical.yaml")


def test_who_may_put_what_in_the_canonical_cell(problem: Problem) -> None:
    root = f"dwell/{problem.name}"
    robots, both = {"R1", "R2"}, {"E", "R1"}
    expected: dict[str, set[str]] = {
        "in/sensing/R1/main": {"R1"},
        "in/perception/R1/main": {"R1"},
        "in/perception/R1/shadow": {"R1"},
        "in/perception/E/main": {"R1"},
        "in/perception/E/shadow": {"R1"},
        "in/planning/R2/main": both,
        "in/planning/R2/shadow": both,
        "in/planning/E/main": both,
        "in/planning/E/shadow": both,
        "in/control/R2/main": {"E", "R2"},
        "in/control/R2/shadow": {"E", "R2"},
        "sink/control": {"R2"},
        "done/control": {"R2"},
        "ended": {*robots, "E"},
        "stamped": {"R1"},
        "missed": {"R1"},
        "accepted": {"R1"},
        "order": {CONTROLLER},
        "answer/*": {CONTROLLER},
        "carried": {"E"},
        "gathered": {"E"},
        "restored": {*robots, "E"},
        "ask": {CONTROLLER, "operator"},
        "look": {CONTROLLER, "operator", "observer"},
    }
    for task, nodes in (("perception", both), ("planning", {"E", "R2"})):
        for node in nodes:
            expected[f"snapshot/{task}/{node}"] = {CONTROLLER}
            for source in nodes - {node}:
                expected[f"state/{task}/{node}/{source}"] = {source}
    for node in ("R1", "E", "R2"):
        expected[f"load/{node}"] = expected[f"beats/{node}"] = {node}
    for role in roles(problem):
        sender = CONTROLLER if role.kind == "controller" else role.node
        expected[f"beat/{role.node}/{role.who}"] = {sender}
    twice = {"done/control", "ended", "accepted"}
    expected |= {
        f"relay/{key}": who
        for key, who in expected.items()
        if key in twice or key.startswith(("beat/", "load/"))
    }
    found = subjects(problem, roster_of(problem))
    assert {key.removeprefix(f"{root}/"): set(names) for key, names in found.items()} == expected


def test_frames_are_asked_for_by_the_source_where_they_begin_the_cycles(problem: Problem) -> None:
    frame = Keys(problem.name).of(channels.FRAME)
    assert frame not in senders(problem)
    framed = replace(problem, live=replace(problem.live, release="frames"))
    assert senders(framed)[frame] == {"R1"}
