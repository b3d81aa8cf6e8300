"""A strip of few bins has every miss of its cycles."""

from __future__ import annotations

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.dash.strip import Strip, binned_means


@st.composite
def strips(draw: st.DrawFn) -> Strip:
    count = draw(st.integers(0, 400))
    seed = draw(st.integers(0, 2**32 - 1))
    random = np.random.default_rng(seed)
    latency_ms = random.lognormal(3.0, 0.5, count)
    latency_ms[random.random(count) < 0.1] = np.nan
    return Strip(
        at=np.cumsum(random.choice([0.0, 0.02, 0.04], count)),
        latency_ms=latency_ms,
        missed=random.random(count) < draw(st.sampled_from([0.0, 0.01, 0.3, 1.0])),
        placement=random.integers(0, draw(st.integers(1, 4)), count).astype(np.int32),
        number=np.arange(count),
        due=random.random(count) < draw(st.sampled_from([0.1, 1.0])),
    )


@given(strips(), st.floats(-1, 9), st.floats(0.001, 9), st.integers(1, 60))
def test_every_cycle_and_every_miss_is_in_a_bin(
    strip: Strip, begin: float, length: float, bins: int
) -> None:
    end = begin + length
    view = strip.view(begin, end, bins)
    inside = (begin <= strip.at) & (strip.at < end)
    found = view["bins"]
    assert view["released"] == inside.sum()
    assert view["cycles"] == sum(found["count"]) == strip.due[inside].sum()
    assert view["missed"] == sum(found["missed"]) == strip.missed[inside].sum()
    assert sum(found["lost"]) == np.isnan(strip.latency_ms[inside & strip.due]).sum()
    assert len({len(column) for column in found.values()}) == 1
    assert len(found["at"]) <= bins or view["released"] <= bins
    known = strip.latency_ms[inside & ~np.isnan(strip.latency_ms)]
    highs = [high for high in found["high"] if high is not None]
    assert max(highs, default=0.0) == np.round(max(known, default=0.0), 3)
    json.dumps(view, allow_nan=False)


@given(strips(), st.integers(10, 60))
def test_the_ribbon_has_every_placement_where_it_was(strip: Strip, bins: int) -> None:
    view = strip.view(0.0, 20.0, bins)
    ribbon = view["ribbon"]
    assert set(ribbon["placement"]) == set(strip.placement[strip.at < 20].tolist())
    assert all(a <= b for a, b in zip(ribbon["begin"], ribbon["end"], strict=True))


def test_a_long_run_takes_little_room_at_any_zoom() -> None:
    count = 1_000_000
    random = np.random.default_rng(1)
    strip = Strip(
        at=np.arange(count) / 30,
        latency_ms=random.lognormal(3.0, 0.3, count),
        missed=random.random(count) < 0.05,
        placement=random.integers(0, 3, count).astype(np.int32),
        number=np.arange(count),
        due=np.ones(count, np.bool_),
    )
    for share in (1.0, 0.1, 0.01, 0.0001):
        view = strip.view(0.0, share * count / 30, 1_500)
        assert view["missed"] == sum(view["bins"]["missed"])
        assert len(json.dumps(view)) < 500_000


@given(strips(), st.integers(1, 40))
def test_means_are_of_what_is_known(strip: Strip, bins: int) -> None:
    found = binned_means(strip.at, {"x": strip.latency_ms}, 0.0, 9.0, bins)
    inside = strip.latency_ms[: int((strip.at < 9.0).sum()) + 1]
    values = [value for value in found["of"]["x"] if value is not None]
    known = inside[~np.isnan(inside)]
    assert bool(values) == bool(len(known))
    if len(known):
        assert known.min() - 1e-4 <= min(values)
        assert max(values) <= known.max() + 1e-4


def test_cycles_that_come_late_stand_where_they_were_released() -> None:
    def strip(at: list[float]) -> Strip:
        count = len(at)
        zeros = np.zeros(count, np.int32)
        never = zeros.astype(bool)
        return Strip(np.array(at), np.ones(count), never, zeros, np.arange(count), ~never)

    joined = strip([1.0, 2.0, 4.0]).followed_by(strip([3.0, 5.0]), most=4)
    assert joined.at.tolist() == [2.0, 3.0, 4.0, 5.0]
    assert len(strip([]).followed_by(joined, most=2).at) == 2
