"""Estimators by name."""

from __future__ import annotations

import pytest

from dwell.errors import ProblemError
from dwell.estimators import Estimator, Profile, by_name
from dwell.estimators.registry import REGISTRY
from dwell.model import Constant, Execution, Node, Task
from dwell.model.problem import ESTIMATORS
from tests.generate import make_problem

PROBLEM = make_problem([Node("R1", "robot")], [Task("only", {"R1": Execution(Constant(1.0))})])


def test_the_registry_has_the_names_that_a_cell_may_use() -> None:
    assert tuple(REGISTRY) == ESTIMATORS


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
