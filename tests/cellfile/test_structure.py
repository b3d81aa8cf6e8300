"""The structure of a document: sections, keys, versions, and what no file holds."""

from __future__ import annotations

import copy
from typing import Any

import pytest

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
