"""`dwell study paper` says where the paper's questions are now."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from dwell.cli.commands import app


@pytest.mark.parametrize(
    "words",
    [
        ["paper"],
        ["paper", "--quick"],
        ["paper", "--chapter", "table", "--examples", "examples"],
        ["my-study.yaml", "--quick"],
    ],
)
def test_the_old_command_names_the_new_one(words: list[str]) -> None:
    result = CliRunner().invoke(app, ["study", *words])
    assert result.exit_code == 2
    assert "make paper" in result.output
