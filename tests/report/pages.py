"""What every page has to be, and the runs that pages are made of in these tests."""

from __future__ import annotations

import re
from functools import cache
from html.parser import HTMLParser

from dwell import Run, simulate
from dwell.report.figure import Figure
from dwell.report.page import Fact
from dwell.report.page import Page as Shown
from dwell.report.table import Table
from dwell.study import Comparison, compare
from dwell.study.metric import Metric
from tests.cells.small import make_problem

VOID = {"meta", "br", "img", "link", "use", "input", "hr", "col"}


class Page(HTMLParser):
    """A page taken apart: what it loads, its headings, its text, and whether it is well formed."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[str] = []
        self.outside: list[str] = []
        self.ids: list[str] = []
        self.headings: list[str] = []
        self.labels: list[str] = []
        self._text: list[str] = []
        self.feed(html)
        self.close()
        assert not self.open, f"never closed: {self.open}"
        self.text = re.sub(r"\s+", " ", " ".join(self._text).replace("\u00a0", " "))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "action", "data") and not (value or "").startswith("#"):
                self.outside.append(f"{tag} {name}={value}")
            if name == "id" and value:
                self.ids.append(value)
            if name == "aria-label" and value:
                self.labels.append(value)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open, f"</{tag}> closes nothing"
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("style", "script"):
            return
        if self.open and self.open[-1] in ("h1", "h2", "h3"):
            self.headings.append(data)
        self._text.append(data)


@cache
def small_comparison() -> Comparison:
    """Return a comparison of a few short runs."""
    return compare(
        make_problem(),
        scenarios=("baseline", "robot-cpu-stress"),
        policies=("LOC", "SO", "HYB", "atp", "dtp"),
        seeds=(1, 2, 3),
        windows=12,
        processes=1,
    )


@cache
def small_run(policy: str = "dtp", scenario: str = "robot-cpu-stress") -> Run:
    """Return a short run with its jobs."""
    return simulate(make_problem(), scenario=scenario, policy=policy, seed=1, windows=12, jobs=True)


def facts_of(page: Shown) -> dict[str, Fact]:
    """Return the numbers at the top of a page by their names."""
    return {fact.name: fact for fact in page.facts}


def table_of(page: Shown, slug: str) -> Table:
    """Return one of a page's tables."""
    return next(table for table in page.tables if table.slug == slug)


def silent_on_warmup(page: Shown) -> list[str]:
    """Return the tables of metrics that do not say whether the warm-up is in."""
    return [
        table.slug
        for table in page.tables
        if any(isinstance(column, Metric) for column in table.columns)
        and "the warm-up." not in table.caption
    ]


def figure_of(page: Shown, slug: str) -> Figure:
    """Return one of a page's figures."""
    return next(figure for figure in page.figures if figure.slug == slug)
