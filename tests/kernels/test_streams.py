from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dwell.kernels.compiled import kernel
from dwell.kernels.streams import ar1_path, attempt_uniform, nanoseconds, standard_normals


@kernel
def fill_attempts(key: np.uint64, out: NDArray[np.float64]) -> None:
    """Draw what only kernels call."""
    for cycle in range(out.shape[0]):
        for attempt in range(out.shape[1]):
            out[cycle, attempt] = attempt_uniform(key, cycle, attempt)


def test_an_attempt_is_a_uniform_number_that_only_its_counters_decide() -> None:
    key = np.uint64(0x1234_5678_9ABC_DEF0)
    drawn, fewer = np.empty((2_000, 3)), np.empty((1_000, 2))
    fill_attempts(key, drawn)
    fill_attempts(key, fewer)
    np.testing.assert_array_equal(fewer, drawn[:1_000, :2])
    assert drawn.min() >= 0
    assert drawn.max() < 1
    assert np.unique(drawn).size == drawn.size
    counts, _ = np.histogram(drawn, bins=20, range=(0, 1))
    # 300 a bin, standard deviation 17: five of them.
    assert abs(counts - 300).max() < 85
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 1])[0, 1]) < 0.1


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
