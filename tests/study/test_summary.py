"""Summaries of runs against tables made by hand."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dwell
from dwell.errors import SimulationError
from dwell.model import MovingTarget, Problem, Servo
from dwell.model.instants import NEVER_NS
from dwell.record import OUTCOMES, Run
from dwell.study.quality import actuations, track
from dwell.study.summary import (
    Latencies,
    count_in,
    latency_grid_ms,
    longest_streak,
    mean_of,
    summarise,
)
from tests.cells.examples import EXAMPLES
from tests.cells.small import make_problem

W = 4
LABELS: dict[str, str | int] = {"scenario": "baseline", "policy": "dtp", "seed": 1}
# Age at the actuator in the run below, from the release of cycle 4 (132 ms) to 33 ms after that of
# cycle 15: at its begin cycle 2 was the newest in effect.
TEETH = (
    (66, 70),
    (4, 38),
    (5, 39),
    (6, 74),
    (8, 42),
    (9, 43),
    (10, 78),
    (12, 46),
    (13, 47),
    (14, 66),
)


def make_run(
    placements: Sequence[str] = ("LOC", "LOC", "SO", "LOC"),
    *,
    warmup: int = 1,
    tail: int = 3,
) -> Run:
    """Return a run of windows of four cycles, with some that no window holds at its end.

    Cycle i takes i milliseconds; every fourth is lost, and so are the last ones, never played.
    """
    count = len(placements)
    following = [*placements[1:], placements[-1]]
    cycles = count * W + tail
    lost = [i % W == W - 1 or i >= count * W for i in range(cycles)]
    final = [None if gone else i * 1_000_000 for i, gone in enumerate(lost)]
    outcomes = ["in_flight" if i >= count * W else "dropped" for i in range(cycles)]
    tables = {
        "cycles": pl.DataFrame(
            {
                "cycle": range(cycles),
                "release_ns": [33_000_000 * i for i in range(cycles)],
                "placement": "LOC",
                "latency_ns": final,
                "missed": lost,
                "outcome": [
                    how if gone else "done" for gone, how in zip(lost, outcomes, strict=True)
                ],
                "compute_ns": [None if gone else 600_000 for gone in lost],
                "queue_ns": [None if gone else 0 for gone in lost],
                "network_ns": [None if gone else 400_000 for gone in lost],
            },
            schema_overrides={"outcome": pl.Enum(OUTCOMES)},
        ),
        "windows": pl.DataFrame(
            {
                "window": range(count),
                "first_cycle": [W * i for i in range(count)],
                "warmup": [i < warmup for i in range(count)],
                "placement": list(placements),
                "seen_l95_ms": [10.0 * (i + 1) for i in range(count)],
                "violation_rate": 0.25,
                "u_R1": [0.9, 0.2, 0.4, 0.6][:count],
                "u_E": 0.1,
                "u_R2": [0.1, 0.3, 0.3, 0.3][:count],
                "cost": [9.0, 1.0, 2.0, 3.0][:count],
            }
        ),
        "decisions": pl.DataFrame(
            {
                "window": range(count),
                "incumbent": list(placements),
                "placement": following,
                "reason": ["hold"] * len(placements),
                "migrated": [a != b for a, b in zip(placements, following, strict=True)],
                "j_LOC": [1.0] * count,
                "j_SO": [2.0] * count,
                "j_HYB": [None] * count,
            },
            schema_overrides={"j_HYB": pl.Float64},
        ),
    }
    return Run({}, tables)


def test_the_warm_up_and_what_no_window_holds_are_left_out() -> None:
    counted = count_in(make_run(), W)
    assert counted.windows["window"].to_list() == [1, 2, 3]
    assert counted.decisions["window"].to_list() == [1, 2, 3]
    assert counted.cycles["cycle"].to_list() == list(range(4, 16))


def test_a_run_of_warm_up_alone_is_refused() -> None:
    with pytest.raises(SimulationError, match="ask for more windows"):
        count_in(make_run(warmup=4), W)


def test_a_row_holds_what_the_tables_show() -> None:
    row = summarise(make_run(), make_problem(warmup_windows=1, window_cycles=W), LABELS).row
    for digest in ("played", "latencies"):
        assert re.fullmatch(r"[0-9a-f]{16}", str(row.pop(digest)))
    expected = {
        **LABELS,
        "windows": 3,
        "cycles": 12,
        "violation_rate": 0.25,
        "l95_ms": 30.0,
        "p95_ms": math.inf,
        "p50_ms": 10.0,
        "spread_ms": math.inf,
        # The busiest robot of each window: 0.3, 0.4 and 0.6.
        "u_robot": pytest.approx(1.3 / 3),
        "u_edge": pytest.approx(0.1),
        "node_R1": pytest.approx(0.4),
        "node_E": pytest.approx(0.1),
        "node_R2": pytest.approx(0.3),
        "migrations": 2,
        "returns": 1,
        "guard_moves": 0,
        "share_LOC": pytest.approx(2 / 3),
        "share_SO": pytest.approx(1 / 3),
        "share_HYB": 0.0,
        "cost": 2.0,
        "lost": 3,
        "longest_misses": 1,
        # There are 12 cycles: the whole run is the only stretch.
        "in_flight": 0,
        "misses_in_20": 3,
        "over_1_in_20": 1.0,
        "misses_in_100": 3,
        "over_5_in_100": 0.0,
        "aoi_mean_ms": pytest.approx(sum(b * b - a * a for a, b in TEETH) / 2 / 396),
        # 5 % of 396 ms are spent above: (78 - a) + (74 - a) + (70 - a) = 19.8.
        "aoi_p95_ms": pytest.approx(67.4),
        "aoi_peak_ms": 78.0,
        "aoi_mean_peak_ms": pytest.approx(53.0),
        "compute_ms": pytest.approx(0.6),
        "queue_ms": 0.0,
        "network_ms": pytest.approx(0.4),
    }
    assert row == expected


def test_moves_of_the_guard_are_counted_apart() -> None:
    made = make_run()
    moves = made.decisions["migrated"].to_list()
    reasons = ["guard" if moved and i == 1 else "hold" for i, moved in enumerate(moves)]
    decisions = made.decisions.with_columns(reason=pl.Series(reasons))
    run = Run({}, {"cycles": made.cycles, "windows": made.windows, "decisions": decisions})
    row = summarise(run, make_problem(warmup_windows=1, window_cycles=W), LABELS).row
    assert (row["migrations"], row["returns"], row["guard_moves"]) == (1, 0, 1)


def on_gpu(**objective: Any) -> Problem:
    """The fan-in example with another objective."""
    problem = dwell.load(EXAMPLES / "fan-in.yaml")
    return replace(problem, objective=replace(problem.objective, **objective))


def test_accelerators_are_in_a_row_and_in_u_e_where_j_takes_them() -> None:
    labels: dict[str, str | int] = {"scenario": "baseline", "policy": "EDGE", "seed": 1}
    problem = on_gpu()
    run = dwell.simulate(problem, policy="EDGE", seed=1, windows=problem.warmup_windows + 3)
    row = summarise(run, problem, labels).row
    # Two tasks of 5 and 3 ms at P = 50 ms.
    assert row["node_E.gpu"] == pytest.approx(0.16, rel=0.05)
    assert row["u_edge"] == row["node_E"] != row["node_E.gpu"]
    taken = on_gpu(accelerators={"E.gpu": "edge"})
    assert summarise(run, taken, labels).row["u_edge"] == row["node_E.gpu"]


def test_j_of_a_run_takes_accelerators_where_the_cell_says_so() -> None:
    runs = [
        dwell.simulate(on_gpu(**more), policy="EDGE", seed=1, windows=3)
        for more in ({}, {"accelerators": {"E.gpu": "edge"}})
    ]
    weights, targets = on_gpu().objective.weights, on_gpu().objective.targets
    more = weights.edge * (runs[0].windows["u_E.gpu"] - runs[0].windows["u_E"]) / targets.edge
    expected = (runs[0].windows["cost"] + more).to_list()
    assert runs[1].windows["cost"].to_list() == pytest.approx(expected)


def test_runs_are_told_apart_by_what_was_played_and_by_nothing_else() -> None:
    problem = make_problem(warmup_windows=1, window_cycles=W)

    def played(table: str = "", digest: str = "played", **columns: pl.Expr) -> object:
        tables = {name: getattr(make_run(), name) for name in ("cycles", "windows", "decisions")}
        if table:
            tables[table] = tables[table].with_columns(**columns)
        return summarise(Run({}, tables), problem, LABELS).row[digest]

    same = played()
    # Another policy believes otherwise; what is left out does not count.
    assert played("decisions", j_LOC=pl.lit(7.0)) == same
    assert played("cycles", placement=before(4, "SO", pl.col("placement"))) == same
    assert played("cycles", placement=before(5, "SO", pl.col("placement"))) != same
    assert played("cycles", latency_ns=before(5, 1, pl.col("latency_ns"))) != same
    assert played("cycles", latency_ns=before(5, None, pl.col("latency_ns"))) != same
    # Shadow jobs that delay nobody load a node.
    assert played("windows", u_E=pl.lit(0.2)) != same
    latencies = played(digest="latencies")
    assert played("windows", "latencies", u_E=pl.lit(0.2)) == latencies
    later = before(5, 1, pl.col("latency_ns"))
    assert played("cycles", "latencies", latency_ns=later) != latencies


def before(cycle: int, value: object, other: pl.Expr) -> pl.Expr:
    """Return a column with a value in the cycles before one."""
    return pl.when(pl.col("cycle") < cycle).then(pl.lit(value)).otherwise(other)


def test_costs_are_those_estimated_while_idle_and_measured_while_active() -> None:
    costs = summarise(make_run(), make_problem(warmup_windows=1, window_cycles=W), LABELS).costs
    by_name = {row["candidate"]: row for row in costs}
    assert (by_name["LOC"]["estimated"], by_name["LOC"]["measured"]) == (1.0, 2.0)
    assert (by_name["SO"]["estimated"], by_name["SO"]["measured"]) == (2.0, 2.0)
    assert math.isnan(float(by_name["HYB"]["estimated"]))
    assert math.isnan(float(by_name["HYB"]["measured"]))


def test_a_distribution_counts_what_finished() -> None:
    summary = summarise(make_run(), make_problem(warmup_windows=1, window_cycles=W), LABELS)
    grid = latency_grid_ms(33.0)
    finished = [i for i in range(4, 16) if i % W != W - 1]
    assert summary.within.tolist() == [sum(i <= at for i in finished) for at in grid]


@given(
    st.lists(st.one_of(st.just(NEVER_NS), st.integers(0, 200_000_000)), min_size=1, max_size=50),
    st.one_of(st.floats(1e-6, 1e-3), st.floats(1e-3, 1e3)),
)
def test_a_distribution_is_that_of_comparing_with_every_point(
    lengths: list[int], deadline_ms: float
) -> None:
    points_ns = np.rint(latency_grid_ms(deadline_ms) * 1e6).astype(np.int64)
    # The points themselves too, and what is beside them.
    near = [int(ns) + offset for ns in points_ns[::37] for offset in (-1, 0, 1)]
    latency_ns = np.array(lengths + near, np.int64)
    latencies = Latencies.of(latency_ns, deadline_ms)
    assert latencies.within.tolist() == [int((latency_ns <= ns).sum()) for ns in points_ns]
    ascending_ns = np.sort(latency_ns)
    for percent in (1, 50, 95, 100):
        ns = ascending_ns[-(-percent * len(ascending_ns) // 100) - 1]
        expected = float(ns) / 1e6 if ns < NEVER_NS else math.inf
        assert latencies.percentile_ms(percent) == expected


@given(
    st.lists(
        st.one_of(st.none(), st.floats(-1e12, 1e12), st.just(math.inf)), min_size=0, max_size=700
    ),
    st.integers(0, 2000),
)
def test_a_mean_is_that_of_the_column_of_a_table_to_the_last_bit(
    values: list[float | None], more: int
) -> None:
    drawn = np.random.default_rng(more).lognormal(size=more)
    series = pl.Series([*values, *drawn], dtype=pl.Float64)
    mean = mean_of(series.to_numpy())
    expected = series.mean()
    assert mean == expected if expected is not None else math.isnan(mean)


@given(st.lists(st.one_of(st.none(), st.integers(0, 10**12)), max_size=300))
def test_a_mean_of_whole_numbers_is_exact(values: list[int | None]) -> None:
    mean = mean_of(np.array([NEVER_NS if one is None else one for one in values], np.int64))
    expected = pl.Series(values, dtype=pl.Int64).mean()
    assert mean == expected if expected is not None else math.isnan(mean)


def test_tracking_is_shown_where_the_cell_has_a_servo() -> None:
    problem = make_problem(warmup_windows=1, window_cycles=W)
    servo = Servo("integrator", 4.0, MovingTarget(40.0, 1.6))
    run = make_run()
    with_servo = summarise(run, replace(problem, servo=servo), LABELS).row
    without = summarise(run, problem, LABELS).row
    assert {**without, **with_servo} == with_servo
    assert set(with_servo) - set(without) == {"tracking_rms_mm", "tracking_iae_mm"}
    # The loop runs from cycle 0; cycles 4 to 15 count.
    cycles = run.cycles.head(16)
    actuated = actuations(
        cycles["release_ns"].to_numpy(), cycles["latency_ns"].fill_null(NEVER_NS).to_numpy()
    )
    found = track(servo, actuated, 132_000_000, 528_000_000)
    assert with_servo["tracking_rms_mm"] == found.rms_mm
    assert with_servo["tracking_iae_mm"] == found.mean_mm


def test_the_deadline_is_a_point_of_the_grid() -> None:
    assert 100 / 3 in latency_grid_ms(100 / 3)


@pytest.mark.parametrize(
    ("missed", "length"), [("", 0), ("..", 0), ("xx", 2), (".xx.xxx.", 3), ("xx.x", 2)]
)
def test_longest_streak(missed: str, length: int) -> None:
    assert longest_streak(np.array([letter == "x" for letter in missed], bool)) == length
