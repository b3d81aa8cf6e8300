"""What every page is: one file that loads nothing, and works in a browser as it does without."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import polars as pl
import pytest

from dwell.report import comparison_html, run_html
from dwell.report.charts import cumulative
from dwell.report.figure import Figure
from dwell.report.page import Fact, Page, Section, page_html
from dwell.report.palette import ramp_styles
from dwell.report.table import Table, Text
from tests.report.pages import Page as Parsed
from tests.report.pages import small_comparison, small_run

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")


def dom(page: str, folder: Path, *, width: int = 1200, script: str = "") -> str:
    """Return what a page is in a browser, `script` run at its end; its console must be silent."""
    assert CHROMIUM is not None
    file = folder / "page.html"
    if script:
        # A page forbids all scripts but its own.
        page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
        before, _, after = page.rpartition("</body>")
        page = f"{before}<script>{script}</script></body>{after}"
    file.write_text(page, encoding="utf-8")
    done = subprocess.run(
        [
            CHROMIUM,
            *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
            *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
            f"--user-data-dir={folder / 'profile'}",
            f"--window-size={width},9000",
            *("--enable-logging=stderr", "--virtual-time-budget=20000", "--dump-dom"),
            file.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert said == []
    return done.stdout


def test_a_page_may_load_nothing_and_evaluate_nothing() -> None:
    page = run_html(small_run())
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    assert "unsafe-eval" not in policy[1]
    assert policy[1].count("'sha256-") == 2
    assert Parsed(page).outside == []
    assert len(page.encode()) < 5e6


def test_a_static_page_has_no_scripts_and_the_same_figures() -> None:
    page, static = run_html(small_run()), run_html(small_run(), static=True)
    assert "<script" not in static
    assert 'href="#window-' in static
    assert not re.search(r'href="(?!#)', static)
    drawings = re.compile(r'<div class="drawing".*?</svg>', re.DOTALL)
    assert drawings.findall(static) == drawings.findall(page)
    assert len(drawings.findall(page)) > 5


def test_what_is_written_in_a_page_is_text_and_no_markup() -> None:
    rows = [{"name": "</script><b>x", "is": "over"}]
    table = Table("t", "a < b & V_D", [Text("name", "<i>"), Text("is", "is", "word")], rows)
    page = page_html(Page("<x>", "y", [Section("z", [table])], [Fact("V_D", "5 %")]), static=True)
    assert "&lt;/script&gt;&lt;b&gt;x" in page
    assert "a &lt; b &amp; V<sub>D</sub>" in page
    assert '<span class="word' not in page
    assert 'class="word bad"' in page


@in_browser
def test_every_figure_is_drawn_again_under_the_page_s_own_policy(tmp_path: Path) -> None:
    page = run_html(small_run())
    shown = dom(page, tmp_path)
    drawn = shown.count('class="drawing live"')
    # Those of windows are folded, and drawn when they are opened.
    assert drawn == page.count("data-figure=") - page.count("<details>")


@in_browser
def test_policies_and_seeds_are_chosen_and_tables_sorted(tmp_path: Path) -> None:
    script = """
    addEventListener("load", () => setTimeout(() => {
      const table = document.querySelector("#results table");
      table.tHead.rows[0].cells[1].click();
      const rows = [...table.tBodies[0].rows].slice(1);
      const sorted = rows.map((row) => Number(row.cells[1].dataset.sort));
      const marks = () => document.querySelectorAll("#violation_rate path[aria-label],"
        + "#violation_rate g.mark-symbol path").length;
      const before = marks();
      const box = document.querySelector("input[value=DTP]");
      box.click();
      setTimeout(() => { document.title = JSON.stringify({
        sorted, before, after: marks(),
        hidden: document.querySelectorAll("tr[data-policy=DTP][hidden]").length,
        shown: document.querySelectorAll("form.choice:not([hidden])").length,
      }); }, 2000);
    }, 6000));
    """
    shown = dom(comparison_html(small_comparison()), tmp_path, script=script)
    title = re.search(r"<title>(.*?)</title>", shown)
    assert title is not None
    told = json.loads(html.unescape(title[1]))
    assert told["sorted"] == sorted(told["sorted"])
    assert told["shown"] == 1
    # Of five policies one is gone, in both scenarios.
    assert told["before"] > 0
    assert told["after"] == pytest.approx(told["before"] * 4 / 5)
    assert told["hidden"] > 0


@in_browser
def test_what_stands_in_place_of_policies_is_not_theirs_to_choose(tmp_path: Path) -> None:
    rows = [("a", "R1->E", float(n), n / 10) for n in range(10)]
    names = ["scenario", "policy", "value", "share"]
    frame = pl.DataFrame(rows, schema=names, orient="row")
    draw = cumulative(frame, ramp_styles(["R1->E"]), ("ms", "share"))
    figure = Figure("delays", "", {"rows": frame}, draw)
    page = Page("t", "s", [Section("", [figure])], policies={"LOC": "#0072b2"})
    shown = dom(page_html(page), tmp_path)
    assert 'class="drawing live"' in shown
    (line,) = re.findall(r'<path [^>]*stroke="var\(--ramp-4\)"[^>]*>', shown.split("<svg", 1)[1])[
        -1:
    ]
    assert 'd="M' in line


@in_browser
def test_no_figure_is_wider_than_a_small_screen(tmp_path: Path) -> None:
    script = """
    addEventListener("load", () => setTimeout(() => {
      const wide = [...document.querySelectorAll(".drawing.live svg")]
        .filter((svg) => svg.getBoundingClientRect().width > 500);
      document.title = `${wide.length} of ${document.querySelectorAll(".drawing.live").length}`;
    }, 8000));
    """
    shown = dom(run_html(small_run()), tmp_path, width=500, script=script)
    assert re.search(r"<title>0 of [1-9]", shown)
