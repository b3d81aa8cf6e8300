"""The filter against motions it should follow, and pictures that come late or not at all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples.visual_servoing.servoing.tracking import Track, predicted, updated

STEP_NS = 40_000_000


def track_of(velocity: list[float], pictures: int) -> Track:
    track = None
    for k in range(pictures):
        track = updated(track, np.array(velocity) * k * 0.04, 7 + k * STEP_NS)
    assert track is not None
    return track


@given(st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=4))
def test_a_steady_motion_is_known_after_a_few_pictures(velocity: list[float]) -> None:
    track = track_of(velocity, 12)
    assert track.velocity == pytest.approx(velocity, abs=2e-3)
    ahead = predicted(track, track.at_ns + 100_000_000)
    assert ahead == pytest.approx(np.array(velocity) * (11 * 0.04 + 0.1), abs=1e-3)


def test_variances_stay_those_of_something() -> None:
    track = track_of([0.1, 0.2, 0.3, 0.4], 200)
    for pp, pv, vv in zip(*track.variances, strict=True):
        assert pp > 0
        assert pp * vv > pv**2


def test_an_older_picture_changes_nothing() -> None:
    track = track_of([0.1, 0.0, 0.0, 0.0], 5)
    assert updated(track, np.ones(4), track.at_ns - 1) is track


def test_yaw_goes_on_over_the_turn() -> None:
    track = None
    for k in range(40):
        yaw = math.remainder(2.5 + 0.04 * k, 2 * math.pi)
        track = updated(track, np.array([0, 0, 0, yaw]), k * STEP_NS)
    assert track is not None
    assert track.position[3] == pytest.approx(2.5 + 0.04 * 39, abs=5e-3)
    assert track.velocity[3] == pytest.approx(1.0, abs=0.02)


def test_after_a_long_gap_it_begins_anew() -> None:
    track = track_of([0.5, 0.0, 0.0, 0.0], 10)
    track = updated(track, np.zeros(4), track.at_ns + 2_000_000_000)
    assert track.position == (0, 0, 0, 0)
    assert track.velocity == (0, 0, 0, 0)
