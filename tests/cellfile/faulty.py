"""The example of these tests, and what is wrong with it once something in it has changed."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.yaml_text import read_yaml
from dwell.errors import Fault, ProblemError
from tests.cellfile.test_cell import EXAMPLE

Document = dict[str, Any]


def example() -> Document:
    document = read_yaml(str(EXAMPLE), Faults())
    assert isinstance(document, dict)
    return document


DOCUMENT = example()


def put(document: Any, value: object, *steps: str | int) -> None:
    for step in steps[:-1]:
        document = document[step]
    document[steps[-1]] = value


def faults_of_document(document: object) -> list[Fault]:
    with pytest.raises(ProblemError) as caught:
        from_document(document)  # type: ignore[arg-type]
    return list(caught.value.faults)


def one_fault(value: object, *steps: str | int) -> Fault:
    """Return the only fault that a value put into the example makes."""
    document = copy.deepcopy(DOCUMENT)
    put(document, value, *steps)
    (fault,) = faults_of_document(document)
    return fault
