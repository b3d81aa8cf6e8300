"""The instant that never comes, and how long a run may be."""

from __future__ import annotations

import numpy as np
import pytest

from dwell.errors import ProblemError
from dwell.model import bounds
from dwell.model.instants import HORIZON_NS, NEVER_NS, require_length


def test_it_is_later_than_a_century_and_its_sum_with_any_instant_fits_64_bits() -> None:
    century_ns = 100 * 366 * 86_400 * 10**9
    assert century_ns < NEVER_NS
    assert np.iinfo(np.int64).max >= NEVER_NS + (NEVER_NS - 1)


def test_twenty_times_of_a_cell_file_can_be_added_to_the_last_instant_of_a_run() -> None:
    assert round(bounds.LENGTH_S.high * 1e9) == HORIZON_NS
    assert np.iinfo(np.int64).max >= HORIZON_NS + 20 * round(bounds.LARGEST * 1e6)


@pytest.mark.parametrize(
    ("windows", "window_cycles", "period_ms"),
    [(184, 50, 1e9), (9200, 1, 1e9), (2**32 - 1, 1, 1e-3), (4294, 1_000_000, 1)],
)
def test_the_longest_runs_are_allowed(windows: int, window_cycles: int, period_ms: float) -> None:
    assert require_length(windows, window_cycles, period_ms) == windows * window_cycles


@pytest.mark.parametrize(
    ("windows", "window_cycles", "period_ms", "named"),
    [
        (185, 50, 1e9, "185 windows of window_cycles = 50 and period_ms = 1e9 last 9.25e9 s"),
        (9201, 1, 1e9, "at most 9.2e9 s"),
        (2**32, 1, 1e-3, "4294967296 cycles; a run has at most 4294967295"),
    ],
)
def test_longer_ones_are_refused(
    windows: int, window_cycles: int, period_ms: float, named: str
) -> None:
    with pytest.raises(ProblemError, match=named) as error:
        require_length(windows, window_cycles, period_ms, "--windows")
    assert [fault.path for fault in error.value.faults] == ["--windows"]
