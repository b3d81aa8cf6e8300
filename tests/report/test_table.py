"""Tables: rows once, written for pages, terminals and papers."""

from __future__ import annotations

import math

import pytest

from dwell.display import Measure
from dwell.report.palette import MUTED, Palette
from dwell.report.table import Cell, Columns, Table, Text, interval_row, table_text
from dwell.study import Interval

RATE = Measure("rate", "V_D", "%", 100.0)
ROWS: list[dict[str, object]] = [
    {"scenario": "robot-cpu-stress", "policy": "dtp", "rate": 0.052, "is": "over"},
    {"scenario": "robot-cpu-stress", "policy": "LOC", "rate": None, "is": ""},
    {"scenario": "baseline", "policy": "mine", "rate": 0.01, "is": "under"},
]
COLUMNS: Columns = [Text("policy", "policy", "policy"), RATE, Text("is", "5 %", "word")]


def cells_of(row: dict[str, object], column: Text | Measure) -> Cell:
    ((_, ((cell,),)),) = Table("t", "", [column], [row]).groups()
    return cell


def test_rows_that_follow_each_other_stand_under_one_heading() -> None:
    palette = Palette.of(("LOC",), ("dtp", "LOC", "mine"))
    table = Table("t", "", COLUMNS, ROWS, Text("scenario", "", "scenario"), palette=palette)
    (first, stressed), (second, calm) = table.groups()
    assert (first, second) == ("Robot CPU stress", "Baseline")
    assert [row[0].text for row in stressed] == ["DTP", "LOC"]
    # As in figures.
    markers = [palette.policies[name].marker for name in ("dtp", "LOC")]
    assert [row[0].marker for row in stressed] == markers
    assert stressed[1][0].colour == palette.placements["LOC"]
    assert calm[0][0].text == "mine"
    assert table.headings == ("policy", "V_D (%)", "5 %")


@pytest.mark.parametrize(
    ("row", "text", "error"),
    [
        ({"rate": 0.052, "rate_low": 0.050, "rate_high": 0.054}, "5.2", "± 0.2"),
        ({"rate": 0.052, "rate_low": 0.01, "rate_high": 0.09}, "5.2", "[1.0, 9.0]"),
        ({"rate": 0.052}, "5.2", ""),
        ({"rate": 0}, "0", ""),
        ({"rate": math.inf}, "∞", ""),
        ({"rate": math.nan}, "–", ""),
        ({}, "–", ""),
    ],
)
def test_numbers_stand_beside_their_intervals(
    row: dict[str, object], text: str, error: str
) -> None:
    cell = cells_of(row, RATE)
    assert (cell.text, cell.error) == (text, error)


def test_what_is_not_known_is_sorted_apart_and_numbers_by_their_values() -> None:
    assert cells_of({"rate": math.nan}, RATE).sort == ""
    found = [cells_of({"rate": value}, RATE).sort for value in (0.2, 1000.0, -1.0)]
    assert sorted(found, key=float) == [found[2], found[0], found[1]]


def test_words_have_a_meaning_and_others_are_open() -> None:
    column = Text("is", "", "word")
    kinds = {word: cells_of({"is": word}, column).kind for word in ("under", "over", "not shown")}
    assert kinds == {"under": "word good", "over": "word bad", "not shown": "word open"}


def test_a_name_that_nobody_has_a_colour_for_is_muted_and_none_has_no_mark() -> None:
    column = Text("policy", "", "policy")
    assert cells_of({"policy": "stranger"}, column).colour == MUTED
    assert cells_of({"policy": None}, column) == Cell("–")


def test_a_cell_leads_to_what_its_row_says() -> None:
    cell = cells_of({"window": 57}, Text("window", "", link="#window-{window}"))
    assert (cell.text, cell.link) == ("57", "#window-57")


def test_intervals_become_columns_and_ends_that_are_not_known_are_none() -> None:
    known, unknown = Interval(1.0, 0.5, 1.5), Interval(2.0, math.nan, math.nan)
    assert interval_row({"a": known, "b": unknown}) == {
        "a": 1.0, "a_low": 0.5, "a_high": 1.5, "b": 2.0
    }  # fmt: skip


def test_text_has_title_groups_and_caption_and_folds() -> None:
    group = Text("scenario", "", "scenario")
    table = Table("t", "A title", COLUMNS, ROWS, group, "A caption of several words.")
    text = table_text(table)
    lines = text.splitlines()
    assert lines[0] == "A title"
    assert lines[2] == "Robot CPU stress"
    assert lines[-1] == "A caption of several words."
    # Numbers stand below one another, in all groups.
    ends = {line.index("5.2") + 3 for line in lines if "5.2" in line}
    ends |= {line.index("1.0") + 3 for line in lines if "1.0" in line}
    assert len(ends) == 1
    assert max(map(len, table_text(table, width=30).splitlines())) <= 30


def test_a_table_without_rows_is_a_heading_and_nothing() -> None:
    assert list(Table("t", "", COLUMNS, []).groups()) == []
    assert table_text(Table("t", "Nothing", COLUMNS, [])).split() == ["Nothing"]


def test_a_wide_table_has_parts_that_begin_with_its_first_column() -> None:
    columns: Columns = [Text("policy", "policy"), *(Measure(f"m{i}", f"m{i}") for i in range(7))]
    rows = [{"policy": "LOC", **{f"m{i}": float(i) for i in range(7)}}]
    parts = Table("wide", "Title", columns, rows, caption="Caption.").parts(3)
    assert [[column.name for column in part.columns] for part in parts] == [
        ["policy", "m0", "m1", "m2"],
        ["policy", "m3", "m4", "m5"],
        ["policy", "m6"],
    ]
    assert [part.slug for part in parts] == ["wide", "wide-2", "wide-3"]
    assert [part.title for part in parts] == ["Title", "", ""]
