"""What the numbers of a study depend on: versions, sources, and what contenders are."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import pytest

import dwell
from dwell.errors import SimulationError
from dwell.kernels import library
from dwell.model.qos import QoS
from dwell.study import Contender, Point
from dwell.study.software import describe, software, versions
from tests.cells.small import make_problem
from tests.study.test_study import make_study, with_delay

PROBLEM = make_problem()


@dataclass
class Patient:
    """A policy with a state."""

    windows: int = 3

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(iter(estimates))


def test_versions_are_those_of_what_is_installed() -> None:
    assert versions()["dwell"] == dwell.__version__
    assert versions().keys() == {"dwell", "numpy", "kernel", "python", "polars"}
    assert software().keys() - versions().keys() == {"sources"}


def test_the_kernel_is_known_by_its_sources_whoever_compiled_them() -> None:
    digest = library.digest()[:16]
    assert versions()["kernel"] == f"{digest} {library.compiler()}"
    assert software()["kernel"] == digest


def known_as(policy: object) -> object:
    study = replace(make_study(), contenders=(Contender("mine", policy),))  # type: ignore[arg-type]
    return describe(study)["policies"]["mine"]["policy"]


def test_an_object_is_known_by_its_class_and_its_state() -> None:
    name = f"{Patient.__module__}.Patient "
    assert str(known_as(Patient())).startswith(name)
    assert known_as(Patient()) == known_as(Patient(3))
    assert known_as(Patient()) != known_as(Patient(4))
    assert known_as("dtp") == "dtp"


def test_what_cannot_be_known_again_is_refused() -> None:
    locked = Patient(threading.Lock())  # type: ignore[arg-type]
    with pytest.raises(SimulationError, match="mine does not pickle"):
        known_as(locked)


@pytest.mark.parametrize(
    "change",
    [
        {"seeds": (1, 2)},
        {"windows": 7},
        {"references": True},
        {"scenarios": ("baseline",)},
        {"contenders": (Contender("LOC", "LOC"), Contender("dtp", "atp"))},
        {"contenders": (Contender("LOC", "LOC"), Contender("dtp", "dtp", "profile"))},
        {"points": (Point({}, with_delay(PROBLEM, 3)),)},
    ],
)
def test_another_study_has_another_description(change: dict[str, Any]) -> None:
    assert describe(make_study()) == describe(make_study())
    assert describe(make_study(**change)) != describe(make_study())
