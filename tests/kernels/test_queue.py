"""The queue of events: they come out in order, whatever came between."""

from __future__ import annotations

from ctypes import c_int64

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.kernels.rows import row_types
from tests.kernels.parts import at, ints, parts

TAKE = -1
#: Few times, so that many are equal and keys have to tell them apart; and some beyond many years.
TIME = st.one_of(st.integers(0, 40), st.integers(0, 2**62))
#: So many that the queue becomes a calendar, and now and then is short again.
STEPS = st.lists(
    st.tuples(st.lists(TIME, min_size=45, max_size=70), st.integers(0, 70)), max_size=4
).map(lambda groups: [step for times, takes in groups for step in (*times, *[TAKE] * takes)])


@given(STEPS, st.integers(1, 3), st.integers(0, 6), st.integers(0, 5))
def test_events_come_by_time_then_key(
    steps: list[int], kinds: int, day_bits: int, year_bits: int
) -> None:
    # Some are equal in both.
    keys = [step % kinds for step in range(len(steps))]
    room, taken = (np.zeros(len(steps) + 1, row_types()["events"]) for _ in range(2))
    values, names = ints(steps), ints(keys)
    following, days = np.zeros(len(room), np.int32), np.zeros(1 << year_bits, np.int32)
    count = parts().part_events(
        *(at(values), at(names), c_int64(len(steps))),
        *(at(room), at(following), c_int64(len(room))),
        *(at(days), c_int64(len(days)), c_int64(day_bits)),
        at(taken),
    )
    kept: list[tuple[int, int]] = []
    expected = []
    for key, step in zip(keys, steps, strict=True):
        if step != TAKE:
            kept.append((step, key))
        elif kept:
            expected.append(min(kept))
            kept.remove(min(kept))
    assert taken[:count].tolist() == expected
