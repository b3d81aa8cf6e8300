"""Predicted moves in a page: the figure and the table."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from dwell.report.figure import Figure, printed_svg, svg
from dwell.report.move_blocks import move_blocks
from dwell.report.palette import Palette
from dwell.report.table import MOST_ROWS, Table, Text, table_text
from dwell.study.predicted_moves import COLUMNS

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
    figure, table = move_blocks(frame(*moves), PALETTE, 33.0)
    assert isinstance(figure, Figure)
    assert isinstance(table, Table)
    return figure, table


def domains(figure: Figure) -> list[tuple[float, float]]:
    """Return the ends of each panel's axes, which are the same up and across."""
    ends = []
    for panel in figure.spec()["hconcat"]:
        encoding = panel["layer"][-1]["encoding"]
        assert encoding["x"]["scale"] == encoding["y"]["scale"]
        ends.append(tuple(encoding["x"]["scale"]["domain"]))
    return ends


def rules(panel: dict[str, Any]) -> list[float]:
    """Return where a panel has lines of a limit."""
    encodings = [part["encoding"] for part in panel["layer"] if "encoding" in part]
    found = [one[axis].get("datum") for one in encodings for axis in ("x", "y")]
    return [at for at in found if at is not None]


def test_without_moves_nothing_is_shown() -> None:
    assert move_blocks(frame(), PALETTE, 33.0) == []


def test_the_diagonal_and_both_axes_reach_from_end_to_end() -> None:
    figure, _ = blocks({}, {"to": "HYB"})
    (low_ms, high_ms), (low, high) = domains(figure)
    assert low_ms < 28.5
    assert high_ms > 38.0
    assert 0.0 <= low < 2.0
    assert high > 9.0
    for panel, ends in zip(figure.spec()["hconcat"], domains(figure), strict=True):
        diagonal = panel["layer"][0]
        assert [row["at"] for row in diagonal["data"]["values"]] == list(ends)


def test_the_deadline_is_shown_where_the_axes_reach_it() -> None:
    near, _ = blocks({})
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
    assert all(low < high for low, high in domains(figure))
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
    _, table = move_blocks(moves, PALETTE, 33.0, (Text("run", "run"),), scenario)
    assert isinstance(table, Table)
    assert [heading for heading, _ in table.groups()] == ["Calm", "Storm"]
    assert table.headings[0] == "run"
    assert "±" in table_text(table)
