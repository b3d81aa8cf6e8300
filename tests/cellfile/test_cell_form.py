"""The form of a cell file, and what is made of it."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest

from docs.cell_tables import FILES, with_tables
from dwell.cellfile import cell_form, schema
from dwell.cellfile.forms import Shape
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model.declaration import declared_fields
from dwell.policies.registry import REGISTRY as POLICIES

SHAPES = [one for one in vars(cell_form).values() if isinstance(one, Shape)]


@pytest.mark.parametrize("page", FILES, ids=lambda page: page.name)
def test_the_tables_of_the_docs_are_those_of_the_form(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert with_tables(text) == text


def test_every_shape_of_the_file_has_a_table() -> None:
    text = FILES[0].read_text(encoding="utf-8")
    for shape in SHAPES:
        for key in shape.keys:
            assert f"`{key.named}`" in text or f"{{{key.named}" in text or f", {key.named}" in text


@pytest.mark.parametrize("shape", [one for one in SHAPES if one.kind], ids=lambda one: one.title)
def test_a_shape_has_the_keys_that_its_class_declares(shape: Shape) -> None:
    left_out = {"NodeBursts": {"add_delay_ms"}, "LinkBursts": {"threads"}}.get(shape.title, set())
    declared = {one.name for one in declared_fields(shape.kind)} - left_out
    assert declared <= {key.name for key in shape.keys}
    assert all(key.says.endswith(".") for key in shape.keys)


def test_editors_complete_policies_and_estimators_and_take_a_users() -> None:
    keys = schema()["$defs"]["Controller"]["properties"]
    for name, known in (("policy", POLICIES), ("estimator", ESTIMATORS)):
        assert keys[name]["anyOf"][0]["enum"] == list(known)
        validator = jsonschema.Draft202012Validator(keys[name])
        assert validator.is_valid("my.module:Class")
        assert not validator.is_valid(3)


def test_the_schema_beside_the_examples_is_that_of_the_form() -> None:
    file = Path(__file__).parents[2] / "examples" / "cell.schema.json"
    assert json.loads(file.read_text(encoding="utf-8")) == schema()
