"""The questions that a campaign is asked."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from dwell_lab.validation.campaign_questions import (
    answer_of,
    compared,
)


@pytest.mark.parametrize(
    ("by_other", "answer"),
    [
        ({"LOC": "lower", "SO": "lower"}, "yes"),
        ({"LOC": "higher", "SO": "lower"}, "no"),
        ({"LOC": "no difference shown", "SO": "lower"}, "not shown"),
    ],
)
def test_an_answer_asks_for_all_others(by_other: dict[str, str], answer: str) -> None:
    rows = [("violation_rate", "net", "HYB", other, word) for other, word in by_other.items()]
    rows.append(("violation_rate", "net", "dtp", "LOC", "higher"))
    names = ["metric", "scenario", "first", "second", "word"]
    table = pl.DataFrame(rows, schema=names, orient="row")
    assert answer_of(table, "HYB", ("LOC", "SO")) == answer


def test_a_run_that_is_missing_leaves_its_pair_out_alone() -> None:
    ramp = np.linspace(1.0, 1.1, 9)
    runs = pl.concat(
        pl.DataFrame(
            {
                "policy": [name] * 9,
                "seed": range(9),
                "violation_rate": size * ramp,
                "played": [f"{name} {seed}" for seed in range(9)],
            }
        )
        for name, size in (("HYB", 0.3), ("LOC", 0.5))
    )
    pairs = {"both": ({"policy": "HYB"}, {"policy": "LOC"})}
    short = runs.filter(~((pl.col("policy") == "LOC") & (pl.col("seed") == 3)))
    assert compared(runs, "?", "violation_rate", pairs).comparisons["both"].n == 9
    assert compared(short, "?", "violation_rate", pairs).comparisons["both"].n == 8
    none = short.filter(pl.col("policy") == "HYB")
    assert compared(none, "?", "violation_rate", pairs).comparisons == {}
