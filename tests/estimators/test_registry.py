"""Estimators by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from dwell.errors import ProblemError
from dwell.estimators import Corrected, Estimator, Profile, by_name
from dwell.estimators.registry import REGISTRY, resolved, shadowing
from dwell.model import Constant, Execution, Node, QoS, Task
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
    sent = getattr(by_name(name, PROBLEM), "shadow_fraction", 0.0)
    most = max(sent.values()) if isinstance(sent, Mapping) else sent
    assert (most > 0) == (name in shadowing())


class Unsure:
    """An estimator that states its errors."""

    states_errors = True

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Know nothing."""
        return {}


class Silent(Unsure):
    """One that does not."""

    states_errors = False


@pytest.mark.parametrize(
    ("estimator", "windows"),
    [
        ("profile", 3),
        ("shadow", 0),
        ("scaling", 0),
        ("corrected", 0),
        (Corrected(PROBLEM), 0),
        (f"{__name__}:Unsure", 0),
        (f"{__name__}:Silent", 3),
        (Unsure(), 0),
        (Silent(), 3),
    ],
)
def test_the_dwell_depends_on_the_errors_that_an_estimator_states(
    estimator: Estimator | str, windows: int
) -> None:
    open_ = replace(PROBLEM, controller=replace(PROBLEM.controller, min_dwell=None))
    assert resolved(open_, estimator).controller.min_dwell == windows
    given = replace(PROBLEM, controller=replace(PROBLEM.controller, min_dwell=7))
    assert resolved(given, estimator).controller.min_dwell == 7


def test_every_estimator_has_a_style_of_its_own() -> None:
    assert sorted(entry.style for entry in REGISTRY.values()) == list(range(len(REGISTRY)))
