"""What the access control of a cell lets pass: what its wiring uses, from who uses it, no more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dwell
from dwell.live.trust.acl import access_control
from dwell.live.trust.permissions import subjects
from dwell.live.trust.roster import Roster, Subject
from dwell.live.wire import channels
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from tests.cells.generated import random_problem
from tests.cells.once import with_windows
from tests.live.memory_transport import MemoryTransport, matcher
from tests.live.small_world import Alternating, Counting, World, stateful
from tests.live.trust.rosters import LIFE, roster_of

NOBODY = "nobody.1"


class Wall:
    """Decides as Zenoh does, by the configuration alone."""

    def __init__(self, configuration: Mapping[str, Any]) -> None:
        assert configuration["enabled"]
        assert configuration["default_permission"] == "deny"
        rules = {rule["id"]: rule for rule in configuration["rules"]}
        names = {one["id"]: one["cert_common_names"] for one in configuration["subjects"]}
        assert len(rules) == len(configuration["rules"])
        assert {rule["permission"] for rule in rules.values()} == {"allow"}
        self._allowed = [
            (name, message, flow, matcher(key))
            for policy in configuration["policies"]
            for subject in policy["subjects"]
            for name in names[subject]
            for rule in (rules[number] for number in policy["rules"])
            for message in rule["messages"]
            for flow in rule["flows"]
            for key in rule["key_exprs"]
        ]

    def lets(self, name: str, key: str, message: str = "put", flow: str = "ingress") -> bool:
        return any(
            (one, what, way) == (name, message, flow) and matches(key)
            for one, what, way, matches in self._allowed
        )

    @property
    def messages(self) -> set[tuple[str, str]]:
        return {(message, flow) for _, message, flow, _ in self._allowed}


def wall_of(problem: Problem, roster: Roster) -> Wall:
    root = Keys(problem.name).root
    return Wall(access_control(roster, root, subjects(problem, roster)))


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load("examples/canonical.yaml")


def said_in(
    problem: Problem, periods: int, monkeypatch: pytest.MonkeyPatch
) -> set[tuple[str, str]]:
    """Let a cell run in memory; return who put what."""
    said: set[tuple[str, str]] = set()
    put = MemoryTransport.put

    def note(self: MemoryTransport, key: str, *rest: Any, **more: Any) -> None:
        said.add((self.who, key))
        put(self, key, *rest, **more)

    monkeypatch.setattr(MemoryTransport, "put", note)
    exec_ms = dict.fromkeys(problem.pipeline.tasks, problem.pipeline.period_ms / 20)
    policy = Alternating(*problem.candidates)
    stages = {name: Counting for name, task in problem.pipeline.tasks.items() if task.state_bytes}
    world = World(problem, exec_ms=exec_ms, policy=policy, stages=stages)
    world.run(periods * problem.pipeline.period_ms)
    world.pin(problem.initial)
    world.run(3 * problem.pipeline.period_ms)
    monkeypatch.undo()
    return said


def subject_of(problem: Problem, who: str) -> str:
    role = next(role for role in roles(problem) if role.who == who)
    return f"{CONTROLLER if role.kind == 'controller' else role.node}.1"


def test_whatever_a_cell_says_may_be_said(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With states that move, and with shadows."""
    settings = replace(problem.controller, estimator="shadow", min_dwell=1)
    moving = stateful(problem, "planning", 100)
    problem = with_windows(replace(moving, controller=settings), 20)
    wall = wall_of(problem, roster_of(problem))
    said = said_in(problem, 200, monkeypatch)
    assert {who for who, _ in said} == {role.who for role in roles(problem)}
    assert {key.split("/")[2] for _, key in said} == {
        *("in", "sink", "done", "beat", "beats", "relay", "carried", "gathered", "load", "ended"),
        *("order", "accepted", "stamped", "snapshot", "state", "restored", "answer"),
    }
    denied = {(who, key) for who, key in said if not wall.lets(subject_of(problem, who), key)}
    assert not denied


@settings(max_examples=5)
@given(st.integers(0, 2**32))
def test_any_cell_may_say_what_it_has_to(seed: int) -> None:
    problem = random_problem(Random(seed))
    with pytest.MonkeyPatch.context() as patch:
        said = said_in(problem, 12, patch)
    wall = wall_of(problem, roster_of(problem))
    denied = {(who, key) for who, key in said if not wall.lets(subject_of(problem, who), key)}
    assert not denied


@given(st.integers(0, 2**32), st.data())
def test_nobody_else_may(seed: int, data: st.DataObject) -> None:
    problem = random_problem(Random(seed))
    roster = roster_of(problem)
    wall, may_put = wall_of(problem, roster), subjects(problem, roster)
    assert wall.messages == {
        ("put", "ingress"), ("put", "egress"),
        ("declare_subscriber", "ingress"), ("declare_subscriber", "egress"),
    }  # fmt: skip
    everybody = [subject.common_name for subject in roster.subjects.values()]
    key = data.draw(st.sampled_from(sorted(may_put)))
    for name in (*everybody, NOBODY):
        allowed = name.removesuffix(".1") in may_put[key]
        assert wall.lets(name, key.replace("*", "visitor-1")) == allowed
        assert not wall.lets(name, f"{key}/more")
        assert not wall.lets(name, key.replace(f"dwell/{problem.name}", "dwell/another"))
    # Everybody who is known hears; nobody else does.
    for expression in (key, f"dwell/{problem.name}/**"):
        assert all(wall.lets(name, expression, "declare_subscriber") for name in everybody)
        assert not wall.lets(NOBODY, expression, "declare_subscriber")
        assert not wall.lets(NOBODY, key, flow="egress")


def test_who_is_revoked_is_nobody(problem: Problem) -> None:
    keys = Keys(problem.name)
    wall = wall_of(problem, roster_of(problem, without="R2"))
    assert not wall.lets("R2.1", keys.of(channels.DONE, "control"))
    assert not wall.lets("R2.1", keys.of(channels.DONE, "control"), "declare_subscriber")
    # What follows a revoked certificate has another name in it.
    wall = wall_of(problem, roster_of(problem, generation=2))
    assert not wall.lets("R2.1", keys.of(channels.DONE, "control"))
    assert wall.lets("R2.2", keys.of(channels.DONE, "control"))


def test_a_name_alone_gives_no_role(problem: Problem) -> None:
    """An observer who is named like a node, or a node like the controller, is neither."""
    keys = Keys(problem.name)
    roster = roster_of(problem)
    changed = {
        "E": Subject("E", "observer", 1, 1, "", *LIFE),
        CONTROLLER: Subject(CONTROLLER, "node", 1, 2, "", *LIFE),
    }
    wall = wall_of(problem, Roster(problem.name, 1, {**roster.subjects, **changed}))
    assert not wall.lets("E.1", keys.of(channels.LOAD, "E"))
    assert not wall.lets("controller.1", keys.of(channels.ORDER))
    assert wall.lets("E.1", keys.of(channels.LOOK))


def test_an_empty_roster_lets_nothing_pass(problem: Problem) -> None:
    wall = wall_of(problem, Roster(problem.name, 1, {}))
    assert not wall.messages
