"""What tests of commands share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.small_cell import SMALL


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a small cell in a folder of its own, which is the current one."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print no line of progress, as on a machine that is fast enough."""
    monkeypatch.setattr("dwell.cli.output.EVERY_S", 600.0)
