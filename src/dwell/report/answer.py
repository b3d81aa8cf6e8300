"""Short representations of results: the answer as text, and as HTML for a notebook.

The answer is the first section of the report's page. Pictures need the extra `report`; without it
a notebook shows the tables.
"""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from html import escape

from dwell.model import Problem
from dwell.model.bounds import counted
from dwell.model.entry_points import PAGES, added
from dwell.report.added import ResultPages
from dwell.report.figure import svg
from dwell.report.formatting import write_ms
from dwell.report.method import placements_table
from dwell.report.page import TEMPLATES, Block, Fact, Page, Section
from dwell.report.table import Table, table_text
from dwell.report.topology import topology

#: Size of a screen, in characters.
LINES, COLUMNS = 24, 80
#: Largest number of facts above a picture.
NUMBERS = 5
_shown = itertools.count()


def summary_of(shown: object) -> str:
    """Return the answer as at most `LINES` lines of text; a last line counts the omitted lines."""
    page = _answer(shown)
    lines = [*textwrap.wrap(page.title, COLUMNS), *textwrap.wrap(page.subtitle, COLUMNS)]
    if page.facts:
        width = max(len(fact.name) for fact in page.facts)
        lines += ["", *(f"{one.name:<{width}}  {one.value:>8}  {one.error}" for one in page.facts)]
    for table in page.tables:
        lines += ["", *table_text(table, width=COLUMNS).splitlines()]
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], f"... {len(lines) - LINES + 1} more lines"]
    return "\n".join(line.rstrip() for line in lines)


def html_of(shown: object) -> str:
    """Return the answer as HTML for a notebook: facts with a picture, or with tables.

    A cell has both a picture and tables.
    """
    page = _answer(shown)
    parts = [f"<b>{escape(page.title)}</b><div>{escape(page.subtitle)}</div>"]
    if page.facts:
        parts.append(f"<p>{''.join(_fact(one) for one in page.facts[:NUMBERS])}</p>")
    drawn = list(_drawn(page))
    tables = page.tables if not drawn or isinstance(shown, Problem) else ()
    parts += drawn + [_table(table) for table in tables]
    return f"<style>{_style()}</style><div class=dwell-shown>{''.join(parts)}</div>"


def _answer(shown: object) -> Page:
    """Return the page of a result with its first sections only."""
    if isinstance(shown, Problem):
        return _cell(shown)
    from dwell.record import Run
    from dwell.report.comparison_page import comparison_page
    from dwell.report.run_page import run_page
    from dwell.report.study_page import study_page
    from dwell.study import Comparison, StudyRuns

    match shown:
        case Run():
            return run_page(shown, sections=1)
        case Comparison():
            # The third section counts scenarios under and over the aim.
            return comparison_page(shown, sections=3)
        case StudyRuns():
            return study_page(shown, sections=1)
        case _:
            for kind in added(PAGES).values():
                if isinstance(kind, ResultPages) and kind.kind == type(shown).__name__:
                    return kind.page(shown, 1)
            raise TypeError(f"nothing shows a {type(shown).__name__}")


def _cell(problem: Problem) -> Page:
    pipeline, controller = problem.pipeline, problem.controller
    facts = [
        Fact("period", write_ms(pipeline.period_ms)),
        Fact("deadline", write_ms(pipeline.deadline_ms)),
        Fact("window", counted(problem.window_cycles, "cycle")),
        Fact("policy", controller.policy, f"on {problem.controller_node}"),
        Fact("scenarios", f"{len(problem.scenarios)}"),
    ]
    blocks: list[Block]
    try:
        blocks = [topology(problem), placements_table(problem)]
    except ModuleNotFoundError:
        # Figures need data frames; an installation on a robot lacks Polars.
        blocks = [placements_table(problem)]
    return Page(f"Cell {problem.name}", str(pipeline), [Section("", blocks)], facts)


def _drawn(page: Page) -> Iterator[str]:
    """Yield the first picture of a page, if the extra `report` is installed."""
    for figure in itertools.islice(page.figures, 1):
        # The ids in a figure must be unique in the notebook.
        own = replace(figure, slug=f"shown-{next(_shown)}")
        try:
            picture = svg(own)
        except ModuleNotFoundError:
            return
        yield f"{picture}<div>{escape(figure.caption)}</div>"


def _fact(fact: Fact) -> str:
    error = f" <small>{escape(fact.error)}</small>" if fact.error else ""
    return f"<span>{escape(fact.name)}<br><b>{escape(fact.value)}</b>{error}</span>"


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in table.headings)
    rows = []
    for heading, group in table.groups():
        if heading:
            rows.append(f"<tr><th colspan={len(table.headings)}>{escape(heading)}</th></tr>")
        for row in group:
            cells = "".join(f"<td>{escape(f'{one.text} {one.error}'.strip())}</td>" for one in row)
            rows.append(f"<tr>{cells}</tr>")
    caption = f"<caption>{escape(table.title)}</caption>"
    body = "".join(rows)
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


@cache
def _style() -> str:
    """Return the style sheet of answers: the colours of a page, by the notebook's theme."""
    css = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    light, dark = (
        re.sub(r"\s+", " ", colours) for colours in re.findall(r":root \{\s*([^}]*)\}", css)
    )
    light = light.removeprefix("color-scheme: light dark; ")
    themes = ", ".join(
        f"{theme} .dwell-shown"
        for theme in ('[data-jp-theme-light="false"]', ".vscode-dark", ".theme-dark")
    )
    own = (TEMPLATES / "notebook.css").read_text(encoding="utf-8")
    return f".dwell-shown {{ {light} }} {themes} {{ {dark} }} {own}"
