"""Pages of unusual runs: nothing is cut off, and the browser reports no warning."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from playwright.sync_api import Browser

import dwell
from dwell.model import Problem
from dwell.record import Run
from dwell.report import run_html
from dwell.report.run_page import run_page
from tests.cli.small_cell import SMALL
from tests.dash.browser import READY, chromium, in_browser, opened, settled, wait_for
from tests.dash.served import Served, serving
from tests.report.pages import figure_of

LONG = "a-placement-with-a-name-of-forty-letters"
CJK = "計算機一号機"


def small(folder: Path, **names: str) -> Problem:
    """Return the small cell with other names of its placements."""
    file = folder / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    problem = dwell.load(file)
    candidates = {names.get(name, name): one for name, one in problem.candidates.items()}
    first = names.get(problem.initial, problem.initial)
    controller = replace(problem.controller, initial=first, fallbacks=())
    return replace(problem, candidates=candidates, controller=controller)


def changed(run: Run, cycles: list[pl.Expr], windows: list[pl.Expr]) -> Run:
    tables = {name: getattr(run, name) for name in ("cycles", "windows", "decisions")}
    tables["cycles"] = tables["cycles"].with_columns(cycles)
    tables["windows"] = tables["windows"].with_columns(windows)
    return Run(run.meta, tables)


def made(kind: str, folder: Path) -> Run:
    problem = small(folder)
    windows = problem.warmup_windows + (1 if kind == "one window" else 12)
    if kind == "long names":
        problem = small(folder, LOC=LONG, OFF=CJK)
    run = dwell.simulate(problem, scenario="stress", seed=1, windows=windows)
    match kind:
        case "no decision":
            tables = {name: getattr(run, name) for name in ("cycles", "windows", "decisions")}
            return Run(run.meta, {**tables, "decisions": tables["decisions"].clear()})
        case "all met":
            return changed(run, [missed(value=False)], [rate(0.0)])
        case "all missed":
            return changed(run, [missed(value=True)], [rate(1.0)])
        case "all lost":
            never = pl.lit(None, pl.Int64).alias("latency_ns")
            bound = [
                pl.lit(problem.censor_ms).alias("seen_l95_ms"),
                pl.lit(float("inf")).alias("l95_ms"),
            ]
            return changed(run, [missed(value=True), never], [rate(1.0), *bound])
    return run


def missed(*, value: bool) -> pl.Expr:
    return pl.lit(value).alias("missed")


def rate(value: float) -> pl.Expr:
    return pl.lit(value).alias("violation_rate")


KINDS = (*("one window", "no decision", "all met", "all missed", "all lost", "long names"),)
SCREENS = ((1280, "light"), (400, "dark"))
#: Each page is drawn on one of both screens, and the other page of the run on the other; with long
#: names, on both.
REPORTS = [*((kind, *SCREENS[i % 2]) for i, kind in enumerate(KINDS)), (KINDS[-1], *SCREENS[0])]
RUNS = [*((kind, *SCREENS[1 - i % 2]) for i, kind in enumerate(KINDS)), (KINDS[-1], *SCREENS[1])]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as shown:
        yield shown


@in_browser
@pytest.mark.parametrize(("kind", "width", "scheme"), REPORTS)
def test_the_report_fits_and_the_browser_is_silent(
    kind: str, width: int, scheme: str, tmp_path: Path, browser: Browser
) -> None:
    file = tmp_path / "report.html"
    file.write_text(run_html(made(kind, tmp_path)), encoding="utf-8")
    drawn = "document.querySelectorAll('section:not(:has(details)) .drawing.live').length > 1"
    size = {"width": width, "height": 900}
    with opened(browser, file.as_uri(), ready=drawn, viewport=size, color_scheme=scheme) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Return the page of a folder with one run of each kind."""
    folder = tmp_path_factory.mktemp("runs")
    for kind in KINDS:
        made(kind, folder).save(folder / kind)
    with serving(folder, folder) as page:
        yield page


@in_browser
@pytest.mark.parametrize(("kind", "width", "scheme"), RUNS)
def test_the_page_of_the_run_fits_and_the_browser_is_silent(
    kind: str, width: int, scheme: str, served: Served, browser: Browser
) -> None:
    place = served.get("/cells")["runs"]["runs"].index(kind)
    size, listed = {"width": width, "height": 900}, "document.querySelector('tbody th')"
    with opened(browser, served.address, ready=listed, viewport=size, color_scheme=scheme) as page:
        page.goto(f"http://{served.host}/cell/{place}")
        wait_for(page, READY)
        settled(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        verdict = page.locator(".verdict .judged").inner_text()
        if kind in ("all missed", "all lost"):
            assert "100.00 %" in verdict
        if kind == "all met":
            assert "0.00 %" in verdict


def test_a_lost_l95_has_no_value_and_a_mark_of_its_own(tmp_path: Path) -> None:
    rows = figure_of(run_page(made("all lost", tmp_path)), "time").frames["windows"]
    assert rows["l95"].null_count() == rows.height
    assert rows["lost"].all()
    usual = figure_of(run_page(made("all met", tmp_path)), "time").frames["windows"]
    assert usual["l95"].null_count() == 0
    assert not usual["lost"].any()
