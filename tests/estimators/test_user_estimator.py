"""An estimator of a user's own: what it cannot change, and what is said where it fails."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

import dwell
from dwell.errors import MetricError, user_note
from dwell.estimators import Evidence, Profile, Support
from dwell.model import Problem, QoS
from tests.cells.small import make_problem

PROBLEM = make_problem()


class Own:
    """The profile; raises in one of its methods."""

    def __init__(self, method: str = "") -> None:
        self.method = method

    def fail_in(self, method: str) -> None:
        if method == self.method:
            raise KeyError("SO")

    def start(self, problem: Problem) -> None:
        self.fail_in("start")
        self.profile = Profile(problem)

    def learn(self, evidence: Evidence) -> None:
        self.fail_in("learn")

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        self.fail_in("estimate")
        return self.profile.estimate(observed=observed, incumbent=incumbent, own=own)

    def support(self) -> Any:
        self.fail_in("support")
        return dict.fromkeys(PROBLEM.candidates, Support(1.0, 1.0))


class Writes(Own):
    """Writes into what it is shown."""

    def learn(self, evidence: Evidence) -> None:
        evidence.release_ns[:] = 0
        evidence.placement[:] = 0
        evidence.cycles.end_ns[:] = 0


class Answers(Own):
    """Gives a fixed answer."""

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self.answer = answer

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        return self.answer  # type: ignore[no-any-return]


class Listens(Profile):
    """One of ours that learns, too, and knows what supports it."""

    windows = 0

    def learn(self, evidence: Evidence) -> None:
        self.windows += 1

    def support(self) -> dict[str, Support]:
        return dict.fromkeys(PROBLEM.candidates, Support(float(self.windows), 0.0))


class First:
    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(iter(estimates))


@pytest.mark.parametrize("method", ["start", "learn", "estimate", "support"])
def test_an_error_of_an_estimator_has_its_name(method: str) -> None:
    with pytest.raises(KeyError) as caught:
        dwell.simulate(PROBLEM, policy="dtp", estimator=Own(method), seed=1, windows=4)
    origin = str(user_note(caught.value))
    assert origin.startswith(f"Own: {method}")
    assert "failed: KeyError: 'SO' (test_user_estimator.py:" in origin


@pytest.mark.parametrize("estimator", [Own(), Listens(PROBLEM)])
def test_a_method_that_a_class_adds_is_used(estimator: Own | Listens) -> None:
    run = dwell.simulate(PROBLEM, policy="dtp", estimator=estimator, seed=1, windows=4)
    expected = [1.0, 2.0, 3.0, 4.0] if isinstance(estimator, Listens) else [1.0] * 4
    assert run.decisions["est_samples_SO"].to_list() == expected


def test_evidence_that_is_written_to_changes_no_realisation() -> None:
    realisation = dwell.draw(PROBLEM, seed=1, windows=5)
    ours, theirs, again = (
        dwell.simulate_realisation(PROBLEM, realisation, policy="SO", estimator=estimator)
        for estimator in ("profile", Writes(), "profile")
    )
    assert ours.cycles.equals(theirs.cycles)
    assert ours.cycles.equals(again.cycles)


@pytest.mark.parametrize("policy", ["dtp", First()])
@pytest.mark.parametrize("answer", [{}, {"LOC": None, "SO": 3}])
def test_a_candidate_without_an_estimate_is_named(policy: Any, answer: Any) -> None:
    told = r"Answers\.estimate returned no QoS for LOC at window 0; .* for each of LOC, SO, HYB"
    with pytest.raises(MetricError, match=told):
        dwell.simulate(PROBLEM, policy=policy, estimator=Answers(answer), seed=1, windows=4)
