"""Evidence: instants of the cycles of a window, and of some of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dwell.estimators import Evidence, Instants
from dwell.estimators.evidence import UNKNOWN, Rows


def instants(cycles: int) -> Instants:
    ready = np.arange(cycles * 2).reshape(cycles, 2)
    return Instants(ready, ready + 100, np.full((cycles, 1), UNKNOWN))


@pytest.mark.parametrize(
    "rows",
    [slice(1, 3), np.array([1, 2]), np.array([False, True, True, False, False])],
    ids=["slice", "numbers", "mask"],
)
def test_instants_of_some_cycles_are_rows_of_all(rows: Rows) -> None:
    some = instants(5).at(rows)
    assert some.ready_ns.tolist() == [[2, 3], [4, 5]]
    assert some.end_ns.tolist() == [[102, 103], [104, 105]]
    assert some.arrived_ns.tolist() == [[UNKNOWN], [UNKNOWN]]
    assert (some.start_ns, some.work_ns) == (None, None)
    every = replace(instants(5), start_ns=instants(5).ready_ns, work_ns=instants(5).end_ns)
    some = every.at(rows)
    assert some.start_ns is not None
    assert some.start_ns.tolist() == [[2, 3], [4, 5]]
    assert some.work_ns is not None
    assert some.work_ns.tolist() == [[102, 103], [104, 105]]


def test_it_says_how_many_cycles_had_a_shadow() -> None:
    release, placement = np.arange(3), np.zeros(3, np.int64)
    through = np.array([-1, 2, -1])
    evidence = Evidence.of(9, release, placement, instants(3), through, instants(3))
    assert repr(evidence) == "<Evidence of 3 cycles, 1 of them with a shadow>"
