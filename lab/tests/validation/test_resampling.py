"""Resamples of runs and blocks of windows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dwell_lab.validation.resampling import (
    DRAWS,
    block_windows,
    ends,
    resample_units,
    resample_windows,
)


def test_blocks_grow_with_the_cube_root() -> None:
    assert [block_windows(count) for count in (1, 8, 9, 27, 1000)] == [1, 2, 3, 3, 10]


def test_a_single_run_keeps_its_length() -> None:
    weights = resample_windows([50])
    assert weights.shape == (DRAWS, 50)
    assert (weights.sum(axis=1) == 50).all()


def test_every_window_counts_once_in_the_mean() -> None:
    weights = resample_windows([30, 30, 30])
    assert weights.mean(axis=0) == pytest.approx(np.ones(90), abs=0.2)


def test_runs_are_taken_whole() -> None:
    # A run of one length that is taken n times has n times as many windows.
    weights = resample_windows([10, 20])
    taken = np.stack([weights[:, :10].sum(axis=1) / 10, weights[:, 10:].sum(axis=1) / 20])
    assert (taken.sum(axis=0) == 2).all()
    assert set(np.unique(taken)) == {0, 1, 2}


def test_neighbours_come_together() -> None:
    weights = resample_windows([64])
    there = weights > 0
    after = np.roll(there, -1, axis=1)
    assert (there & after).mean() > 1.2 * there.mean() ** 2


def test_blocks_widen_the_interval_of_what_lasts() -> None:
    rng = np.random.default_rng(3)
    lasting = np.repeat(rng.normal(size=40), 5)
    blocks = resample_windows([200]) @ lasting / 200
    alone = resample_units(200) @ lasting / 200
    assert blocks.std() > 1.3 * alone.std()


def test_ends_are_order_statistics() -> None:
    values = np.arange(1.0, DRAWS + 1)
    assert ends(values) == (25.0, 975.0)
    values[950:] = math.inf
    assert ends(values) == (25.0, math.inf)
    values[0] = math.nan
    assert all(map(math.isnan, ends(values)))


def test_the_same_again() -> None:
    assert (resample_windows([7, 9]) == resample_windows([7, 9])).all()
    assert (resample_units(5) != resample_units(5, seed=2)).any()
