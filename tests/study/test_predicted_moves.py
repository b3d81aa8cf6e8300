"""What was estimated of a placement when it was chosen, beside what it then showed."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from dwell import Run, simulate
from dwell.study.predicted_moves import COLUMNS, predicted_moves
from tests.cells.deterministic import cell, truth
from tests.report.pages import small_run

#: L95 (ms) and V_D that windows show, from 0.
L95_MS = (20.0, 20.0, 90.0, 30.0, 34.0, 38.0, 50.0, 21.0, 22.0, 23.0)
RATES = (0.0, 0.0, 0.9, 0.1, 0.2, 0.3, 0.5, 0.0, 0.0, 0.0)


def made(
    moves: list[dict[str, Any]],
    placements: str,
    *,
    warmup: int = 0,
    mixed: tuple[int, ...] = (),
    errors: bool = True,
) -> Run:
    """Return a run of candidates A and B whose windows show `L95_MS` and `RATES`."""
    count = len(placements)
    windows = pl.DataFrame(
        {
            "window": range(count),
            "warmup": [number < warmup for number in range(count)],
            "placement": list(placements),
            "mixed": [number in mixed for number in range(count)],
            "seen_l95_ms": L95_MS[:count],
            "seen_violation_rate": RATES[:count],
        }
    )
    usual = {"migrated": True, "reason": "cost", "last_cycle": 0}
    estimates: dict[str, float] = {"est_l95_ms_B": 31.0, "est_violation_rate_B": 0.15}
    estimates |= {"est_l95_ms_A": 21.0, "est_violation_rate_A": 0.0}
    if errors:
        estimates |= {"est_l95_error_ms_B": 0.5, "est_violation_error_B": 0.02}
    rows = [usual | estimates | move for move in moves]
    stay = usual | estimates | {"migrated": False, "incumbent": "A", "placement": "A"}
    decisions = pl.DataFrame([stay | {"window": 0}, *rows], infer_schema_length=None)
    return Run({}, {"cycles": pl.DataFrame(), "windows": windows, "decisions": decisions})


THERE = {"window": 1, "incumbent": "A", "placement": "B"}
BACK = {"window": 6, "incumbent": "B", "placement": "A"}


def test_seen_are_the_windows_until_the_next_move_without_the_first() -> None:
    there, back = predicted_moves(made([THERE, BACK], "AABBBBBAAA")).iter_rows(named=True)
    assert (there["window"], there["from"], there["to"], there["windows"]) == (1, "A", "B", 4)
    assert there["predicted_l95_ms"] == 31.0
    assert there["predicted_violation_rate"] == 0.15
    assert (there["predicted_l95_error_ms"], there["predicted_violation_error"]) == (0.5, 0.02)
    assert there["seen_l95_ms"] == pytest.approx(38.0)
    assert there["seen_violation_rate"] == pytest.approx(0.275)
    # Of 30, 34, 38 and 50: the sum of squares around 38 is 224.
    assert there["seen_l95_error_ms"] == pytest.approx((224 / 3 / 4) ** 0.5)
    assert (back["from"], back["to"], back["windows"]) == ("B", "A", 2)
    assert back["seen_l95_ms"] == pytest.approx(22.5)


def test_a_single_window_counts_and_has_no_error() -> None:
    (row,) = predicted_moves(made([THERE], "AAB")).iter_rows(named=True)
    assert (row["windows"], row["seen_l95_ms"], row["seen_l95_error_ms"]) == (1, 90.0, None)


def test_a_move_at_the_last_close_was_not_seen() -> None:
    (row,) = predicted_moves(made([THERE], "AA")).iter_rows(named=True)
    assert (row["windows"], row["seen_l95_ms"], row["predicted_l95_ms"]) == (0, None, 31.0)


def test_runs_that_say_no_error_of_their_estimates_have_none() -> None:
    (row,) = predicted_moves(made([THERE], "AABB", errors=False)).iter_rows(named=True)
    assert row["predicted_l95_error_ms"] is None
    assert row["predicted_violation_error"] is None


def test_the_guards_move_ends_what_is_seen_and_is_no_prediction() -> None:
    guard = {"window": 5, "incumbent": "B", "placement": "A", "reason": "guard"}
    guard |= {"est_l95_ms_A": None, "est_violation_rate_A": None}
    (row,) = predicted_moves(made([THERE, guard], "AABBBAAA")).iter_rows(named=True)
    assert (row["to"], row["windows"], row["seen_l95_ms"]) == ("B", 2, 32.0)


def test_windows_of_two_placements_and_those_left_out_are_not_seen() -> None:
    run = made([THERE, BACK], "AABBBBBAAA", mixed=(3,))
    there, back = predicted_moves(run, excluded=[2, 5]).iter_rows(named=True)
    assert (there["windows"], there["seen_l95_ms"]) == (2, pytest.approx(42.0))
    assert back["windows"] == 2
    assert predicted_moves(run, excluded=[1])["window"].to_list() == [6]
    # The first window is seen where it is the only one that counts.
    alone = predicted_moves(made([THERE], "AABB"), excluded=[3])
    assert alone["seen_l95_ms"].to_list() == [90.0]


def test_moves_of_the_warm_up_are_left_out() -> None:
    run = made([THERE, BACK], "AABBBBBAAA", warmup=2)
    assert predicted_moves(run)["window"].to_list() == [6]


def test_a_run_without_moves_has_an_empty_table() -> None:
    table = predicted_moves(small_run("LOC"))
    assert table.is_empty()
    assert table.columns == list(COLUMNS)


def test_a_wrong_estimate_is_beside_what_is_then_seen() -> None:
    """In this cell nothing is random, and `profile` knows nothing of the slow link to E."""
    problem = cell(candidates=("LOC", "OFF"), window_cycles=50)
    run = simulate(
        problem,
        scenario="disturbed",
        policy="latency-first",
        estimator="profile",
        seed=1,
        windows=12,
    )
    moves = predicted_moves(run)
    assert set(moves["to"]) == {"LOC", "OFF"}
    for name, known in (("LOC", True), ("OFF", False)):
        rows = moves.filter((pl.col("to") == name) & (pl.col("windows") > 0))
        seen_ms = truth(problem, name)[0]
        assert rows["seen_l95_ms"].to_list() == pytest.approx([seen_ms] * rows.height)
        assert all((rows["predicted_l95_ms"] - seen_ms).abs() < 1e-3) == known
