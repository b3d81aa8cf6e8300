"""`dwell dash` from the command line: what it refuses before it serves anything."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.cli.live_cell import EXAMPLE, RealCell, invoke
from tests.cli.small_cell import ROOT, assert_refused, call

CELL = EXAMPLE / "cell.yaml"
RUN = ROOT / "tests/regression/data/old-runs/simulated"


def test_without_keys_it_acts_on_this_computer_alone(tmp_path: Path) -> None:
    made = RealCell(tmp_path)
    text = made.file.read_text()
    assert "address: 127.0.0.1" in text
    made.file.write_text(text.replace("address: 127.0.0.1", "address: 10.255.0.9", 1))
    words = ("dash", made.file, "--port", "0", "--no-browser")
    for more in ((), ("--insecure", "--control")):
        code, stdout, stderr = invoke(*words, *more)
        assert code in {1, 2}
        assert stdout == ""
        assert "beyond this computer" in stderr


def test_a_run_is_not_recorded_again(tmp_path: Path) -> None:
    refused = call("dash", RUN, "--mcap", tmp_path / "run.mcap")
    assert_refused(refused, f"dwell report {RUN} --mcap")


def test_a_recording_that_is_there_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "cell.mcap"
    file.write_text("somebody's")
    refused = call("dash", CELL, "--no-browser", "--port", "0", "--mcap", file)
    assert_refused(refused, f"{file}: File exists", code=1)
    assert file.read_text() == "somebody's"


def test_what_records_has_to_be_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("dwell.dash.recorder", "dwell.record.mcap_file"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    file = tmp_path / "cell.mcap"
    refused = call("dash", CELL, "--no-browser", "--port", "0", "--mcap", file)
    assert_refused(refused, "mcap is not installed; pip install 'dwell-placement[mcap]'", code=1)
    assert not file.exists()


@pytest.mark.parametrize("text", ["", "short", "with a space in the middle of it", "ü" * 30])
def test_a_token_that_can_be_guessed_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "dwell.token"
    file.write_text(text, encoding="utf-8")
    file.chmod(0o640)
    refused = call("dash", CELL, "--no-browser", "--port", "0", "--token", file)
    assert_refused(refused, "22 to 200 letters")
    assert file.read_text(encoding="utf-8") == text


def test_a_token_that_everybody_here_can_read_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "dwell.token"
    file.write_text("a-token-that-nobody-would-guess", encoding="utf-8")
    file.chmod(0o644)
    refused = call("dash", CELL, "--no-browser", "--port", "0", "--token", file)
    assert_refused(refused, "chmod o-rwx")
