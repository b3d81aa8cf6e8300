from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.control import final_l95_ms
from dwell.control.windows import missed_cycles, seen_l95_ns, utilisation
from dwell.model.instants import NEVER_NS

MS = 1_000_000


def test_a_cycle_misses_when_it_is_late_or_not_there_yet() -> None:
    latency = np.array([10, 33, 34, NEVER_NS, 30], np.int64)
    age = np.array([100, 100, 100, 20, 25], np.int64)
    # The last has an age below D and will complete after the close: not known to be in time.
    assert missed_cycles(latency, age, 33) == 3
    np.testing.assert_array_equal(
        missed_cycles(np.stack([latency, latency]), np.stack([age, age]), 33), [3, 3]
    )


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=60), st.data())
def test_l95_is_the_order_statistic_of_what_could_be_known(
    latencies: list[int], data: st.DataObject
) -> None:
    size = len(latencies)
    ages = data.draw(st.lists(st.integers(0, 10**9), min_size=size, max_size=size))
    seen = sorted(min(pair) for pair in zip(latencies, ages, strict=True))
    expected = min(seen[math.ceil(0.95 * size - 1e-9) - 1], 5 * 10**8)
    found = seen_l95_ns(np.array(latencies), np.array(ages), 5 * 10**8)
    assert found == expected


def test_final_l95_is_infinite_where_more_than_5_percent_never_completed() -> None:
    latency = np.full((2, 100), 10 * MS, np.int64)
    latency[0, :5] = latency[1, :6] = NEVER_NS
    np.testing.assert_array_equal(final_l95_ms(latency), [10.0, np.inf])


def test_utilisation_is_a_share_of_the_cores() -> None:
    busy = np.array([1.0e9, 9.0e9])
    assert utilisation(busy, np.array([4.0, 4.0]), 10**9) == pytest.approx([0.25, 1.0])
