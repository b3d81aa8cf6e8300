"""Families of comparisons, against hand examples and what Holm's procedure promises."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import MetricError, SimulationError
from dwell.study.family import Family, cannot_tell, holm, played_alike, seed_values
from dwell.study.pairs import (
    PairedDifference,
    PairedMedian,
    SameRun,
    paired_difference,
    paired_median,
)

chances = st.lists(st.floats(0, 1), max_size=12)


def test_holm_by_hand() -> None:
    # 0.01 · 4, 0.02 · 3, then 0.03 · 2 = 0.06, and 0.04 · 1 may not be below it.
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.5, 0.4]) == pytest.approx([0.8, 0.8])
    assert holm([0.01]) == [0.01]
    assert holm([]) == []


def test_holm_by_hand_again() -> None:
    # Sorted: 0.001 · 7, 0.0025 · 6, 0.01 · 5, 0.02 · 4, 0.05 · 3, 0.5 · 2, 0.69.
    found = holm([0.50, 0.01, 0.001, 0.69, 0.02, 0.05, 0.0025])
    assert found == pytest.approx([1.0, 0.05, 0.007, 1.0, 0.08, 0.15, 0.015])


@pytest.mark.parametrize("bad", [-0.1, 1.1, float("nan")])
def test_what_is_no_probability_is_refused(bad: float) -> None:
    with pytest.raises(SimulationError, match=r"p value is .*\[0, 1\]"):
        holm([0.5, bad])


@given(chances)
def test_holm_keeps_the_order_and_lies_between_raw_and_bonferroni(values: Sequence[float]) -> None:
    found = holm(values)
    for raw, adjusted in zip(values, found, strict=True):
        assert raw <= adjusted <= min(len(values) * raw, 1.0) + 1e-15
    order = np.argsort(values, kind="stable")
    assert (np.diff(np.array(found)[order]) >= 0).all()


@given(chances, st.randoms(use_true_random=False))
def test_holm_does_not_know_positions(values: list[float], random: object) -> None:
    order = list(range(len(values)))
    random.shuffle(order)  # type: ignore[attr-defined]
    found = holm(values)
    assert holm([values[i] for i in order]) == [found[i] for i in order]


@given(chances, st.floats(0, 1))
def test_one_more_comparison_never_makes_another_smaller(
    values: Sequence[float], more: float
) -> None:
    pairs = zip(holm(values), holm([*values, more]), strict=False)
    assert all(larger >= smaller for smaller, larger in pairs)


def make_family() -> Family:
    rng = np.random.default_rng(1)
    base = rng.normal(10, 1, size=20)
    return Family(
        "is it cheaper?",
        "cost",
        {
            "cheap": paired_difference(base - rng.uniform(1, 2, 20), base),
            "dear": paired_difference(base + rng.uniform(0, 2, 20), base),
            "same": paired_difference(base + rng.normal(0, 1, 20), base),
        },
    )


def test_verdicts_are_about_the_first_of_a_pair() -> None:
    family = make_family()
    assert family.verdicts == {"cheap": "lower", "dear": "higher", "same": "no difference shown"}
    assert family.verdict("dear") == "higher"


def test_a_verdict_rests_on_the_adjusted_p() -> None:
    alone = PairedDifference(-1.0, -2.0, -0.1, -0.6, 0.8, 0.03, 20)
    assert Family("q", "m", {"a": alone}).verdict("a") == "lower"
    assert Family("q", "m", {"a": alone, "b": alone}).verdict("a") == "no difference shown"


def test_five_seeds_show_nothing() -> None:
    family = Family("q", "m", {"a": paired_difference([1.0] * 5, [2.0, 2.1, 2.2, 2.3, 2.4])})
    assert family.verdict("a") == "cannot tell with 5 seeds"


def test_what_a_family_cannot_tell_it_says() -> None:
    assert [cannot_tell(seeds) for seeds in (1, 3, 5, 6)] == [
        "cannot tell with 1 seed",
        "cannot tell with 3 seeds",
        "cannot tell with 5 seeds",
        "",
    ]
    # The smallest of 2 p values is doubled: 2 * 2 / 2**6 is above 5 %.
    assert cannot_tell(6, 2) == "cannot tell with 6 seeds"
    assert cannot_tell(7, 2) == ""
    first, second = [1.0, 1.1, 1.2, 1.3, 1.4, 1.5], [2.0] * 6
    pairs = {name: paired_difference(first, second) for name in ("a", "b")}
    assert set(Family("q", "m", pairs).verdicts.values()) == {"cannot tell with 6 seeds"}
    assert Family("q", "m", {"a": pairs["a"]}).verdict("a") == "lower"


def test_an_unknown_comparison_is_named() -> None:
    with pytest.raises(SimulationError, match=r"no comparison 'x'.*cheap, dear, same"):
        make_family().verdict("x")


def test_the_table_has_all_numbers() -> None:
    family = make_family()
    table = family.table()
    assert table["comparison"].to_list() == ["cheap", "dear", "same"]
    cheap = family.comparisons["cheap"]
    assert isinstance(cheap, PairedDifference)
    row = table.row(0, named=True)
    assert row == {
        "question": "is it cheaper?",
        "metric": "cost",
        "comparison": "cheap",
        "centre": "mean",
        "difference": cheap.mean,
        "low": cheap.low,
        "high": cheap.high,
        "d_z": cheap.d_z,
        "superiority": 1.0,
        "n": 20,
        "p": cheap.p,
        "p_holm": 3 * cheap.p,
        "p_least": 3 * 2 / 2**cheap.n,
        "verdict": "lower",
    }


def test_the_table_takes_medians_and_nothing() -> None:
    item = paired_median([1.0, 2.0], [float("inf"), 1.0])
    assert isinstance(item, PairedMedian)
    row = Family("q", "p95_ms", {"a": item}).table().row(0, named=True)
    assert row["centre"] == "median"
    assert row["difference"] == -float("inf")
    assert row["d_z"] is None
    assert row["low"] is None
    empty = Family("q", "m", {}).table()
    assert empty.is_empty()
    assert empty.columns == make_family().table().columns


# --------------------------------------------------------------------------------- of runs

RUNS = pl.DataFrame(
    {
        "policy": ["a", "a", "a", "b", "b", "b"],
        "seed": [3, 1, 2, 1, 2, 3],
        "cost": [3.0, 1.0, 2.0, 0.5, 1.5, 2.5],
        "tracking_rms_mm": [3.0, 1.0, float("inf"), 0.5, 1.5, float("inf")],
        "played": list("abcdef"),
    }
)
PAIR = ({"policy": "a"}, {"policy": "b"})


def test_values_come_in_the_order_of_seeds() -> None:
    assert seed_values(RUNS, "cost", {"policy": "a"}).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("labels", [{"policy": "c"}, {}])
def test_labels_that_leave_no_run_or_several_are_refused(labels: dict[str, object]) -> None:
    with pytest.raises(SimulationError, match="must leave one a seed"):
        seed_values(RUNS, "cost", labels)


def test_a_metric_that_runs_do_not_have_is_refused() -> None:
    with pytest.raises(MetricError, match="unknown metric 'costs'; did you mean 'cost'"):
        Family.of_runs(RUNS, "which?", "costs", {"one": PAIR})


def test_a_family_of_runs_has_a_comparison_for_each_pair() -> None:
    found = Family.of_runs(RUNS, "which?", "cost", {"one": PAIR, "other": PAIR[::-1]})
    assert list(found.comparisons) == ["one", "other"]
    first = found.comparisons["one"]
    assert isinstance(first, PairedDifference)
    assert first.mean == first.low == first.high == 0.5
    assert found.tested["other"].direction == -1
    # Three pairs have no p value below 2 / 2^3, and the least of two is doubled.
    assert found.table()["p_least"].to_list() == [0.5, 0.5]


def test_what_is_the_same_run_is_no_comparison() -> None:
    """Its difference is 0 without an interval, and it does not count in its family."""
    alike = RUNS.with_columns(
        pl.col("cost", "tracking_rms_mm").sort_by("seed").over("seed"),
        played=pl.format("{}", pl.col("seed")),
    ).with_columns(cost=pl.col("seed").cast(pl.Float64), tracking_rms_mm=pl.lit(1.0))
    for metric in ("cost", "tracking_rms_mm"):
        found = Family.of_runs(alike, "which?", metric, {"one": PAIR})
        assert found.comparisons == {"one": SameRun(3)}
        row = found.table().row(0, named=True)
        assert (row["difference"], row["n"], row["verdict"]) == (0.0, 3, "same run")
        known = ("low", "high", "d_z", "p", "p_holm", "p_least")
        assert [row[name] for name in known] == [None] * 6
    third = RUNS.filter(policy="a").with_columns(
        policy=pl.lit("c"), played=pl.format("c{}", pl.col("seed")), cost=pl.col("cost") + 9
    )
    three = pl.concat([alike, third], how="diagonal")
    pairs = {"same": PAIR, "other": ({"policy": "c"}, {"policy": "a"})}
    family = Family.of_runs(three, "which?", "cost", pairs)
    # Three pairs have no p value below 2 / 2^3, and there is one comparison.
    assert family.table()["p_least"].to_list() == [None, 0.25]
    assert family.verdicts == {"same": "same run", "other": "cannot tell with 3 seeds"}
    assert list(family.adjusted) == ["other"]


@pytest.mark.parametrize(
    "played",
    [
        pl.format("{} {}", "policy", "seed").alias("played"),
        pl.when(pl.col("seed") < 3).then(pl.lit("equal")).otherwise("policy").alias("played"),
        pl.lit(None, pl.String).alias("played"),
    ],
)
def test_what_is_not_known_to_be_the_same_run_is_compared(played: pl.Expr) -> None:
    """Of other runs, and of runs that are the same under some seeds only."""
    equal = RUNS.with_columns(played, cost=pl.lit(1.0))
    assert not played_alike(equal, PAIR)
    assert Family.of_runs(equal, "which?", "cost", {"one": PAIR}).tested.keys() == {"one"}


def test_the_same_cycles_priced_otherwise_are_compared() -> None:
    alike = RUNS.with_columns(played=pl.lit("equal"))
    assert played_alike(alike, PAIR) == "same run"
    assert Family.of_runs(alike, "which?", "cost", {"one": PAIR}).tested.keys() == {"one"}


def test_the_same_latencies_under_another_load_are_the_same_cycles() -> None:
    """Shadow jobs may load a node and delay no cycle: V_D is equal, and U is compared."""
    alike = RUNS.with_columns(
        latencies=pl.format("{}", "seed"), violation_rate=pl.lit(0.1), u_edge=pl.col("cost")
    )
    assert played_alike(alike, PAIR) == "same cycles"
    rate = Family.of_runs(alike, "which?", "violation_rate", {"one": PAIR})
    assert rate.verdicts == {"one": "same cycles"}
    assert not rate.tested
    assert Family.of_runs(alike, "which?", "u_edge", {"one": PAIR}).tested.keys() == {"one"}


def test_what_may_be_infinite_is_compared_by_its_median() -> None:
    found = Family.of_runs(RUNS, "which?", "tracking_rms_mm", {"one": PAIR})
    assert isinstance(found.comparisons["one"], PairedMedian)
