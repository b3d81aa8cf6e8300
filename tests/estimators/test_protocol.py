"""What an estimator is, and which of ours learn from evidence."""

from __future__ import annotations

import pytest

from dwell.estimators import Estimator, Learner
from dwell.estimators.registry import REGISTRY, by_name
from tests.cells.small import make_problem


@pytest.mark.parametrize("name", REGISTRY)
def test_those_that_learn_are_told_of_every_window(name: str) -> None:
    estimator = by_name(name, make_problem())
    assert isinstance(estimator, Estimator)
    assert isinstance(estimator, Learner) == (name != "profile")
