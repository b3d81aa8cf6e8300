"""A policy of a user's own: it cannot change what is recorded, and its errors have its name."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

import dwell
from dwell.errors import KernelError, MetricError, UserNote, user_note
from dwell.model import Problem, QoS
from dwell.policies import DTP
from tests.cells.small import make_problem

PROBLEM = make_problem()

Estimates = Mapping[str, QoS]
Change = Callable[[Any], object]


class Changes:
    """Does something to the estimates at its second window."""

    def __init__(self, change: Change) -> None:
        self.change = change
        self.windows = 0

    def decide(self, *, observed: QoS, estimates: Estimates) -> str:
        self.windows += 1
        if self.windows == 2:
            self.change(estimates)
        return "LOC"


class Raises:
    """Raises in one of its methods."""

    def __init__(self, method: str, error: Exception) -> None:
        self.method, self.error = method, error

    def fail_in(self, method: str) -> None:
        if method == self.method:
            raise self.error

    def start(self, problem: Problem) -> None:
        self.fail_in("start")

    def adopt(self, name: str) -> None:
        self.fail_in("adopt")

    def decide(self, *, observed: QoS, estimates: Estimates) -> str:
        self.fail_in("decide")
        return "SO"


class Late(DTP):
    """One of ours, with a method of a user's."""

    def start(self, problem: Problem) -> None:
        raise ValueError("not today")


class Positional:
    def decide(self, observed: QoS) -> str:
        return "LOC"


class Locked:
    def __init__(self) -> None:
        self.lock = threading.Lock()

    def decide(self, *, observed: QoS, estimates: Estimates) -> str:
        return "LOC"


@contextmanager
def blaming(error: type[Exception], *words: str) -> Iterator[None]:
    """Assert that an error is raised as it is, with a note that has some words."""
    with pytest.raises(error) as caught:
        yield
    origin = user_note(caught.value)
    assert origin is not None
    for word in words:
        assert word in origin


@pytest.mark.parametrize(
    "change",
    [
        lambda estimates: estimates.__setitem__("SO", replace(estimates["SO"], l95_ms=1.0)),
        lambda estimates: estimates.pop("LOC"),
        lambda estimates: estimates.update(SO=estimates["LOC"]),
        lambda estimates: estimates.clear(),
    ],
)
def test_estimates_cannot_be_changed(change: Change) -> None:
    with blaming(TypeError, "Changes: decide at window 1 failed: TypeError: ", "test_user_policy"):
        dwell.simulate(PROBLEM, policy=Changes(change), seed=1, windows=4)


def test_a_copy_of_estimates_can_be_changed_and_the_record_has_them_as_made() -> None:
    def forget(estimates: Estimates) -> None:
        mine = dict(estimates)
        del mine["LOC"]
        mine["SO"] = replace(mine["SO"], l95_ms=1.0)

    mine, ours = (
        dwell.simulate(PROBLEM, policy=policy, seed=1, windows=4).decisions
        for policy in (Changes(forget), "LOC")
    )
    columns = [name for name in mine.columns if name.startswith("est_")]
    assert columns
    assert mine.select(columns).equals(ours.select(columns))


@pytest.mark.parametrize("method", ["start", "decide"])
def test_an_error_of_a_policy_has_its_name(method: str) -> None:
    policy = Raises(method, KeyError("LOC"))
    with blaming(KeyError, f"Raises: {method} ", "failed: KeyError: 'LOC' (test_user_policy.py:"):
        dwell.simulate(PROBLEM, policy=policy, seed=1, windows=4)


def test_an_error_in_a_move_of_the_guard_has_the_policys_name() -> None:
    down = dwell.model.NodeDisturbance("E", at_s=3.0, for_s=4.0, down=True)
    settings = replace(PROBLEM.controller, fallbacks=("LOC",), initial="SO", on="R1")
    problem = replace(
        PROBLEM, controller=settings, scenarios={**PROBLEM.scenarios, "crash": (down,)}
    )
    policy = Raises("adopt", RuntimeError("moved"))
    with blaming(RuntimeError, "Raises: adopt at window ", "failed: RuntimeError: moved"):
        dwell.simulate(problem, scenario="crash", policy=policy, seed=1, windows=30, guard=True)


@pytest.mark.parametrize(
    ("policy", "error", "words"),
    [
        (
            Late.from_problem(PROBLEM),
            ValueError,
            "Late: start failed: ValueError: not today (test_user_policy.py:",
        ),
        (
            Raises("decide", MetricError("l95_ms is -1")),
            MetricError,
            "Raises: decide at window 0 failed: MetricError: l95_ms is -1 (test_user_policy.py:",
        ),
        (Positional(), TypeError, "Positional: decide at window 0 failed: TypeError: Positional."),
        (Locked(), TypeError, "Locked: start failed: TypeError: cannot pickle"),
    ],
)
def test_other_errors_have_the_name_too(policy: Any, error: type[Exception], words: str) -> None:
    with blaming(error, words):
        dwell.simulate(PROBLEM, policy=policy, seed=1, windows=4)


def test_an_error_of_the_kernel_is_no_fault_of_the_policy() -> None:
    policy = Raises("decide", KernelError("it is damaged", "install it again"))
    with pytest.raises(KernelError) as caught:
        dwell.simulate(PROBLEM, policy=policy, seed=1, windows=4)
    assert user_note(caught.value) is None


def test_an_error_of_our_own_policies_has_no_note() -> None:
    with pytest.raises(MetricError) as caught:
        DTP.from_problem(PROBLEM).decide(observed=QoS(1.0, 0.0, {}), estimates={})
    assert user_note(caught.value) is None


def test_a_note_of_another_kind_is_no_origin() -> None:
    error = ValueError("no frame")
    error.add_note("of somebody else's")
    assert user_note(error) is None
    error.add_note(UserNote("Mine: decide failed"))
    assert user_note(error) == "Mine: decide failed"
