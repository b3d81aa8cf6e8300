"""Columns of a table as arrays: the same as those of its frame, whichever of them is made first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.model.instants import NEVER_NS
from dwell.record import Names, Run, TableArrays, arrays_of

ROOT = Path(__file__).parents[2]
TABLES = ("cycles", "windows", "decisions")


def simulated(policy: str, estimator: str | None = None) -> Run:
    cell = dwell.load(ROOT / "examples" / "canonical.yaml")
    return dwell.simulate(
        cell, scenario="network-impairment", policy=policy, estimator=estimator, seed=1, windows=7
    )


@pytest.mark.parametrize("policy", ["dtp", "SO"])
@pytest.mark.parametrize("estimator", ["profile", "corrected"])
def test_arrays_are_what_the_frames_hold(policy: str, estimator: str) -> None:
    run, frames = simulated(policy, estimator), simulated(policy, estimator)
    for table in TABLES:
        arrays, others = run.arrays(table), arrays_of(getattr(frames, table))
        assert set(arrays) == set(others)
        for name in arrays:
            if isinstance(getattr(frames, table).schema[name], pl.Enum):
                assert arrays.names(name).to_list() == others.names(name).to_list()
                assert arrays.names(name).known == others.names(name).known
            else:
                np.testing.assert_array_equal(arrays[name], others[name])


def test_a_frame_is_the_same_after_its_arrays_have_been_asked_for() -> None:
    run = simulated("dtp")
    for table in TABLES:
        assert len(run.arrays(table)["window" if table != "cycles" else "cycle"])
        assert getattr(run, table).equals(getattr(simulated("dtp"), table))
        assert set(run.arrays(table)) == set(getattr(run, table).columns)


def test_what_is_lost_or_was_not_seen_has_no_value() -> None:
    frame = pl.DataFrame(
        {"latency_ns": [5, None], "cost": [None, 1.0], "missed": [False, True]},
        schema_overrides={"latency_ns": pl.Int64, "cost": pl.Float64},
    )
    arrays = arrays_of(frame)
    assert arrays["latency_ns"].tolist() == [5, NEVER_NS]
    np.testing.assert_array_equal(arrays["cost"], [np.nan, 1.0])
    assert arrays["missed"].tolist() == [False, True]


def test_names_of_a_text_and_of_an_enum_are_the_same() -> None:
    names = ["SO", "LOC", "SO"]
    kinds = (pl.String(), pl.Enum(["LOC", "SO", "HYB"]))
    for column in (arrays_of(pl.DataFrame({"at": pl.Series(names, dtype=one)})) for one in kinds):
        found = column.names("at")
        assert found.to_list() == names
        assert found.equal("SO").tolist() == [True, False, True]
        assert found.equal("nowhere").tolist() == [False, False, False]
        assert found[found.equal("LOC")].to_list() == ["LOC"]


def test_names_that_are_not_known_are_refused() -> None:
    with pytest.raises(KeyError, match="HYB"):
        Names.of(["LOC", "HYB"], ["LOC", "SO"])


def test_a_column_is_made_once_and_when_it_is_asked_for() -> None:
    made = []

    def make() -> list[float | None]:
        made.append(1)
        return [1.0, None]

    arrays = TableArrays({"cost": make, "other": [True]})
    assert not made
    np.testing.assert_array_equal(arrays["cost"], [1.0, np.nan])
    assert set(arrays.columns()) == {"cost", "other"}
    assert len(made) == 1
