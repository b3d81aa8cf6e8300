"""Two groups of runs, compared seed by seed."""

from __future__ import annotations

import polars as pl
import pytest

from dwell.errors import SimulationError
from dwell.study.paired import PairedDifference, PairedMedian
from dwell.study.paper.contrasts import contrast, family_of, interval, values

RUNS = pl.DataFrame(
    {
        "policy": ["a", "a", "a", "b", "b", "b"],
        "seed": [3, 1, 2, 1, 2, 3],
        "cost": [3.0, 1.0, 2.0, 0.5, 1.5, 2.5],
        "tracking_rms_mm": [3.0, 1.0, float("inf"), 0.5, 1.5, float("inf")],
    }
)
PAIR = ({"policy": "a"}, {"policy": "b"})


def test_values_come_in_the_order_of_seeds() -> None:
    assert values(RUNS, "cost", {"policy": "a"}).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("labels", [{"policy": "c"}, {}])
def test_labels_that_leave_no_run_or_several_are_refused(labels: dict[str, object]) -> None:
    with pytest.raises(SimulationError, match="must leave one a seed"):
        values(RUNS, "cost", labels)


def test_pairs_are_of_a_seed() -> None:
    found = contrast(RUNS, "cost", PAIR)
    assert isinstance(found, PairedDifference)
    assert found.mean == found.low == found.high == 0.5


def test_what_may_be_infinite_is_compared_by_its_median() -> None:
    assert isinstance(contrast(RUNS, "tracking_rms_mm", PAIR), PairedMedian)
    assert interval(RUNS, "tracking_rms_mm", {"policy": "b"}).value == 1.5


def test_a_family_has_a_comparison_for_each_pair() -> None:
    found = family_of(RUNS, "which?", "cost", {"one": PAIR, "other": PAIR[::-1]})
    assert list(found.comparisons) == ["one", "other"]
    assert found.comparisons["other"].direction == -1
