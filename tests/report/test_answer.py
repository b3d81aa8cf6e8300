"""What objects show of themselves."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

import dwell
from dwell.model import Problem

ROOT = Path(__file__).parents[2]

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load(EXAMPLES / "canonical.yaml")


@pytest.fixture(scope="module")
def run(canonical: Problem) -> dwell.Run:
    return dwell.simulate(canonical, seed=1, windows=30, scenario="robot-cpu-stress", jobs=True)


def test_a_summary_has_the_numbers(run: dwell.Run) -> None:
    first = run.windows.filter(~pl.col("warmup"))["first_cycle"][0]
    missed = run.cycles["missed"].to_numpy()[first:].mean()
    assert f"{100 * missed:.2f} %" in run.summary()


def test_what_is_shown_is_escaped(canonical: Problem) -> None:
    html = replace(canonical, name="<b>&")._repr_html_()
    assert "&lt;b&gt;&amp;" in html
    assert "<b>&" not in html


def test_a_robot_without_tables_shows_its_cell(
    canonical: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "polars", None)
    monkeypatch.setitem(sys.modules, "vl_convert", None)
    assert re.search(r"<td>LOC</td>\s*<td>R1</td>", canonical._repr_html_())
    assert "33.3 ms" in canonical.summary()
