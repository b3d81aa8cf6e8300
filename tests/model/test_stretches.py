"""Misses in stretches of cycles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.model import MissCap
from dwell.model.stretches import misses_in, share_over


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.integers(1, 70))
def test_misses_in_every_stretch(missed: list[bool], stretch: int) -> None:
    (counts,) = misses_in(np.array(missed), [stretch])
    starts = range(max(len(missed) - stretch, 0) + 1)
    assert counts.tolist() == [sum(missed[at : at + stretch]) for at in starts]


def test_the_share_of_stretches_with_too_many_misses() -> None:
    missed = np.array([True, True, False, False, True, False])
    # Of the four stretches of three cycles, only the first has more than one miss.
    assert share_over(missed, MissCap(m=1, k=3)) == pytest.approx(1 / 4)
    assert share_over(missed, MissCap(m=0, k=3)) == 1.0
