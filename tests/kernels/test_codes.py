"""Codes and keys are the same in Python and in C++."""

from __future__ import annotations

from random import Random

import numpy as np

from dwell.kernels import codes
from dwell.kernels.codes import CycleOutcome, EventKind, Scheduler, ShadowPart, Status
from tests.kernels.parts import at, parts, whole


def test_codes_are_those_of_the_kernel() -> None:
    found = np.zeros(9, np.int64)
    parts().part_codes(at(found))
    assert found.tolist() == [
        CycleOutcome.NODE_DOWN,
        Scheduler.TURNS,
        ShadowPart.DISCARDED,
        Status.BUSY,
        EventKind.RELEASE,
        EventKind.GUARD,
        EventKind.MIGRATE,
        Status.STEP,
        codes.MOST_FLOWS,
    ]


def test_keys_are_packed_alike_and_order_as_what_they_say() -> None:
    rng = Random(1)
    bounds = len(EventKind) - 1, codes.CELL_MASK, codes.CYCLE_MASK, codes.ITEM_MASK
    drawn = [tuple(rng.randint(0, bound) for bound in bounds) for _ in range(200)]
    keys = [whole("key", *what) for what in drawn]
    assert keys == [codes.make_key(EventKind(kind), *rest) for kind, *rest in drawn]
    assert [what for _, what in sorted(zip(keys, drawn, strict=True))] == sorted(drawn)
    for key, (kind, _, cycle, item) in zip(keys, drawn, strict=True):
        assert (codes.kind_of(key), codes.cycle_of(key), codes.item_of(key)) == (kind, cycle, item)
