"""Processes: bounds, marginal distributions, and how traces are replayed."""

from __future__ import annotations

import math
import re
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.errors import ProblemError, TraceError
from dwell.model import (
    AR1,
    Constant,
    Exponential,
    Gamma,
    LogNormal,
    Normal,
    Process,
    Trace,
    TraceTable,
    Uniform,
)
from tests.cells.strategies import processes

Floats = NDArray[np.float64]


@pytest.mark.parametrize(
    ("kind", "values", "path", "bound"),
    [
        (Constant, (-1,), "constant", "from 0 to 1e9"),
        (Constant, (math.nan,), "constant", "from 0 to 1e9"),
        (Constant, (True,), "constant", "a number"),
        (Constant, (10**400,), "constant", "from 0 to 1e9"),
        (Uniform, (2, 1), "uniform.high", "at least low = 2"),
        (Uniform, (-1, 1), "uniform.low", "from 0 to 1e9"),
        (Normal, (math.inf, 1), "normal.mean", "from -1e9 to 1e9"),
        (Normal, (1, -1), "normal.std", "from 0 to 1e9"),
        (LogNormal, (0, 1), "lognormal.mean", "above 0 and at most 1e9"),
        (LogNormal, (1, 101), "lognormal.cv", "from 0 to 100"),
        (Gamma, (1, 0), "gamma.cv", "from 1e-6 to 100"),
        (Exponential, (0,), "exponential.mean", "above 0"),
        (AR1, (1, 1, 1), "ar1.rho", "above -1 and below 1"),
        (AR1, (1, 2, -0.9), "ar1.rho", "reachable by a positive process of cv 2"),
    ],
)
def test_a_value_out_of_bounds(
    kind: type[Any], values: tuple[float, ...], path: str, bound: str
) -> None:
    with pytest.raises(ProblemError) as caught:
        kind(*values)
    (fault,) = caught.value.faults
    assert fault.path == path
    assert bound in fault.message


@given(processes(), st.integers(0, 2**32))
def test_draws_are_numbers_that_are_not_negative(process: Process, seed: int) -> None:
    values = process.marginal(np.random.default_rng(seed), 50)
    assert values.shape == (50,)
    assert (values >= 0).all()
    assert 0 <= process.expectation < math.inf


@pytest.mark.parametrize(
    ("process", "mean", "deviation"),
    [
        (Constant(3), 3, 0),
        (Uniform(2, 4), 3, 2 / math.sqrt(12)),
        (Normal(5, 1), 5, 1),
        (LogNormal(3, 0.5), 3, 1.5),
        (Gamma(3, 0.5), 3, 1.5),
        (Exponential(3), 3, 3),
        (AR1(3, 0.5, 0.9), 3, 1.5),
    ],
)
def test_draws_have_the_moments_declared(process: Process, mean: float, deviation: float) -> None:
    draws = 200_000
    values = process.marginal(np.random.default_rng(7), draws)
    assert process.expectation == pytest.approx(mean, rel=1e-6)
    assert values.mean() == pytest.approx(mean, abs=5 * deviation / math.sqrt(draws) + 1e-9)
    assert values.std() == pytest.approx(deviation, rel=0.03)


def test_the_mean_of_a_clipped_normal_is_that_of_its_draws() -> None:
    process = Normal(1, 2, 0.5)
    values = process.marginal(np.random.default_rng(7), 400_000)
    assert values.mean() == pytest.approx(process.expectation, rel=0.01)
    assert Normal(-3, 0, 2).expectation == 2


@pytest.mark.parametrize("cv", [0.0, 1e-170, 1e-9, 1e-3])
def test_a_process_that_hardly_varies_keeps_its_correlation(cv: float) -> None:
    assert AR1(1, cv, -0.5).log_correlation == pytest.approx(-0.5, rel=1e-3)


# ---------------------------------------------------------------------------------- replay


def _table(
    rows: int,
    starts: tuple[int, ...] = (0,),
    time_ms: Floats | None = None,
    by: Literal["row", "time"] = "row",
    wrap: bool = False,
) -> TraceTable:
    return TraceTable(
        "t.csv",
        {"a": np.arange(rows, dtype=np.float64)},
        by=by,
        starts=np.array(starts),
        time_ms=time_ms,
        wrap=wrap,
    )


def _seeds(table: TraceTable, release_ms: Floats, count: int = 200) -> list[list[int]]:
    return [table.replay(np.random.default_rng(seed), release_ms).tolist() for seed in range(count)]


def _releases(cycles: int, period_ms: float = 10.0, begin_ms: float = 0.0) -> Floats:
    return np.array([begin_ms + cycle * period_ms for cycle in range(cycles)], np.float64)


def test_rows_follow_one_another_from_every_start_that_leaves_enough() -> None:
    found = _seeds(_table(6), _releases(4))
    assert {tuple(rows) for rows in found} == {(0, 1, 2, 3), (1, 2, 3, 4), (2, 3, 4, 5)}


def test_rows_stay_within_a_group() -> None:
    found = _seeds(_table(9, (0, 2, 5)), _releases(3))
    assert {tuple(rows) for rows in found} == {(2, 3, 4), (5, 6, 7), (6, 7, 8)}


def test_a_trace_of_exactly_the_run_has_one_start() -> None:
    assert _seeds(_table(4), _releases(4), 5) == [[0, 1, 2, 3]] * 5
    with pytest.raises(TraceError, match="the trace has 4 rows but the run needs 5 cycles"):
        _table(4).replay(np.random.default_rng(0), _releases(5))


def test_the_longest_group_is_named_where_none_is_long_enough() -> None:
    with pytest.raises(TraceError) as caught:
        _table(9, (0, 2, 5)).replay(np.random.default_rng(0), _releases(5))
    (fault,) = caught.value.faults
    assert fault.path == "t.csv"
    assert "the longest group has 4 rows but the run needs 5 cycles" in fault.message
    assert "wrap: true" in fault.message


def test_rows_that_wrap_go_round_the_whole_file() -> None:
    found = _seeds(_table(3, (0, 1), wrap=True), _releases(5))
    assert {tuple(rows) for rows in found} == {(0, 1, 2, 0, 1), (1, 2, 0, 1, 2), (2, 0, 1, 2, 0)}


def test_by_time_a_cycle_takes_the_latest_row_sent() -> None:
    """Rows every 20 ms and cycles every 10: each row serves two cycles, whatever the offset."""
    table = _table(6, time_ms=_releases(6, 20), by="time")
    for rows in _seeds(table, _releases(8, begin_ms=500)):
        assert set(np.diff(rows)) <= {0, 1}
        assert np.diff(rows).sum() in {3, 4}
        assert rows[0] >= 0
        assert rows[-1] <= 5


def test_by_time_an_exact_span_is_long_enough() -> None:
    table = _table(5, time_ms=_releases(5), by="time")
    assert _seeds(table, _releases(5), 5) == [[0, 1, 2, 3, 4]] * 5
    within_a_nanosecond = _releases(5) * (1 + 1e-9)
    assert _seeds(table, within_a_nanosecond, 2) == [[0, 1, 2, 3, 4]] * 2
    with pytest.raises(TraceError, match=re.escape("has 0.04 s but the run needs 0.05 s")):
        table.replay(np.random.default_rng(0), _releases(6))


def test_by_time_groups_of_exactly_the_span_are_all_used() -> None:
    time_ms = np.concatenate((_releases(3), _releases(2), _releases(3)))
    table = _table(8, (0, 3, 5), time_ms, by="time")
    assert {tuple(rows) for rows in _seeds(table, _releases(3))} == {(0, 1, 2), (5, 6, 7)}


def test_by_time_a_group_that_is_too_short_is_left_out() -> None:
    time_ms = np.concatenate((_releases(3), _releases(9)))
    table = _table(12, (0, 3), time_ms, by="time")
    for rows in _seeds(table, _releases(5)):
        assert rows[0] >= 3
        assert np.diff(rows).tolist() == [1, 1, 1, 1]


def test_by_time_a_trace_that_wraps_repeats_with_its_own_length() -> None:
    """Four rows 10 ms apart last 40 ms: cycles of 10 ms see each once a lap, in order."""
    table = _table(4, time_ms=_releases(4), by="time", wrap=True)
    for rows in _seeds(table, _releases(12)):
        assert (np.diff(rows) % 4 == 1).all()


def test_by_time_one_row_is_enough_to_wrap() -> None:
    table = _table(1, time_ms=np.zeros(1), by="time", wrap=True)
    assert table.replay(np.random.default_rng(0), _releases(3)).tolist() == [0, 0, 0]
    alone = _table(1, time_ms=np.zeros(1), by="time")
    assert alone.replay(np.random.default_rng(0), _releases(1)).tolist() == [0]


def test_by_time_groups_of_one_row_get_their_turn() -> None:
    time_ms = np.concatenate((_releases(3), np.zeros(1)))
    table = _table(4, (0, 3), time_ms, by="time", wrap=True)
    for rows in _seeds(table, _releases(8), 20):
        assert set(rows) == {0, 1, 2, 3}


@given(
    st.lists(st.lists(st.floats(0, 50), min_size=1, max_size=8), min_size=1, max_size=4),
    st.lists(st.floats(0.001, 30), max_size=12),
    st.sampled_from(("row", "time")),
    st.booleans(),
    st.integers(0, 1000),
)
def test_replay_is_in_range_in_order_and_causal(
    groups: list[list[float]],
    gaps: list[float],
    by: Literal["row", "time"],
    wrap: bool,
    seed: int,
) -> None:
    steps = [np.cumsum([0.0, *group[1:]]) for group in groups]
    starts = tuple(np.cumsum([0, *map(len, groups[:-1])]).tolist())
    table = _table(sum(map(len, groups)), starts, np.concatenate(steps), by, wrap)
    release_ms = np.cumsum([3.0, *gaps])
    try:
        rows = table.replay(np.random.default_rng(seed), release_ms)
    except TraceError:
        assert not wrap
        longest = max(map(len, groups)) if by == "row" else max(time[-1] for time in steps)
        needs = len(release_ms) if by == "row" else release_ms[-1] - release_ms[0]
        assert longest < needs
        return
    assert rows.shape == release_ms.shape
    assert rows.dtype == np.int64
    assert ((rows >= 0) & (rows < table.rows)).all()
    if not wrap:
        assert (np.diff(rows) >= 0).all()
        of = np.searchsorted(np.array(starts), rows, side="right")
        assert (of == of[0]).all()
        again = table.replay(np.random.default_rng(seed), release_ms)
        assert again.tolist() == rows.tolist()


def test_a_table_needs_rows_of_one_length_and_instants() -> None:
    with pytest.raises(TraceError, match="one length"):
        TraceTable("t.csv", {"a": np.zeros(2), "b": np.zeros(3)})
    with pytest.raises(TraceError, match="at least one row"):
        TraceTable("t.csv", {"a": np.zeros(0)})
    with pytest.raises(TraceError, match="time column"):
        TraceTable("t.csv", {"a": np.zeros(2)}, by="time")


def test_a_trace_draws_from_what_was_recorded() -> None:
    trace = Trace(_table(5), "a")
    assert trace.expectation == 2
    assert set(trace.marginal(np.random.default_rng(0), 100)) == {0, 1, 2, 3, 4}


def test_traces_are_equal_by_what_they_hold() -> None:
    def table(*values: float, wrap: bool = False) -> TraceTable:
        return TraceTable("t.csv", {"a": np.array(values)}, wrap=wrap)

    assert Trace(table(1.0, 2.0), "a") == Trace(table(1.0, 2.0), "a")
    assert hash(Trace(table(1.0, 2.0), "a")) == hash(Trace(table(1.0, 2.0), "a"))
    for other in (table(1.0, 3.0), table(1.0), table(1.0, 2.0, wrap=True)):
        assert Trace(table(1.0, 2.0), "a") != Trace(other, "a")
    timed = TraceTable("t.csv", {"a": np.ones(2)}, time_ms=np.array([0.0, 1.0]))
    assert timed != TraceTable("t.csv", {"a": np.ones(2)}, time_ms=np.array([0.0, 2.0]))
    assert timed != TraceTable("t.csv", {"a": np.ones(2)})
