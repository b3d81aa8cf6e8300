"""The tracking error that a run's observer has measured."""

from __future__ import annotations

import math

import pytest

from dwell.errors import RunError
from dwell.report.run_page import run_page
from dwell.report.tracking import Tracking
from tests.report.live_runs import TRACKING, live_run


def test_a_run_without_one_has_none() -> None:
    assert Tracking.of({}) is None


@pytest.mark.parametrize(
    "told",
    [[], {"begin_s": 0}, {**TRACKING, "step_s": 0}, {**TRACKING, "rms_px": [1.0]}],
)
def test_an_error_that_cannot_be_read_is_refused(told: object) -> None:
    with pytest.raises(RunError, match="tracking error cannot be read"):
        run_page(live_run(tracking=told))


def test_rms_is_of_the_stretches_between_two_instants() -> None:
    tracking = Tracking.of({"tracking": TRACKING})
    assert tracking is not None
    mm, px = tracking.rms(0.33, 0.99)
    assert mm == pytest.approx(math.sqrt((9 + 16) / 2))
    assert px == pytest.approx(math.sqrt((36 + 64) / 2))
    assert math.isnan(tracking.rms(10, 11)[0])
