"""The command of a cell's processes: how it is written, and how it is read."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dwell.live.host.hosting import Platform
from dwell.live.host.role_command import main, server, words

CELL = Path(__file__).parents[3] / "examples" / "live" / "cell.yaml"


def test_the_fork_server_runs_the_platform_s_program() -> None:
    program = ("other.module", "--more", "x")
    serving = ["--cell", str(CELL), "--serve"]
    assert server(CELL, program) == [sys.executable, "-m", *program, *serving]
    assert server(CELL, program, 7)[-2:] == ["--owner", "7"]
    assert server(CELL, Platform.program)[2] == "dwell.live.host.role_command"


def test_words_name_what_was_given_alone(tmp_path: Path) -> None:
    plain = words(CELL, "stamper@R1", tmp_path)
    assert plain == ["--who", "stamper@R1", "--cell", str(CELL), "--state", str(tmp_path)]
    more = words(CELL, "stamper@R1", tmp_path, cpus=[3, 1], priority=20)
    assert more == [*plain, "--cpus", "1,3", "--realtime", "20"]


def test_a_cell_that_cannot_be_read_ends_the_fork_server(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--cell", str(tmp_path / "none.yaml"), "--serve"]) == 2
    assert "none.yaml" in capsys.readouterr().err
