from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.model import Placement, Replicas
from dwell.model.shadow_plan import ShadowPlan, alternatives, by_candidate, shadow_stamps


def others(candidates: int) -> list[list[int]]:
    """Return the alternatives of candidates without replicas."""
    return alternatives({str(i): Placement({"work": str(i)}) for i in range(candidates)})


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
    stamps = shadow_stamps(first, first + 2_000, others(candidates)[active], fraction)
    assert stamps.shape == (2_000,)
    counts = {name: int((stamps == name).sum()) for name in range(candidates)}
    assert counts.pop(active) == 0
    # Few cycles off, in any stretch: golden steps are spread evenly.
    assert all(abs(count - 2_000 * fraction) <= 4 for count in counts.values())


@given(first=st.integers(0, 1_000), length=st.integers(0, 200), cut=st.integers(0, 200))
def test_a_stretch_is_the_sum_of_its_parts(first: int, length: int, cut: int) -> None:
    middle, last = first + min(cut, length), first + length
    whole = shadow_stamps(first, last, [0, 2], 0.1)
    parts = [shadow_stamps(*part, [0, 2], 0.1) for part in ((first, middle), (middle, last))]
    np.testing.assert_array_equal(whole, np.concatenate(parts))


def test_without_a_fraction_or_an_alternative_there_is_none() -> None:
    assert set(shadow_stamps(0, 50, [1, 2], 0.0)) == {-1}
    assert set(shadow_stamps(0, 50, [], 0.5)) == {-1}


@given(candidates=st.integers(1, 6), active=st.integers(0, 5), percent=st.integers(0, 20))
def test_the_same_cycles_are_sent_whatever_they_run_under(
    candidates: int, active: int, percent: int
) -> None:
    fraction, known = percent / 100, others(candidates)
    stamps = shadow_stamps(0, 500, known[active % candidates], fraction)
    expected = np.flatnonzero(stamps >= 0)
    plan = ShadowPlan(0, 500, [fraction] * candidates, known)
    np.testing.assert_array_equal(plan.sent, expected)


@pytest.mark.parametrize("candidates", [22, 100])
@pytest.mark.parametrize("first", [0, 10**6, 2**32 - 20_001])
def test_an_even_share_sends_every_cycle_through_one_alternative(
    candidates: int, first: int
) -> None:
    """Up to the last cycle of the longest run, where the stamps have the fewest digits left."""
    stamps = shadow_stamps(first, first + 20_000, others(candidates)[7], 1 / (candidates - 1))
    counts = np.bincount(stamps, minlength=candidates)
    assert counts[7] == 0
    assert np.abs(np.delete(counts, 7) - 20_000 / (candidates - 1)).max() <= 4


def test_rounding_up_sends_a_cycle_through_none() -> None:
    """Cycle 0 is the first alternative's; no cycle is beyond the last."""
    for candidates in range(2, 200):
        plan = ShadowPlan(0, 5_000, [1 / (candidates - 1)] * candidates, others(candidates))
        stamps = plan.stamps(0, 5_000, 0)
        assert stamps[0] == 1
        assert stamps.max() == candidates - 1
        assert (stamps < 0).sum() == 0


REPLICATED = {name: Placement({"work": name}) for name in ("LOC", "SO", "HYB")}
REPLICATED["BOTH"] = Replicas({name: REPLICATED[name] for name in ("LOC", "SO")})


def test_shadows_go_through_no_replicas_and_no_member_of_replicas_in_force() -> None:
    assert alternatives(REPLICATED) == [[1, 2], [0, 2], [0, 1], [2]]
    plan = ShadowPlan(0, 200, [0.1] * 4, alternatives(REPLICATED))
    assert {*plan.stamps(0, 200, 3)} == {-1, 2}
    assert {*plan.stamps(0, 200, 0)} == {-1, 1, 2}
    sent = {
        cycle for active in range(4) for cycle in np.flatnonzero(plan.stamps(0, 200, active) >= 0)
    }
    assert sent == {*plan.sent}


def test_replicas_without_an_alternative_have_no_share() -> None:
    pair = {name: one for name, one in REPLICATED.items() if name != "HYB"}
    assert by_candidate(0.05, pair) == {"LOC": 0.05, "SO": 0.05, "BOTH": 0.0}
    assert by_candidate(0.05, REPLICATED)["BOTH"] == 0.05
