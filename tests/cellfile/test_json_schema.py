"""The JSON Schema for editors."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any, get_args

import pytest
from hypothesis import HealthCheck, given, settings

from dwell.cellfile import cell_form, schema
from dwell.model import Problem
from dwell.model.declaration import KeyTier
from dwell.model.document import to_document
from tests.cellfile.faulty import DOCUMENT
from tests.cellfile.test_cell import LEAST
from tests.cells.strategies import problems

SHAPES = (
    *(cell_form.CELL.shape, cell_form.TRACE, cell_form.NODE, cell_form.QUOTA, cell_form.LINK),
    *(cell_form.TASK, cell_form.EXECUTION, cell_form.FLOW, cell_form.DISTURBANCE),
    *(cell_form.OBJECTIVE, cell_form.CONTROLLER, cell_form.LIVE, cell_form.HOST),
)

jsonschema = pytest.importorskip("jsonschema", reason="validates documents against the schema")


def _validator() -> Any:
    jsonschema.Draft202012Validator.check_schema(schema())
    return jsonschema.Draft202012Validator(schema())


def _properties(part: object) -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(part, dict):
        yield from part.get("properties", {}).items()
        for inner in part.values():
            yield from _properties(inner)
    if isinstance(part, list):
        for inner in part:
            yield from _properties(inner)


def test_it_is_plain_json() -> None:
    assert json.loads(json.dumps(schema(), allow_nan=False)) == schema()


@pytest.mark.parametrize("document", [DOCUMENT, LEAST], ids=["example", "least"])
def test_it_accepts_cells(document: dict[str, Any]) -> None:
    _validator().validate(document)


@settings(max_examples=12, suppress_health_check=list(HealthCheck))
@given(problems())
def test_it_accepts_the_document_of_any_problem(problem: Problem) -> None:
    jsonschema.Draft202012Validator(schema()).validate(to_document(problem))


def test_every_key_says_what_it_is() -> None:
    processes = {"uniform", "normal", "lognormal", "gamma", "exponential", "ar1", "trace"}
    for name, part in _properties(schema()):
        assert part.get("description") or name in processes, name


def test_keys_of_a_first_cell_come_before_those_for_tuning_and_of_measurements() -> None:
    nodes = list(schema()["$defs"]["Node"]["properties"])
    assert nodes[:2] == ["tier", "cores"]
    assert nodes.index("scheduler") < nodes.index("background")
    tiers = [[key.tier for key in shape.by_tier] for shape in SHAPES]
    assert all(some == sorted(some, key=get_args(KeyTier).index) for some in tiers)
    assert sum(some.count("first") for some in tiers) <= 50


@pytest.mark.parametrize(
    ("steps", "value"),
    [
        (("nodes", "R1", "cores"), 0),
        (("nodes", "R1", "cores"), 1.5),
        (("nodes", "R1", "tier"), "rover"),
        (("nodes", "R1", "core"), 2),
        (("links", 0, "loss"), 1),
        (("links", 0, "delay_ms"), "fast"),
        (("links", 0, "delay_ms"), {"constant": 1, "exponential": {"mean": 1}}),
        (("links", 0, "on_loss"), "retry"),
        (("tasks", "perception", "input"), "last"),
        (("tasks", "perception", "scale"), None),
        (("scenarios", "x"), [{"at_s": 1}]),
        (("scenarios", "x"), [{"node": "E", "link": "R1->E"}]),
        (("scenarios", "x"), [{"node": "E", "ramp_s": -1}]),
        (("scenarios", "x"), [{"node": "E", "episodes": {"every_s": 1, "for_s": 1}}]),
        (("servo",), {"plant": "integrator", "gain": 1}),
        (("servo", "gain"), 0),
        (("dwell",), 2),
    ],
)
def test_it_refuses_what_the_reader_refuses(steps: tuple[str | int, ...], value: object) -> None:
    document: Any = copy.deepcopy(DOCUMENT)
    parent = document
    for step in steps[:-1]:
        parent = parent[step]
    parent[steps[-1]] = value
    assert not _validator().is_valid(document)
