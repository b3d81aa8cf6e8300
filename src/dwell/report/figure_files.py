"""Figures and tables of a page as files for a paper: PDF, SVG, LaTeX, and CSV of their data."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING

from dwell.report.figure import COLUMN_PT, pdf, printed_svg
from dwell.report.formatting import SYMBOL
from dwell.report.page import Page, environment
from dwell.report.table import Table, Text

if TYPE_CHECKING:
    from jinja2 import Environment

#: Width of both columns of a paper in points; a table with more columns than this is that wide.
BOTH_PT, MOST_COLUMNS = 516, 6
#: LaTeX for special characters.
ESCAPES = {
    "\\": r"\textbackslash{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\u2212": "$-$",
    "\u2009": r"\,",
    "\u00b1": r"$\pm$",
    "\u221e": r"$\infty$",
    "\u2013": "--",
    "\u2192": r"$\to$",
    "\u0394": r"$\Delta$",
    "\u2019": "'",
    "<": "$<$",
    ">": "$>$",
}


def figure_files(page: Page) -> Iterator[tuple[str, bytes | str]]:
    """Yield name and content of the files of every figure and table of a page.

    A figure has ``SLUG.pdf``, ``SLUG.svg`` and one CSV file per data frame; a table has
    ``SLUG.csv`` and ``SLUG.tex``.
    """
    import polars as pl

    for figure in page.figures:
        slug = _file_name(figure.slug)
        yield f"{slug}.pdf", pdf(figure)
        yield f"{slug}.svg", printed_svg(figure)
        for name, frame in figure.frames.items():
            end = "" if len(figure.frames) == 1 else f"-{name}"
            yield f"{slug}{end}.csv", frame.write_csv()
    for table in page.tables:
        if not table.rows:
            continue
        slug = _file_name(table.slug)
        names = [table.group.column] if table.group is not None else []
        names += [column.column for column in table.columns]
        ends = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
        known = {key for row in table.rows for key in row}
        columns = [name for name in dict.fromkeys(ends) if name in known]
        rows = [[row.get(name) for name in columns] for row in table.rows]
        frame = pl.DataFrame(
            rows, schema=columns, orient="row", infer_schema_length=None, strict=False
        )
        yield f"{slug}.csv", frame.write_csv()
        yield f"{slug}.tex", table_tex(table)


def _file_name(slug: str) -> str:
    return re.sub(r"[^\w.-]+", "-", slug)


def table_tex(table: Table) -> str:
    """Return a table as LaTeX in 7-point text, one column of a paper wide, or two for many columns.

    The LaTeX needs the packages booktabs and xcolor.
    """
    wide = len(table.columns) > MOST_COLUMNS
    align = "".join("l" if isinstance(column, Text) else "r" for column in table.columns)
    template = _environment().get_template("table.tex")
    return template.render(
        table=table, groups=list(table.groups()), align=align, width=BOTH_PT if wide else COLUMN_PT
    )


@cache
def _environment() -> Environment:
    latex = environment().overlay(
        autoescape=False,
        variable_start_string="<<",
        variable_end_string=">>",
        block_start_string="<%",
        block_end_string="%>",
        comment_start_string="<#",
        comment_end_string="#>",
        keep_trailing_newline=True,
    )
    latex.filters["tex"] = _tex
    return latex


def _tex(text: str) -> str:
    """Return a text as LaTeX, with indexed symbols in math mode."""

    def written(sign: re.Match[str]) -> str:
        letter, index = sign.groups()
        if index is None:
            return ESCAPES.get(sign[0], sign[0])
        return f"${ESCAPES.get(letter, letter).strip('$')}_{{\\mathrm{{{index}}}}}$"

    return re.sub(f"{SYMBOL.pattern}|.", written, text)
