"""Example cells with several rates or prices: their pages show what their scripts print."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import dwell
from dwell.model import evolve
from dwell.study import compare
from tests.cli.small_cell import call, read_json

ROOT = Path(__file__).parents[2]
#: Pages and their cells.
CELLS = {
    "inner-loop": "inner-loop",
    "chunks": "chunks",
    "autoware": "autoware",
    "clouds": "cloud-chunks",
}


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


@pytest.mark.parametrize("name", CELLS.values())
def test_a_cell_has_no_faults_and_no_warnings(name: str) -> None:
    found = read_json(call("check", ROOT / "examples" / f"{name}.yaml", "--json"))
    assert found["valid"] is True
    assert found["warnings"] == []


# By hand: 150 ms and half of the interval; below 150 ms the one worker takes the newest of the
# requests that wait, every 150 ms.
@pytest.mark.parametrize(
    ("steps", "age_ms"), [(16, 470), (8, 310), (5, 250), (4, 230), (3, 300), (2, 270), (1, 250)]
)
def test_ages_of_chunks_by_the_steps_between_requests(steps: int, age_ms: int) -> None:
    problem = dwell.load(ROOT / "examples" / "chunks.yaml")
    cell = evolve(problem, {"tasks.observe.every": steps})
    (found,) = compare(cell, policies=["ROBOT"], seeds=[1], windows=3, processes=1).runs.to_dicts()
    assert found["aoi_mean_ms"] == pytest.approx(age_ms)
