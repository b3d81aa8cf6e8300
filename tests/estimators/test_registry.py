"""Estimators by name."""

from __future__ import annotations

import pytest

from dwell.errors import ProblemError
from dwell.estimators import Estimator, Profile, by_name
from dwell.estimators.registry import REGISTRY, shadowing
from dwell.model import Constant, Execution, Node, Task
from tests.cells.generated import make_problem

PROBLEM = make_problem([Node("R1", "robot")], [Task("only", {"R1": Execution(Constant(1.0))})])


@pytest.mark.parametrize("name", list(REGISTRY))
def test_every_name_makes_an_estimator(name: str) -> None:
    assert isinstance(by_name(name, PROBLEM), Estimator)


def test_the_default_profile() -> None:
    profile = by_name("profile", PROBLEM)
    assert isinstance(profile, Profile)
    assert profile.l95_ms == {"LOC": 1.0}


def test_an_unknown_name() -> None:
    with pytest.raises(ProblemError, match="unknown estimator 'profil'; did you mean 'profile'"):
        by_name("profil", PROBLEM)


@pytest.mark.parametrize("name", list(REGISTRY))
def test_those_that_send_shadow_jobs_say_so(name: str) -> None:
    sent = getattr(by_name(name, PROBLEM), "shadow_fraction", 0.0) > 0
    assert sent == (name in shadowing())


def test_every_estimator_has_a_style_of_its_own() -> None:
    assert sorted(entry.style for entry in REGISTRY.values()) == list(range(len(REGISTRY)))
