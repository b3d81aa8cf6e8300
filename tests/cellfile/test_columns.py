"""Columns of a file: CSV without Polars, and files that cannot be read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.cells.with_traces import LINK, faults_of, trace_cell


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
    faults = faults_of(recorded, file)
    assert set(faults) == {f"{LINK}.file"}
    for word in words:
        assert word in faults[f"{LINK}.file"]


def test_a_folder_is_no_trace(recorded: Path) -> None:
    (recorded / "d.csv").mkdir()
    assert "is a folder" in faults_of(recorded, "d.csv")[f"{LINK}.file"]


@pytest.mark.parametrize(("file", "words"), [("t.csv", "up"), ("t.parquet", "needs Polars")])
def test_traces_without_polars(recorded: Path, file: str, words: str) -> None:
    """In a process of its own: this one has imported it."""
    cell = {"file": file, "column": "up", "on_negative": "clip"}
    document = trace_cell(cell, {**cell, "column": "run"})
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
