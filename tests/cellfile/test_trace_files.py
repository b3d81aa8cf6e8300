"""Trace files: rows that are left out, groups, instants, and columns at fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from dwell.errors import TraceError
from tests.cells.with_traces import EXEC, LINK, faults_of, read_tables


def test_only_columns_in_use_drop_rows(recorded: Path) -> None:
    link, execution = read_tables(recorded, "t.parquet", ("up", "up"), on_negative="drop")
    assert link.columns["up"].tolist() == [1, 3, 4, 5, 6, 7]
    assert link is execution


def test_instants_begin_anew_in_every_group(recorded: Path) -> None:
    table, _ = read_tables(
        recorded, "t.parquet", by="time", group="run", on_negative="drop", wrap=True
    )
    assert table.time == "sent_ms"
    assert table.wrap
    assert table.time_ms is not None
    assert table.time_ms.tolist() == [0, 20, 30, 0, 20]


def test_several_columns_make_a_group(recorded: Path) -> None:
    table, _ = read_tables(
        recorded, "t.csv", ("up", "up"), group=["run", "client"], on_negative="clip"
    )
    assert table.starts.tolist() == [0, 2, 4, 6]
    assert table.group == ("run", "client")


def test_a_time_column_may_have_another_name(recorded: Path) -> None:
    table, _ = read_tables(
        recorded, "t.parquet", ("run", "run"), by="time", time="work", on_negative="drop"
    )
    assert table.time_ms is not None
    assert table.time_ms.tolist() == [0, 10, 20, 30, 40, 60]


def test_negative_and_missing_values_are_counted_and_shown(recorded: Path) -> None:
    faults = faults_of(recorded, "t.parquet")
    assert set(faults) == {f"{LINK}.column", f"{EXEC}.column"}
    assert faults[f"{LINK}.column"].startswith("1 negative of 7 rows (first: row 2, -2);")
    assert faults[f"{EXEC}.column"].startswith("1 missing or NaN of 7 rows (first: row 6);")


@pytest.mark.parametrize("mode", ["error", "clip"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -1.0, 2e9])
@pytest.mark.parametrize("beside", [5.0, np.nan])
def test_a_remedy_that_is_offered_works(
    mode: str, wrong: float, beside: float, tmp_path: Path
) -> None:
    """Whatever is wrong in one column, and in another one of the file."""
    frame = pl.DataFrame({"up": [wrong, 1.0, 2.0], "work": [3.0, 4.0, beside]})
    frame.write_parquet(tmp_path / "t.parquet")
    remedies = {"drop": "`on_negative: drop`", "clip": "`on_negative: clip`"}
    works = {}
    for remedy in remedies:
        try:
            read_tables(tmp_path, "t.parquet", on_negative=remedy)
            works[remedy] = True
        except TraceError:
            works[remedy] = False
    if works.get(mode):
        return
    for message in faults_of(tmp_path, "t.parquet", on_negative=mode).values():
        assert {name: text in message for name, text in remedies.items()} == works


def test_where_no_row_could_stay_none_is_offered_to_be_dropped(tmp_path: Path) -> None:
    pl.DataFrame({"up": [np.inf, 1.0], "work": [1.0, np.nan]}).write_parquet(tmp_path / "t.parquet")
    for message in faults_of(tmp_path, "t.parquet").values():
        assert "on_negative" not in message
        assert "record it again" in message


def test_infinite_and_huge_values_are_refused(tmp_path: Path) -> None:
    pl.DataFrame({"up": [1.0, np.inf], "work": [2e9, 1.0]}).write_parquet(tmp_path / "t.parquet")
    faults = faults_of(tmp_path, "t.parquet", on_negative="clip")
    assert faults[f"{LINK}.column"].startswith("1 above 1e9 of 2 rows (first: row 2, inf)")
    assert faults[f"{EXEC}.column"].startswith("1 above 1e9 of 2 rows (first: row 1, 2e+09)")
    assert (
        "none of its 2 rows" in faults_of(tmp_path, "t.parquet", on_negative="drop")[f"{LINK}.file"]
    )


@pytest.mark.parametrize(
    ("columns", "how", "path", "words"),
    [
        (("upp", "work"), {}, f"{LINK}.column", ("'upp'", "'up'?", "run, client, sent_ms")),
        (("up", "zzz"), {}, f"{EXEC}.column", ("'zzz'", "known: run, client")),
        (("up", "note"), {}, f"{EXEC}.column", ("'note'", "String", "numbers")),
        (("up", "ok"), {}, f"{EXEC}.column", ("'ok'", "Boolean", "numbers")),
        (("run", "run"), {"group": "runs"}, f"{LINK}.group", ("'runs'", "'run'?")),
        (("run", "run"), {"group": ["run", "x"]}, f"{LINK}.group", ("'x'", "known")),
        (("run", "run"), {"by": "time", "time": "at"}, f"{LINK}.time", ("'at'", "known")),
        (("run", "run"), {"by": "time", "time": "note"}, f"{LINK}.time", ("'note'", "String")),
        (("run", "run"), {"by": "time", "time": "work"}, f"{LINK}.time", ("missing", "row 6")),
        (
            ("run", "run"),
            {"by": "time"},
            f"{LINK}.time",
            ("'sent_ms'", "from 30 to 5 at row 5", "`group`"),
        ),
        (
            ("run", "run"),
            {"group": "client"},
            f"{LINK}.group",
            ("group 0 begins again at row 5", "sort the file by group"),
        ),
    ],
)
def test_a_column_at_fault(
    columns: tuple[str, str],
    how: dict[str, object],
    path: str,
    words: tuple[str, ...],
    recorded: Path,
) -> None:
    faults = faults_of(recorded, "t.parquet", columns, **how)
    assert set(faults) == {path}
    for word in words:
        assert word in faults[path]
