"""What tests of cell files share."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from tests.cellfile.test_cell import EXAMPLE


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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a cell."""
    (tmp_path / "cell.yaml").write_text(EXAMPLE.read_text(encoding="utf-8"), encoding="utf-8")
    return tmp_path
