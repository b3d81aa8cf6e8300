"""The example cells."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

import dwell
from dwell.model import Problem
from tests.cells.examples import CELLS, EXAMPLES


@pytest.fixture(scope="session")
def cells() -> dict[str, Problem]:
    """Return the example cells."""
    return {name: dwell.load(EXAMPLES / f"{name}.yaml") for name in CELLS}


@pytest.fixture(scope="session")
def canonical(cells: Mapping[str, Problem]) -> Problem:
    """Return the canonical cell."""
    return cells["canonical"]
