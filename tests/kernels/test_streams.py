from __future__ import annotations

import numpy as np
import pytest

from dwell.kernels.streams import ar1_path, nanoseconds, standard_normals


def test_a_path_in_blocks_is_the_path_in_one() -> None:
    noise = np.random.default_rng(1).standard_normal(50)
    whole, first, second = noise.copy(), noise[:20].copy(), noise[20:].copy()
    ar1_path(whole, 0.8, 0.0, True)
    state = ar1_path(first, 0.8, 0.0, True)
    ar1_path(second, 0.8, state, False)
    np.testing.assert_array_equal(whole, np.concatenate([first, second]))
    assert whole[1] == pytest.approx(0.8 * noise[0] + 0.6 * noise[1])


def test_normals_are_those_of_numpy() -> None:
    out = np.empty(100)
    standard_normals(np.random.default_rng(5), out)
    np.testing.assert_array_equal(out, np.random.default_rng(5).standard_normal(100))


def test_durations_are_whole_nanoseconds_up_to_the_longest() -> None:
    out = np.empty(4, np.int64)
    nanoseconds(np.array([0.0, 1.0000004, 2.5e-6, 1e30]), 1e6, 9e18, out)
    assert out.tolist() == [0, 1_000_000, 2, 9_000_000_000_000_000_000]
