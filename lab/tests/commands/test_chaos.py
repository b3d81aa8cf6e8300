"""`dwell testbed chaos` from the command line: what it refuses."""

from __future__ import annotations

from pathlib import Path

from tests.cli.small_cell import ROOT, call


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    done = call("testbed", "chaos", "--faults", "1", "--out", tmp_path)
    assert done.exit_code
    assert "is not a chaos campaign's" in done.output
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_a_cell_without_an_actuator_is_refused(tmp_path: Path) -> None:
    text = (ROOT / "examples" / "live" / "cell.yaml").read_text()
    (tmp_path / "cell.yaml").write_text(text.replace("actuators:", "actuators: {}\n  # ", 1))
    words = ("testbed", "chaos", tmp_path / "cell.yaml", "--faults", "1")
    done = call(*words, "--out", tmp_path / "out")
    assert done.exit_code
    assert "one sink" in done.output
