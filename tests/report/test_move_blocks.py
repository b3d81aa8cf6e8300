"""Predicted moves in a page: the figure and the table."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from dwell.report.charts import Limit
from dwell.report.figure import Figure, printed_svg, svg
from dwell.report.move_blocks import move_blocks
from dwell.report.palette import Palette
from dwell.report.table import MOST_ROWS, Table, Text, table_text
from dwell.study.predicted_moves import COLUMNS

LIMIT = Limit(33.0, "deadline")
PALETTE = Palette.of(("LOC", "SO", "HYB"))
MOVE = {
    "window": 9,
    "from": "LOC",
    "to": "SO",
    "windows": 4,
    "predicted_l95_ms": 30.0,
    "predicted_l95_error_ms": 1.5,
    "predicted_violation_rate": 0.02,
    "predicted_violation_error": None,
    "seen_l95_ms": 36.0,
    "seen_l95_error_ms": 2.0,
    "seen_violation_rate": 0.08,
    "seen_violation_error": 0.01,
}
UNSEEN = {name: None for name in MOVE if name.startswith("seen")} | {"windows": 0}


def frame(*moves: dict[str, Any]) -> pl.DataFrame:
    schema = {name: getattr(pl, kind) for name, kind in COLUMNS.items()}
    return pl.DataFrame([MOVE | move for move in moves], schema=schema)


def blocks(*moves: dict[str, Any]) -> tuple[Figure, Table]:
    figure, table = move_blocks(frame(*moves), PALETTE, LIMIT)
    assert isinstance(figure, Figure)
    assert isinstance(table, Table)
    return figure, table


def domains(figure: Figure, axis: str) -> list[tuple[float, float]]:
    """Return the ends of an axis of each panel."""
    panels = [panel["layer"][-1]["encoding"] for panel in figure.spec()["hconcat"]]
    return [tuple(encoding[axis]["scale"]["domain"]) for encoding in panels]


def rules(panel: dict[str, Any]) -> list[float]:
    """Return where a panel has lines of a limit."""
    encodings = [part["encoding"] for part in panel["layer"] if "encoding" in part]
    found = [one[axis].get("datum") for one in encodings for axis in ("x", "y")]
    return [at for at in found if at is not None]


def test_without_moves_nothing_is_shown() -> None:
    assert move_blocks(frame(), PALETTE, LIMIT) == []


def test_each_axis_has_the_range_of_its_values() -> None:
    figure, _ = blocks({}, {"to": "HYB"})
    for when, axis in (("seen", "x"), ("predicted", "y")):
        (low_ms, high_ms), (low, high) = domains(figure, axis)
        value, error = MOVE[f"{when}_l95_ms"], MOVE[f"{when}_l95_error_ms"]
        assert isinstance(value, float)
        assert isinstance(error, float)
        assert low_ms <= value - error < value + error < high_ms
        assert high_ms - low_ms < 2.3 * error
        share = MOVE[f"{when}_violation_rate"]
        assert isinstance(share, float)
        assert low <= 100 * share < high


def test_the_line_of_equality_has_the_part_that_both_ranges_have() -> None:
    figure, _ = blocks({}, {"predicted_l95_ms": 36.0, "seen_l95_ms": 30.0})
    panel = figure.spec()["hconcat"][0]
    ends = [row["at"] for row in panel["layer"][0]["data"]["values"]]
    ranges = [domains(figure, axis)[0] for axis in ("x", "y")]
    assert ends == [max(low for low, _ in ranges), min(high for _, high in ranges)]


def test_the_deadline_is_shown_where_an_axis_reaches_it() -> None:
    near, _ = blocks({"predicted_l95_ms": 33.0, "seen_l95_ms": 33.0})
    latency, rate = near.spec()["hconcat"]
    assert rules(latency) == [33.0, 33.0]
    assert rules(rate) == []
    far, _ = blocks({"predicted_l95_ms": 10.0, "seen_l95_ms": 12.0})
    assert rules(far.spec()["hconcat"][0]) == []


def test_candidates_have_their_colours_and_only_those_moved_to() -> None:
    figure, _ = blocks({}, {"to": "HYB"})
    colour = figure.spec()["hconcat"][0]["layer"][-1]["encoding"]["color"]
    assert colour["scale"]["domain"] == ["SO", "HYB"]
    assert colour["scale"]["range"] == [PALETTE.placements["SO"], PALETTE.placements["HYB"]]


@pytest.mark.parametrize(
    "move",
    [
        {},
        UNSEEN,
        {"predicted_l95_ms": float("inf")},
        {"predicted_violation_rate": 0.0, "seen_violation_rate": 0.0, "seen_violation_error": 0.0},
        {"predicted_l95_ms": None, "predicted_violation_rate": None},
    ],
)
def test_it_is_drawn_whatever_is_known(move: dict[str, Any]) -> None:
    figure, _ = blocks(move)
    assert all(low < high for low, high in domains(figure, "x"))
    assert svg(figure).count("<svg") == 1
    assert 'width="25' in printed_svg(figure)


def test_the_table_has_errors_where_they_are_known() -> None:
    _, table = blocks({}, UNSEEN)
    ((_, (seen, unseen)),) = table.groups()
    texts = [f"{cell.text} {cell.error}".strip() for cell in seen]
    assert texts == ["9", "LOC", "SO", "30.0 ± 1.5", "36.0 ± 2.0", "2.00", "8.00 ± 1.00", "4"]
    assert [unseen[place].text for place in (4, 6, 7)] == ["–", "–", "0"]


def test_long_tables_are_cut_and_say_so() -> None:
    _, table = blocks(*[{"window": number} for number in range(MOST_ROWS + 1)])
    assert len(table.rows) == MOST_ROWS
    assert str(MOST_ROWS) in table.title
    assert str(MOST_ROWS + 1) in table.title


def test_moves_of_several_runs_say_which() -> None:
    moves = frame({}, {}).with_columns(scenario=pl.Series(["calm", "storm"]), run=pl.lit("one"))
    scenario = Text("scenario", "", "scenario")
    _, table = move_blocks(moves, PALETTE, LIMIT, (Text("run", "run"),), scenario)
    assert isinstance(table, Table)
    assert [heading for heading, _ in table.groups()] == ["Calm", "Storm"]
    assert table.headings[0] == "run"
    assert "±" in table_text(table)
