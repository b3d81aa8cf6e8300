"""The structure of a document: sections, keys, versions, and what no file holds."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from dwell.cellfile import load
from dwell.errors import ProblemError
from tests.cellfile.faulty import DOCUMENT, Document, faults_of_document, put
from tests.cellfile.test_cell import LEAST


@pytest.mark.parametrize("key", ["dwell", "period_ms", "nodes", "tasks", "candidates"])
def test_a_section_that_is_missing_is_the_only_fault(key: str) -> None:
    document = {name: value for name, value in DOCUMENT.items() if name != key}
    (fault,) = faults_of_document(document)
    assert fault.path == key
    assert fault.message.startswith("missing; add it:")


@pytest.mark.parametrize(
    ("section", "steps"),
    [
        ("nodes.E.tier", ("nodes", "E", "tier")),
        ("links[0].delay_ms", ("links", 0, "delay_ms")),
        ("links[0].to", ("links", 0, "to")),
        ("tasks.planning.on", ("tasks", "planning", "on")),
        ("tasks.planning.on.E.exec_ms", ("tasks", "planning", "on", "E", "exec_ms")),
        ("flows[0].from", ("flows", 0, "from")),
    ],
)
def test_a_key_that_is_missing_is_the_only_fault(
    section: str, steps: tuple[str | int, ...]
) -> None:
    document = copy.deepcopy(DOCUMENT)
    parent: Any = document
    for step in steps[:-1]:
        parent = parent[step]
    del parent[steps[-1]]
    (fault,) = faults_of_document(document)
    assert fault.path == section
    assert fault.message.startswith("missing; add it:")


@pytest.mark.parametrize("section", ["nodes", "tasks", "candidates"])
def test_a_section_that_is_empty_is_at_fault(section: str) -> None:
    faults = faults_of_document({**LEAST, section: {}})
    assert any(f.path == section and "none is declared" in f.message for f in faults)


def test_a_newer_version_is_the_only_complaint() -> None:
    document = {**copy.deepcopy(DOCUMENT), "dwell": 3, "swarms": [1, None]}
    (fault,) = faults_of_document(document)
    assert fault.path == "dwell"
    assert "3" in fault.message


@pytest.mark.parametrize("document", [[], "text", 5, None])
def test_a_document_is_a_mapping(document: object) -> None:
    (fault,) = faults_of_document(document)
    assert "`dwell: 1`" in fault.message


def test_values_that_no_file_holds_are_refused() -> None:
    document: Document = {**DOCUMENT, "name": {1, 2}, 7: "x", "flows": ({1: 2},)}  # type: ignore[dict-item]
    paths = {fault.path for fault in faults_of_document(document)}
    assert {"name", "7", "flows[0].1"} <= paths


def test_a_document_is_not_changed_by_reading_it() -> None:
    document = copy.deepcopy(DOCUMENT)
    put(document, -1, "tasks", "sensing", "on", "R1", "exec_ms")
    before = copy.deepcopy(document)
    faults_of_document(document)
    assert document == before


#: The name NAME stands wherever a cell names a node.
NAMED = """
dwell: 1
period_ms: 50
nodes: {R1: {tier: robot}, NAME: {tier: edge}}
links: [{from: R1, to: NAME, delay_ms: 1}, {from: NAME, to: R1, delay_ms: 1}]
tasks: {a: {on: {R1: {exec_ms: 1}}}, b: {on: {R1: {exec_ms: 1}, NAME: {exec_ms: 1}}}}
flows: [{from: a, to: b}]
candidates: {LOC: {b: R1}, SO: {b: NAME}}
scenarios: {s: [{node: NAME, at_s: 1, down: true}, {link: R1->NAME, at_s: 1, loss: 0.1}]}
objective: {tiers: {NAME: edge}}
controller: {on: NAME}
live: {hosts: {NAME: {port: 7000}}, relay: NAME}
"""


@pytest.mark.parametrize("name", ["true", "FALSE", "null", "~", "1", "0x1F", "1e3", ".inf", "-2"])
def test_a_name_that_is_no_text_is_the_only_fault(name: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(NAMED.replace("NAME", name), encoding="utf-8")
    with pytest.raises(ProblemError) as caught:
        load(path)
    (fault,) = caught.value.faults
    assert (fault.path, fault.line) == (f"nodes.{name}", 4)
    assert f"the key {name} is not a text; put it in quotes" in fault.message


@pytest.mark.parametrize("name", ["on", "off", "yes", "NO", "y", "2026-11-25", "12:30", "1.2.3"])
def test_a_text_of_yaml_1_2_is_a_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(NAMED.replace("NAME", name), encoding="utf-8")
    assert load(path).controller.on == name


def test_values_that_are_no_texts_stay_what_they_are_beside_such_a_name(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(NAMED.replace("NAME", "1").replace("period_ms: 50", "period_ms: ~"))
    with pytest.raises(ProblemError) as caught:
        load(path)
    assert [fault.path for fault in caught.value.faults] == ["period_ms", "nodes.1"]


@pytest.mark.parametrize(
    ("steps", "path"),
    [
        (("period_ms",), "period_ms"),
        (("nodes",), "nodes"),
        (("nodes", "E", "tier"), "nodes.E.tier"),
        (("links", 0, "delay_ms"), "links[0].delay_ms"),
        (("flows", 0, "to"), "flows[0].to"),
    ],
)
def test_a_required_key_without_a_value_is_not_to_be_removed(
    steps: tuple[str | int, ...], path: str
) -> None:
    document = copy.deepcopy(DOCUMENT)
    put(document, None, *steps)
    (fault,) = faults_of_document(document)
    assert fault.path == path
    assert "give a value" in fault.message
    assert "remove" not in fault.message
    put(document, None, "deadline_ms")
    assert any("or remove the key 'deadline_ms'" in f.message for f in faults_of_document(document))


@pytest.mark.parametrize(
    ("steps", "wrong", "right"),
    [
        (("nodes", "E"), "teir", "tier"),
        (("links", 0), "delay", "delay_ms"),
        (("tasks", "planning"), "onn", "on"),
        ((), "candidate", "candidates"),
    ],
)
def test_a_required_key_that_is_misspelt_is_one_fault(
    steps: tuple[str | int, ...], wrong: str, right: str
) -> None:
    document = copy.deepcopy(DOCUMENT)
    parent: Any = document
    for step in steps:
        parent = parent[step]
    parent[wrong] = parent.pop(right)
    (fault,) = faults_of_document(document)
    assert f"unknown key {wrong!r}; did you mean {right!r}?" == fault.message
