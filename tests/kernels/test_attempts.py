"""Random numbers of attempts to send."""

from __future__ import annotations

import numpy as np

from tests.kernels.parts import attempt_uniform


def test_an_attempt_is_a_uniform_number_that_only_its_counters_decide() -> None:
    key = 0x1234_5678_9ABC_DEF0
    drawn = np.array([[attempt_uniform(key, k, a) for a in range(3)] for k in range(2_000)])
    assert drawn.min() >= 0
    assert drawn.max() < 1
    assert np.unique(drawn).size == drawn.size
    counts, _ = np.histogram(drawn, bins=20, range=(0, 1))
    # 300 a bin, standard deviation 17: five of them.
    assert abs(counts - 300).max() < 85
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 1])[0, 1]) < 0.1
