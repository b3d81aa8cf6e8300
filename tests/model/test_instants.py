"""The instant that never comes."""

from __future__ import annotations

import numpy as np

from dwell.model.instants import NEVER_NS


def test_it_is_later_than_a_century_and_its_sum_with_any_instant_fits_64_bits() -> None:
    century_ns = 100 * 366 * 86_400 * 10**9
    assert century_ns < NEVER_NS
    assert np.iinfo(np.int64).max >= NEVER_NS + (NEVER_NS - 1)
