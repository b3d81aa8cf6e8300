"""Evolve: other values by the paths of a cell file."""

from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.model import Caps, Constant, LogNormal, evolve

CANONICAL = dwell.load(Path(__file__).parents[2] / "examples" / "canonical.yaml")


def test_a_setting_changes_and_nothing_else() -> None:
    found = evolve(CANONICAL, {"controller.min_dwell": 1})
    assert found.controller.min_dwell == 1
    assert evolve(found, {"controller.min_dwell": CANONICAL.controller.min_dwell}) == CANONICAL


def test_values_of_every_part() -> None:
    found = evolve(
        CANONICAL,
        {
            "period_ms": 40.0,
            "deadline_ms": 38.0,
            "nodes.E.cores": 7,
            "links[1].delay_ms": 3,
            "tasks.perception.on.R1.exec_ms": LogNormal(9.0, 0.1),
            "objective.weights.switching": 0.25,
            "objective.caps": {"latency_ms": 90.0},
            "window_cycles": 20.0,
            "controller.decide_cycles": 5,
        },
    )
    assert (found.pipeline.period_ms, found.pipeline.deadline_ms) == (40.0, 38.0)
    assert found.fabric.nodes["E"].cores == 7
    assert list(found.fabric.links.values())[1].delay_ms == Constant(3.0)
    assert found.pipeline.tasks["perception"].on["R1"].exec_ms == LogNormal(9.0, 0.1)
    assert found.objective.weights.switching == 0.25
    assert found.objective.caps == Caps(latency_ms=90.0)
    assert found.window_cycles == 20
    assert found.candidates == CANONICAL.candidates


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("controller.min_dwell", -1, "-1 is not allowed; it must be a whole number from 0"),
        ("controller.migration", "hot", "'hot' is not allowed; it must be one of warm, cold"),
        ("controller.escape", "yes", "'yes' is not allowed; it must be true or false"),
        ("objective.weights.egde", 3, "unknown key 'egde'; did you mean 'edge'?"),
        ("nodes.E9.cores", 3, "no 'E9'"),
        ("links[99].loss", 0.1, "there is no links[99]"),
        ("deadline_ms", 1e6, "at most 64 period_ms"),
        ("tasks.perception.on.R1.threads", 0, "0 is not allowed"),
    ],
)
def test_a_wrong_value_is_told_at_its_path(path: str, value: object, told: str) -> None:
    with pytest.raises(ProblemError) as caught:
        evolve(CANONICAL, {path: value})
    (fault,) = caught.value.faults
    assert told in fault.message
    assert fault.path == path


def test_what_is_drawn_is_equal_where_only_settings_differ() -> None:
    found = evolve(CANONICAL, {"controller.min_dwell": 1, "objective.weights.edge": 0.0})
    assert found.drawn == CANONICAL.drawn
    assert hash(found.drawn) == hash(CANONICAL.drawn)
    assert evolve(CANONICAL, {"nodes.E.cores": 7}).drawn != CANONICAL.drawn
