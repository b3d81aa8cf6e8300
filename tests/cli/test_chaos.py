"""`dwell testbed chaos` from the command line: what it refuses, and its name of before."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from dwell.cli.commands import app


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    done = CliRunner().invoke(app, ["testbed", "chaos", "--faults", "1", "--out", str(tmp_path)])
    assert done.exit_code
    assert "is not a chaos campaign's" in done.output
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_a_cell_without_an_actuator_is_refused(tmp_path: Path) -> None:
    cell = Path(__file__).parents[2] / "examples" / "live" / "cell.yaml"
    text = cell.read_text().replace("actuators:", "actuators: {}\n  # ", 1)
    (tmp_path / "cell.yaml").write_text(text)
    words = ["testbed", "chaos", str(tmp_path / "cell.yaml"), "--faults", "1"]
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert done.exit_code
    assert "one sink" in done.output


def test_the_command_of_before_says_what_has_taken_its_place() -> None:
    done = CliRunner().invoke(app, ["live", "chaos", "--minutes", "2"])
    assert done.exit_code == 2
    assert "`dwell testbed chaos`" in done.stderr
