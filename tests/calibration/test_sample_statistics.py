"""Statistics of samples, and doubts about them."""

from __future__ import annotations

import statistics
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.calibration.sample_statistics import describe, find_doubts
from tests.calibration.samples import QUIET, link, task

SAMPLES = st.lists(st.floats(0.001, 1e6), min_size=1, max_size=60)


@given(SAMPLES)
def test_statistics_by_their_definitions(values: list[float]) -> None:
    found = describe(np.array(values))
    assert found.n == len(values)
    assert found.mean == pytest.approx(statistics.fmean(values))
    assert found.max == max(values)
    assert found.cv == pytest.approx(
        statistics.pstdev(values) / statistics.fmean(values), rel=1e-6, abs=1e-9
    )
    ordered = sorted(values)
    for percent, value in ((50, found.median), (95, found.p95), (99, found.p99)):
        # The least sample that so many per cent of the samples do not exceed.
        assert value in values
        assert 100 * sum(one <= value for one in ordered) >= percent * len(values)
        assert 100 * sum(one < value for one in ordered) < percent * len(values)


def test_correlation_of_neighbours() -> None:
    # By hand: deviations -1 1 -1 1; products -1 -1 -1; squares 1 1 1 1.
    assert describe(np.array([1.0, 3, 1, 3])).lag1 == pytest.approx(-3 / 4)
    # -1.5 -0.5 0.5 1.5: (0.75 - 0.25 + 0.75) / 5
    assert describe(np.array([1.0, 2, 3, 4])).lag1 == pytest.approx(1.25 / 5)


@pytest.mark.parametrize("values", [[5.0], [5.0, 5.0, 5.0], [0.0, 0.0], [0.1] * 7])
def test_no_correlation_where_nothing_varies(values: list[float]) -> None:
    found = describe(np.array(values))
    assert found.lag1 is None
    assert found.cv == pytest.approx(0, abs=1e-12)


def test_nothing_speaks_against_a_quiet_measurement() -> None:
    assert list(find_doubts(task("t", "n", [10.0] * 9))) == []
    assert list(find_doubts(link("n", "m", [10.0] * 9, None))) == []


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        ({"steal": 0.02}, "hypervisor took 2.0%"),
        ({"preemptions": 250}, "250 times in 1 s"),
        ({"load": 3.0}, "load 3.00 on 4 CPUs"),
    ],
)
def test_a_machine_that_was_not_quiet(conditions: dict[str, Any], words: str) -> None:
    measured = task("t", "n", [10.0], conditions={**QUIET, **conditions})
    (doubt,) = find_doubts(measured)
    assert words in doubt


def test_a_task_that_waits_for_its_core_is_not_called_idle() -> None:
    measured = task("t", "n", [10.0], 0.4, conditions={**QUIET, "preemptions": 250})
    (doubt,) = find_doubts(measured)
    assert "something else ran there" in doubt


@pytest.mark.parametrize(
    "conditions",
    [
        {"steal": None, "governor": None, "frequency_mhz": [None, None]},
        {"preemptions": 20},  # in a second of CPU time: the kernel's own threads
        {"preemptions": 4, "cpu_s": 0.001},  # too few to tell
    ],
)
def test_a_machine_that_does_not_say(conditions: dict[str, Any]) -> None:
    assert not list(find_doubts(task("t", "n", [10.0], conditions={**QUIET, **conditions})))


@pytest.mark.parametrize(
    ("samples", "cores", "about", "words"),
    [
        ([10.0], 0.5, {}, "0.50 cores"),
        ([0.005], 1.0, {}, "timing alone takes 0.10 µs"),
        ([10.0, 11.0], 1.0, {"late": 1}, "1 of 2 began late"),
    ],
)
def test_samples_that_are_not_what_they_seem(
    samples: list[float], cores: float, about: dict[str, Any], words: str
) -> None:
    (doubt,) = find_doubts(task("t", "n", samples, cores, **about))
    assert words in doubt
