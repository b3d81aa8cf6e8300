"""`dwell demo`: its tables, its page, and what it needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.small_cell import REAL, call, read_json


def test_demo_prints_tables_and_writes_the_page(tmp_path: Path) -> None:
    arguments = ("--seeds", "2", "--windows", "8", "--processes", "1", "--out", tmp_path / "out")
    result = call("demo", *arguments)
    assert (result.exit_code, result.stderr) == (0, "")
    for words in ("Cell canonical", "Robot CPU stress", "DTP", "our reconstruction"):
        assert words in result.stdout
    assert result.stdout.endswith(f"report: {tmp_path / 'out' / 'report.html'}\n")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["report.html"]


def test_demo_as_json(tmp_path: Path) -> None:
    arguments = ("--seeds", "1", "--windows", "7", "--processes", "1", "--out", tmp_path, "--json")
    found = read_json(call("demo", *arguments))
    rows = found["comparisons"]["canonical"]
    twice = {"DTP as printed", "DTP"}
    others = {"LOC", "SO", "HYB", "atp", "latency-first", "cusum+corrected"}
    assert {row["policy"] for row in rows} == others | twice
    assert {row["seeds"] for row in rows} == {1}


@pytest.mark.skipif(not REAL.is_dir(), reason="the measurements are not beside the repository")
def test_demo_on_measurements(tmp_path: Path) -> None:
    arguments = ("--seeds", "1", "--windows", "8", "--processes", "1", "--out", tmp_path)
    result = call("demo", "--real", REAL, *arguments)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "Cell real\n" in result.stdout
    assert "Cell real-5g\n" in result.stdout
    assert (tmp_path / "report.html").is_file()


def test_demo_without_its_measurements_is_a_mistake(tmp_path: Path) -> None:
    result = call("demo", "--real", tmp_path, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "does not exist" in result.stderr
    assert not (tmp_path / "out").exists()
