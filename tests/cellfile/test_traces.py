"""Traces: what is read of them, what is shared, and what is refused in which words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml

from dwell.cellfile import from_document, load, load_without_traces
from dwell.errors import ProblemError, TraceError
from dwell.model import Problem
from dwell.model.document import digests, to_document
from tests.cells.with_traces import EXEC, LINK, faults_of, read_tables, table_of, trace_cell

REAL = Path(__file__).parents[2].parent / "shared" / "data"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason="the real measurements are not beside the repository"
)


@pytest.mark.parametrize("file", ["t.parquet", "t.csv"])
def test_processes_of_one_source_share_their_rows(recorded: Path, file: str) -> None:
    link, execution = read_tables(recorded, file, group="run", on_negative="drop")
    assert link is execution
    assert link.columns["up"].tolist() == [1, 3, 4, 5, 7]
    assert link.columns["work"].tolist() == [10, 30, 40, 50, 70]
    assert link.starts.tolist() == [0, 3]
    assert link.dropped == 2
    assert link.time_ms is None
    assert not link.columns["up"].flags.writeable


def test_sources_read_in_another_way_share_nothing(recorded: Path) -> None:
    how = {"file": "t.csv", "group": "run"}
    link = {**how, "column": "up", "on_negative": "clip"}
    problem = from_document(trace_cell(link, {**how, "column": "run"}), folder=recorded)
    first = table_of(problem.fabric.links["R->E"].delay_ms)
    second = table_of(problem.pipeline.tasks["b"].on["E"].exec_ms)
    assert first is not second
    assert first.columns["up"].tolist() == [1, 0, 3, 4, 5, 6, 7]
    assert first.dropped == 1
    assert second.columns["run"].tolist() == [1, 1, 1, 1, 2, 2, 2]


def test_faults_of_traces_stand_beside_all_others(recorded: Path) -> None:
    document = trace_cell(
        {"file": "t.csv", "column": "up"}, {"file": "t.csv", "column": "wrk", "b": 1}
    )
    document["period_ms"] = 0
    document["flows"][0]["to"] = "c"
    with pytest.raises(ProblemError) as caught:
        from_document(document, folder=recorded)
    assert not isinstance(caught.value, TraceError)
    paths = {fault.path for fault in caught.value.faults}
    assert paths == {"period_ms", "flows[0].to", f"{EXEC}.b", f"{EXEC}.column"}


@pytest.mark.parametrize(
    ("how", "path", "words"),
    [
        ({"time": "sent_ms"}, "time", ("by: time",)),
        ({"by": "frame"}, "by", ("'frame'", "row, time")),
        ({"on_negative": "dropp"}, "on_negative", ("'dropp'", "'drop'?")),
        ({"wrap": "yes"}, "wrap", ("'yes'", "true or false")),
        ({"group": []}, "group", ("a list", "column")),
        ({"group": 3}, "group", ("3", "column")),
        ({"file": ""}, "file", ("''", "not empty")),
        ({"sha256": "ab"}, "sha256", ("'ab'", "64 hexadecimal")),
    ],
)
def test_a_declaration_at_fault(
    how: dict[str, object], path: str, words: tuple[str, ...], recorded: Path
) -> None:
    good = {"file": "t.csv", "column": "run"}
    with pytest.raises(ProblemError) as caught:
        from_document(trace_cell({**good, "group": "run", **how}, good), folder=recorded)
    (fault,) = caught.value.faults
    assert fault.path == f"{LINK}.{path}"
    for word in words:
        assert word in fault.message


def test_a_node_of_a_live_cell_reads_no_traces(recorded: Path) -> None:
    cell = {"file": "t.csv", "column": "up", "on_negative": "clip"}
    document = trace_cell(cell, {**cell, "column": "run"})
    file = recorded / "cell.yaml"
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    there = load(file)
    (recorded / "t.csv").unlink()
    node = load_without_traces(file)
    # They agree on the cell: its data are the controller's alone.
    assert digests(node)["wiring"] == digests(there)["wiring"]
    cell["column"] = "run"
    file.write_text(yaml.safe_dump(trace_cell(cell, cell)), encoding="utf-8")
    assert digests(load_without_traces(file))["wiring"] != digests(there)["wiring"]
    file.write_text("dwell: 1\nperiod_ms: 0", encoding="utf-8")
    with pytest.raises(ProblemError, match="period_ms"):
        load_without_traces(file)


# ------------------------------------------------------------------------ recorded problems


def _document(recorded: Path) -> tuple[Problem, dict[str, Any]]:
    how = {"file": "t.parquet", "by": "time", "group": ["run"], "on_negative": "drop"}
    cell = trace_cell({**how, "column": "up"}, {**how, "column": "work"})
    problem = from_document(cell, folder=recorded)
    return problem, to_document(problem)


def test_a_recorded_problem_names_its_traces_and_finds_them_again(recorded: Path) -> None:
    _, document = _document(recorded)
    trace = document["links"][0]["delay_ms"]["trace"]
    assert {key: trace[key] for key in ("file", "column", "by", "time", "group")} == {
        "file": "t.parquet",
        "column": "up",
        "by": "time",
        "time": "sent_ms",
        "group": ["run"],
    }
    assert to_document(from_document(document, folder=recorded)) == document


def test_other_data_are_not_taken_for_the_recorded(recorded: Path) -> None:
    problem, document = _document(recorded)
    frame = pl.read_parquet(recorded / "t.parquet")
    frame.with_columns(pl.col("up") + (pl.col("note") == "d")).write_parquet(recorded / "t.parquet")
    with pytest.raises(TraceError) as caught:
        from_document(document, folder=recorded)
    (fault,) = caught.value.faults
    assert fault.path == f"{LINK}.sha256"
    assert "t.parquet" in fault.message
    for part in (document["links"][0]["delay_ms"], document["tasks"]["b"]["on"]["E"]["exec_ms"]):
        del part["trace"]["sha256"]
    assert from_document(document, folder=recorded).name == problem.name


# -------------------------------------------------------------------------- real recordings


@needs_real
def test_real_delays_are_negative_where_clocks_disagreed() -> None:
    columns = ("uplink_ms", "processing_ms")
    file = "edgedroid_1client_stages.parquet"
    values = pl.read_parquet(REAL / file, columns=["uplink_ms"])["uplink_ms"]
    bad, rows = int((values < 0).sum()), len(values)
    assert bad > 100
    first = int((values < 0).arg_max() or 0)
    faults = faults_of(REAL, file, columns, group="run")
    assert set(faults) == {f"{LINK}.column"}
    start = f"{bad} negative of {rows} rows (first: row {first + 1}, {values[first]:g})"
    assert faults[f"{LINK}.column"].startswith(start)
    dropped, _ = read_tables(REAL, file, columns, group="run", on_negative="drop")
    assert (dropped.rows, dropped.dropped, len(dropped.starts)) == (rows - bad, bad, 99)
    clipped, _ = read_tables(REAL, file, columns, group="run", on_negative="clip", by="time")
    assert (clipped.rows, clipped.dropped) == (rows, bad)
    assert clipped.columns["uplink_ms"].min() == 0
    assert clipped.time_ms is not None
    assert (clipped.time_ms[clipped.starts] == 0).all()


@needs_real
def test_real_clients_are_told_apart_by_run_and_client() -> None:
    file, columns = "edgedroid_10clients_rtt.parquet", ("rtt_ms", "rtt_ms")
    faults = faults_of(REAL, file, columns, group="run", by="time")
    assert "goes back" in faults[f"{LINK}.time"]
    table, _ = read_tables(REAL, file, columns, group=["run", "client"], by="time")
    assert len(table.starts) == 120


@needs_real
def test_a_real_trace_is_shorter_than_a_long_run() -> None:
    file, columns = "edaf_5g_uplink.parquet", ("delay_ms", "delay_ms")
    table, _ = read_tables(REAL, file, columns, by="time", time="sent_ms")
    rng = np.random.default_rng(1)
    rows = table.replay(rng, np.linspace(0, 20_000, 501))
    assert (np.diff(rows) >= 0).all()
    with pytest.raises(TraceError, match="the trace has 28"):
        table.replay(rng, np.linspace(0, 40_000, 1001))
