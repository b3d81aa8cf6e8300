"""The page of a run."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from dwell import Run, open_run, simulate
from dwell.errors import RunError
from dwell.model import NodeDisturbance
from dwell.report import run_html
from tests.report.pages import Page, small_run
from tests.study.cell import make_problem


@pytest.fixture(scope="module")
def html() -> str:
    return run_html(small_run())


def test_it_is_self_contained_and_well_formed(html: str) -> None:
    page = Page(html)
    assert page.outside == []
    assert "script" not in page.tags
    assert not re.search(r"https?:|@import|url\((?!#)", html)
    assert len(set(page.ids)) == len(page.ids)


def test_it_says_what_happened(html: str) -> None:
    run, page = small_run(), Page(html)
    assert page.headings[0] == "A run of DTP on small"
    # One number of migrations: those after the warm-up.
    first = run.windows.filter(~run.windows["warmup"])["window"][0]
    counted = run.decisions.filter(run.decisions["window"] >= first)
    migrations = int(counted["migrated"].sum())
    assert page.tags.count("svg") == 4
    assert page.text.count("→") == migrations
    assert "min_dwell=1" in page.text


def test_a_placement_that_never_moves_is_called_so() -> None:
    page = Page(run_html(small_run("LOC")))
    assert "LOC, which never moves" in page.headings[0]
    assert "and never migrated" in page.text


def test_what_shadow_jobs_cost_is_told() -> None:
    run = small_run()
    assert "shadow jobs" not in Page(run_html(run)).text
    windows = run.windows.with_columns(
        shadow_cycles=pl.lit(1),
        shadow_bytes=pl.lit(41250),
        shadow_R1=pl.lit(0.0),
        shadow_E=pl.lit(0.012),
        shadow_R2=pl.lit(0.004),
    )
    shown = Run(run.meta, {"cycles": run.cycles, "windows": windows, "decisions": run.decisions})
    text = Page(run_html(shown)).text
    # 10 cycles of 33 ms a window: 330 kbit in 0.33 s.
    assert "10.0 % of the cycles went through another placement as well" in text
    assert "took 1.2 % of E and 0.4 % of R2, and sent 1.00 Mbit/s more" in text


def test_a_run_from_its_folder_makes_the_same_page(html: str, tmp_path: Path) -> None:
    folder = small_run().save(tmp_path / "run")
    assert run_html(open_run(folder)) == html


def test_a_run_that_lost_everything_has_a_page() -> None:
    scenarios = {"dead": (NodeDisturbance("R2", down=True),)}
    run = simulate(replace(make_problem(), scenarios=scenarios), scenario="dead", seed=1, windows=6)
    text = Page(run_html(run)).text
    assert "100 %" in text
    assert "∞" in text


def test_a_record_without_its_problem_is_refused() -> None:
    run = small_run()
    bare = Run({}, {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions})
    with pytest.raises(RunError, match="record of the problem is incomplete"):
        run_html(bare)
