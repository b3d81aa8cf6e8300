"""Example cells with several rates: their pages show what their scripts print."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.cli.small_cell import call, read_json

ROOT = Path(__file__).parents[2]
#: Cells that have a page.
CELLS = ("inner-loop",)


def block(name: str, language: str) -> str:
    """Return the only block of a page in a language."""
    page = (ROOT / "docs" / "howto" / f"{name}.md").read_text(encoding="utf-8")
    (text,) = re.findall(rf"^```{language}\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    return str(text)


@pytest.mark.parametrize("name", CELLS)
def test_a_page_shows_what_its_script_prints(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(block(name, "python"), f"{name}.md", "exec"), {})
    assert capsys.readouterr().out == block(name, "text")


@pytest.mark.parametrize("name", CELLS)
def test_a_cell_has_no_faults_and_no_warnings(name: str) -> None:
    found = read_json(call("check", ROOT / "examples" / f"{name}.yaml", "--json"))
    assert found["valid"] is True
    assert found["warnings"] == []
