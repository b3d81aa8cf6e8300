"""The recipes of docs/howto/recipes.md: their fleets carry as many robots as the page says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import dwell
from dwell.model import evolve
from dwell.model.fleet import Fleet
from dwell.study.capacity import capacity_of

EXAMPLES = Path(__file__).parents[2] / "examples"
#: Times are constant, so that few seeds show all there is.
FEW: dict[str, Any] = {"seeds": (1, 2), "cycles": 200, "processes": 1}


def recipe(name: str) -> Fleet:
    return dwell.load_fleet(EXAMPLES / f"{name}.yaml")


def with_device(fleet: Fleet, chunk_ms: float) -> Fleet:
    (entry,) = fleet.entries
    cell = evolve(entry.cell, {"tasks.infer.on.S.exec_ms": chunk_ms})
    return replace(fleet, entries=(replace(entry, cell=cell),))


@pytest.mark.parametrize(
    ("chunk_ms", "even", "sync"),
    [(27.9, 19, 17), (38.5, 13, 12), (80.6, 6, 5), (99.0, 5, 4), (152.0, 3, 3)],
)
def test_robots_on_one_policy_server_by_device(chunk_ms: float, even: int, sync: int) -> None:
    fleet = with_device(recipe("policy-fleet"), chunk_ms)
    robots = [
        capacity_of(fleet, phases=phases, most=24, **FEW).robots for phases in ("even", "sync")
    ]
    assert robots == [even, sync]


def test_a_second_policy_server_has_room_of_its_own() -> None:
    found = capacity_of(recipe("policy-servers"), most=16, **FEW)
    assert found.robots == 13
    assert found.limits is not None
    assert found.limits.name == "T.gpu"


@pytest.mark.parametrize(("policies", "cameras"), [(2, 7), (4, 5), (8, 3)])
def test_policies_and_cameras_on_one_gpu(policies: int, cameras: int) -> None:
    fleet = recipe("mixed-fleet")
    first, second = fleet.entries
    fleet = replace(fleet, entries=(first, replace(second, count=policies)))
    assert capacity_of(fleet, most=9, **{**FEW, "cycles": None}).robots == cameras


def test_robots_at_one_access_point() -> None:
    fleet = recipe("camera-fleet")
    even = capacity_of(fleet, phases="even", most=16, **FEW)
    assert even.robots == 13
    drawn = capacity_of(fleet, most=12, seeds=range(1, 31))
    assert drawn.robots == 11
    assert drawn.limits is not None
    assert (drawn.limits.kind, drawn.limits.name) == ("resource", "AIR")
