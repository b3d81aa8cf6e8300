"""Traces: what is read of them, what is shared, and what is refused in which words."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml

from dwell.cellfile import from_document, load, load_without_traces
from dwell.errors import ProblemError, TraceError
from dwell.model import Problem, Trace, TraceTable
from dwell.model.document import fingerprint, to_document

REAL = Path(__file__).parents[2].parent / "shared" / "data"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason="the real measurements are not beside the repository"
)

LINK, EXEC = "links[0].delay_ms.trace", "tasks.b.on.E.exec_ms.trace"


def _cell(link: dict[str, Any], execution: dict[str, Any]) -> dict[str, Any]:
    """Return a cell with a trace for the delay of its link and one for an execution time."""
    return {
        "dwell": 1,
        "period_ms": 66,
        "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
        "links": [{"from": "R", "to": "E", "delay_ms": {"trace": link}}],
        "tasks": {
            "a": {"on": {"R": {"exec_ms": 1}}},
            "b": {"on": {"E": {"exec_ms": {"trace": execution}}}},
        },
        "flows": [{"from": "a", "to": "b"}],
        "candidates": {"LOC": {}},
    }


def _read(
    folder: Path, file: str, columns: tuple[str, str] = ("up", "work"), **how: object
) -> tuple[TraceTable, TraceTable]:
    """Return the tables of the link and of the execution."""
    link, execution = ({"file": file, "column": column, **how} for column in columns)
    problem = from_document(_cell(link, execution), folder=folder)
    return _table(problem.fabric.links["R->E"].delay_ms), _table(
        problem.pipeline.tasks["b"].on["E"].exec_ms
    )


def _table(process: object) -> TraceTable:
    assert isinstance(process, Trace)
    return process.table


def _faults(
    folder: Path, file: str, columns: tuple[str, str] = ("up", "work"), **how: object
) -> dict[str, str]:
    with pytest.raises(TraceError) as caught:
        _read(folder, file, columns, **how)
    return {fault.path: fault.message for fault in caught.value.faults}


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Return a folder with one recording, as Parquet and as CSV: two runs, one bad row in each."""
    frame = pl.DataFrame(
        {
            "run": [1, 1, 1, 1, 2, 2, 2],
            "client": [0, 0, 1, 1, 0, 0, 1],
            "sent_ms": [0.0, 10.0, 20.0, 30.0, 5.0, 15.0, 25.0],
            "up": [1.0, -2.0, 3.0, 4.0, 5.0, 6.0, 7.0],
            "work": [10, 20, 30, 40, 50, None, 70],
            "note": list("abcdefg"),
            "ok": [True] * 7,
        }
    )
    frame.write_parquet(tmp_path / "t.parquet")
    frame.write_csv(tmp_path / "t.csv")
    return tmp_path


@pytest.mark.parametrize("file", ["t.parquet", "t.csv"])
def test_processes_of_one_source_share_their_rows(recorded: Path, file: str) -> None:
    link, execution = _read(recorded, file, group="run", on_negative="drop")
    assert link is execution
    assert link.columns["up"].tolist() == [1, 3, 4, 5, 7]
    assert link.columns["work"].tolist() == [10, 30, 40, 50, 70]
    assert link.starts.tolist() == [0, 3]
    assert link.dropped == 2
    assert link.time_ms is None
    assert not link.columns["up"].flags.writeable


def test_only_columns_in_use_drop_rows(recorded: Path) -> None:
    link, execution = _read(recorded, "t.parquet", ("up", "up"), on_negative="drop")
    assert link.columns["up"].tolist() == [1, 3, 4, 5, 6, 7]
    assert link is execution


def test_sources_read_in_another_way_share_nothing(recorded: Path) -> None:
    how = {"file": "t.csv", "group": "run"}
    link = {**how, "column": "up", "on_negative": "clip"}
    problem = from_document(_cell(link, {**how, "column": "run"}), folder=recorded)
    first = _table(problem.fabric.links["R->E"].delay_ms)
    second = _table(problem.pipeline.tasks["b"].on["E"].exec_ms)
    assert first is not second
    assert first.columns["up"].tolist() == [1, 0, 3, 4, 5, 6, 7]
    assert first.dropped == 1
    assert second.columns["run"].tolist() == [1, 1, 1, 1, 2, 2, 2]


def test_instants_begin_anew_in_every_group(recorded: Path) -> None:
    table, _ = _read(recorded, "t.parquet", by="time", group="run", on_negative="drop", wrap=True)
    assert table.time == "sent_ms"
    assert table.wrap
    assert table.time_ms is not None
    assert table.time_ms.tolist() == [0, 20, 30, 0, 20]


def test_several_columns_make_a_group(recorded: Path) -> None:
    table, _ = _read(recorded, "t.csv", ("up", "up"), group=["run", "client"], on_negative="clip")
    assert table.starts.tolist() == [0, 2, 4, 6]
    assert table.group == ("run", "client")


def test_a_time_column_may_have_another_name(recorded: Path) -> None:
    table, _ = _read(
        recorded, "t.parquet", ("run", "run"), by="time", time="work", on_negative="drop"
    )
    assert table.time_ms is not None
    assert table.time_ms.tolist() == [0, 10, 20, 30, 40, 60]


def test_negative_and_missing_values_are_counted_and_shown(recorded: Path) -> None:
    faults = _faults(recorded, "t.parquet")
    assert set(faults) == {f"{LINK}.column", f"{EXEC}.column"}
    assert faults[f"{LINK}.column"].startswith("1 negative of 7 rows (first: row 2, -2);")
    assert faults[f"{EXEC}.column"].startswith("1 missing or NaN of 7 rows (first: row 6);")
    for message in faults.values():
        assert "on_negative: drop" in message
        assert "`clip`" in message


def test_what_is_missing_cannot_be_clipped(recorded: Path) -> None:
    faults = _faults(recorded, "t.parquet", on_negative="clip")
    assert set(faults) == {f"{EXEC}.column"}
    assert "0 cannot stand for that" in faults[f"{EXEC}.column"]


def test_infinite_and_huge_values_are_refused(tmp_path: Path) -> None:
    pl.DataFrame({"up": [1.0, np.inf], "work": [2e9, 1.0]}).write_parquet(tmp_path / "t.parquet")
    faults = _faults(tmp_path, "t.parquet", on_negative="clip")
    assert faults[f"{LINK}.column"].startswith("1 above 1e9 of 2 rows (first: row 2, inf)")
    assert faults[f"{EXEC}.column"].startswith("1 above 1e9 of 2 rows (first: row 1, 2e+09)")
    assert (
        "none of its 2 rows" in _faults(tmp_path, "t.parquet", on_negative="drop")[f"{LINK}.file"]
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
            ("group 0 begins again at row 5", "stand together"),
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
    faults = _faults(recorded, "t.parquet", columns, **how)
    assert set(faults) == {path}
    for word in words:
        assert word in faults[path]


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("u.parquet", None, ("does not exist", "did you mean 't.parquet'?")),
        ("other-run.csv", None, ("does not exist", "relative to the cell file")),
        ("no/t.csv", None, ("does not exist", "there is no folder")),
        ("t.xlsx", b"", (".parquet or .csv",)),
        ("e.csv", b"", ("is empty",)),
        ("h.csv", b"up,work\n", ("no rows",)),
        ("e.parquet", b"", ("cannot be read",)),
        ("bad.parquet", b"PAR1 what is this PAR1", ("cannot be read",)),
        ("bad.csv", b"up,work\n1,2,3,4\n", ("cannot be read",)),
    ],
)
def test_a_file_at_fault(
    file: str, content: bytes | None, words: tuple[str, ...], recorded: Path
) -> None:
    if content is not None:
        (recorded / file).write_bytes(content)
    faults = _faults(recorded, file)
    assert set(faults) == {f"{LINK}.file"}
    for word in words:
        assert word in faults[f"{LINK}.file"]


def test_a_folder_is_no_trace(recorded: Path) -> None:
    (recorded / "d.csv").mkdir()
    assert "is a folder" in _faults(recorded, "d.csv")[f"{LINK}.file"]


def test_faults_of_traces_stand_beside_all_others(recorded: Path) -> None:
    document = _cell({"file": "t.csv", "column": "up"}, {"file": "t.csv", "column": "wrk", "b": 1})
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
        from_document(_cell({**good, "group": "run", **how}, good), folder=recorded)
    (fault,) = caught.value.faults
    assert fault.path == f"{LINK}.{path}"
    for word in words:
        assert word in fault.message


@pytest.mark.parametrize(("file", "words"), [("t.csv", "up"), ("t.parquet", "needs Polars")])
def test_traces_without_polars(recorded: Path, file: str, words: str) -> None:
    """In a process of its own: this one has imported it."""
    cell = {"file": file, "column": "up", "on_negative": "clip"}
    document = _cell(cell, {**cell, "column": "run"})
    (recorded / "cell.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    script = (
        "import sys; sys.modules['polars'] = None\n"
        "from dwell import load\n"
        "from dwell.errors import TraceError\n"
        "try:\n"
        "    trace = load('cell.yaml').fabric.links['R->E'].delay_ms\n"
        "    print(trace.column, trace.table.columns['up'].tolist())\n"
        "except TraceError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=recorded, check=True, capture_output=True, text=True
    )
    assert words in done.stdout
    if file == "t.csv":
        assert done.stdout == "up [1.0, 0.0, 3.0, 4.0, 5.0, 6.0, 7.0]\n"
    else:
        assert "pip install 'dwell-placement[sim]', or record the trace as CSV" in done.stdout


def test_a_node_of_a_live_cell_reads_no_traces(recorded: Path) -> None:
    cell = {"file": "t.csv", "column": "up", "on_negative": "clip"}
    document = _cell(cell, {**cell, "column": "run"})
    file = recorded / "cell.yaml"
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    there = load(file)
    (recorded / "t.csv").unlink()
    node = load_without_traces(file)
    # They agree on the cell: its data are the controller's alone.
    assert fingerprint(node) == fingerprint(there)
    cell["column"] = "run"
    file.write_text(yaml.safe_dump(_cell(cell, cell)), encoding="utf-8")
    assert fingerprint(load_without_traces(file)) != fingerprint(there)
    file.write_text("dwell: 1\nperiod_ms: 0", encoding="utf-8")
    with pytest.raises(ProblemError, match="period_ms"):
        load_without_traces(file)


# ------------------------------------------------------------------------ recorded problems


def _document(recorded: Path) -> tuple[Problem, dict[str, Any]]:
    how = {"file": "t.parquet", "by": "time", "group": ["run"], "on_negative": "drop"}
    cell = _cell({**how, "column": "up"}, {**how, "column": "work"})
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
    faults = _faults(REAL, file, columns, group="run")
    assert set(faults) == {f"{LINK}.column"}
    start = f"{bad} negative of {rows} rows (first: row {first + 1}, {values[first]:g})"
    assert faults[f"{LINK}.column"].startswith(start)
    dropped, _ = _read(REAL, file, columns, group="run", on_negative="drop")
    assert (dropped.rows, dropped.dropped, len(dropped.starts)) == (rows - bad, bad, 99)
    clipped, _ = _read(REAL, file, columns, group="run", on_negative="clip", by="time")
    assert (clipped.rows, clipped.dropped) == (rows, bad)
    assert clipped.columns["uplink_ms"].min() == 0
    assert clipped.time_ms is not None
    assert (clipped.time_ms[clipped.starts] == 0).all()


@needs_real
def test_real_clients_are_told_apart_by_run_and_client() -> None:
    file, columns = "edgedroid_10clients_rtt.parquet", ("rtt_ms", "rtt_ms")
    faults = _faults(REAL, file, columns, group="run", by="time")
    assert "goes back" in faults[f"{LINK}.time"]
    table, _ = _read(REAL, file, columns, group=["run", "client"], by="time")
    assert len(table.starts) == 120


@needs_real
def test_a_real_trace_is_shorter_than_a_long_run() -> None:
    file, columns = "edaf_5g_uplink.parquet", ("delay_ms", "delay_ms")
    table, _ = _read(REAL, file, columns, by="time", time="sent_ms")
    rng = np.random.default_rng(1)
    rows = table.replay(rng, np.linspace(0, 20_000, 501))
    assert (np.diff(rows) >= 0).all()
    with pytest.raises(TraceError, match="the trace has 28"):
        table.replay(rng, np.linspace(0, 40_000, 1001))
