"""Columns of a file: CSV without Polars, and files that cannot be read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.cells.with_traces import LINK, faults_of, read_tables, trace_cell


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("u.parquet", None, ("does not exist", "did you mean 't.parquet'?")),
        ("other-run.csv", None, ("does not exist", "relative to the cell file")),
        ("no/t.csv", None, ("does not exist", "is not a folder")),
        ("t.xlsx", b"", (".parquet or .csv",)),
        ("e.csv", b"", ("is empty",)),
        ("h.csv", b"up,work\n", ("no rows",)),
        ("e.parquet", b"", ("cannot be read",)),
        ("bad.parquet", b"PAR1 what is this PAR1", ("cannot be read",)),
        ("bad.csv", b"up,work\n1,2,3,4\n", ("row 1 has 4 fields (1, 2, 3, 4)", "head 2", "point")),
        ("short.csv", b"up,work\n1,2\n3\n", ("row 2 has 1 field (3)", "complete the row")),
        ("blank.csv", b"\n\n", ("is empty",)),
        ("above.csv", b"\nup,work\n1,2\n", ("line 1 is empty", "remove it")),
        ("de.csv", b"up;work\n1,5;2\n", ("separated by semicolons", "commas", "point, as 1.5")),
        ("tab.csv", b"up\twork\n1.5\t2\n", ("separated by tabs", "commas")),
        ("comma.csv", b"up,work\n0,1,5\n", ("row 1 has 3 fields (0, 1, 5)", "point, as 1.5")),
        ("latin.csv", b"up,w\xe9rk\n1,2\n", ("0xe9 is not UTF-8", "save it")),
        ("wide.csv", "up,work\n1,2\n".encode("utf-16"), ("0xff is not UTF-8", "save it")),
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


@pytest.mark.parametrize(
    "text",
    [
        "up,work\n1,2\n3,4\n",
        "up,work\n1,2\n3,4\n\n\n",
        "up,work\r\n1,2\r\n\r\n3,4\r\n \r\n",
        "\ufeffup,work\n\n1, 2\n3,4",
    ],
)
def test_empty_lines_and_a_byte_order_mark_are_no_rows(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(text.encode())
    table, _ = read_tables(tmp_path, "t.csv")
    assert {name: list(column) for name, column in table.columns.items()} == {
        "up": [1, 3],
        "work": [2, 4],
    }


def test_a_missing_value_alone_on_its_line_is_a_row(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text('up\n1\n""\n3\n\n', encoding="utf-8")
    (message, _) = faults_of(tmp_path, "t.csv", ("up", "up")).values()
    assert message.startswith("1 missing or NaN of 3 rows (first: row 2)")


@pytest.mark.parametrize("text", ["oops", "NA", "1,000.5", "1,5"])
def test_a_text_among_numbers_is_named_with_its_row(text: str, tmp_path: Path) -> None:
    rows = [f"{row},1" for row in range(300)]
    rows[200] = f'"{text}",1'
    (tmp_path / "t.csv").write_text("\n".join(["up,work", *rows]), encoding="utf-8")
    faults = faults_of(tmp_path, "t.csv")
    assert set(faults) == {f"{LINK}.column"}
    for word in (f"column 'up' holds {text!r} in row 201", "numbers", "as 1.5", "missing"):
        assert word in faults[f"{LINK}.column"]


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
