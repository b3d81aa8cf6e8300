from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.model.shadow_plan import ShadowPlan, shadow_stamps


@given(
    first=st.integers(0, 10**6),
    candidates=st.integers(2, 6),
    active=st.integers(0, 5),
    percent=st.integers(1, 20),
)
def test_every_alternative_gets_its_share_of_any_stretch(
    first: int, candidates: int, active: int, percent: int
) -> None:
    active %= candidates
    fraction = percent / 100
    stamps = shadow_stamps(first, first + 2_000, active, candidates, fraction)
    assert stamps.shape == (2_000,)
    counts = {name: int((stamps == name).sum()) for name in range(candidates)}
    assert counts.pop(active) == 0
    # Few cycles off, in any stretch: golden steps are spread evenly.
    assert all(abs(count - 2_000 * fraction) <= 4 for count in counts.values())


@given(first=st.integers(0, 1_000), length=st.integers(0, 200), cut=st.integers(0, 200))
def test_a_stretch_is_the_sum_of_its_parts(first: int, length: int, cut: int) -> None:
    middle, last = first + min(cut, length), first + length
    whole = shadow_stamps(first, last, 1, 3, 0.1)
    parts = [shadow_stamps(first, middle, 1, 3, 0.1), shadow_stamps(middle, last, 1, 3, 0.1)]
    np.testing.assert_array_equal(whole, np.concatenate(parts))


def test_without_a_fraction_or_an_alternative_there_is_none() -> None:
    assert set(shadow_stamps(0, 50, 0, 3, 0.0)) == {-1}
    assert set(shadow_stamps(0, 50, 0, 1, 0.5)) == {-1}


@given(candidates=st.integers(1, 6), active=st.integers(0, 5), percent=st.integers(0, 20))
def test_the_same_cycles_are_sent_whatever_they_run_under(
    candidates: int, active: int, percent: int
) -> None:
    stamps = shadow_stamps(0, 500, active % candidates, candidates, percent / 100)
    expected = np.flatnonzero(stamps >= 0)
    plan = ShadowPlan(0, 500, [percent / 100] * candidates)
    np.testing.assert_array_equal(plan.sent, expected)


@pytest.mark.parametrize("candidates", [22, 100])
@pytest.mark.parametrize("first", [0, 10**6, 2**32 - 20_001])
def test_an_even_share_sends_every_cycle_through_one_alternative(
    candidates: int, first: int
) -> None:
    """Up to the last cycle of the longest run, where the stamps have the fewest digits left."""
    stamps = shadow_stamps(first, first + 20_000, 7, candidates, 1 / (candidates - 1))
    counts = np.bincount(stamps, minlength=candidates)
    assert counts[7] == 0
    assert np.abs(np.delete(counts, 7) - 20_000 / (candidates - 1)).max() <= 4


def test_rounding_up_sends_a_cycle_through_none() -> None:
    """Cycle 0 is the first alternative's; no cycle is beyond the last."""
    for candidates in range(2, 200):
        plan = ShadowPlan(0, 5_000, [1 / (candidates - 1)] * candidates)
        stamps = plan.stamps(0, 5_000, 0)
        assert stamps[0] == 1
        assert stamps.max() == candidates - 1
        assert (stamps < 0).sum() == 0
