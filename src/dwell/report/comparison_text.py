"""A comparison on the terminal: its tables as text, and what they come to."""

from __future__ import annotations

import io
import itertools
import textwrap

from dwell.report.findings import COST, RATE, question, standing, verdict
from dwell.report.formatting import (
    OURS,
    Measure,
    listed,
    shown_contender,
    shown_scenario,
    write_interval,
)
from dwell.report.palette import contended
from dwell.study import Comparison

__all__ = ["comparison_text"]

POLICY, STANDING = "policy", ""
# Of tables where the terminal's width is not given, and of sentences at most.
WIDEST = 1000
PROSE = 100
MEASURES = (
    RATE,
    Measure("l95_ms", "L95", "ms"),
    COST,
    Measure("migrations", "migr."),
)
# Written without their intervals, as are the shares of the windows: a page has the room for them.
MEANS = (
    Measure("u_robot", "U_r", "%", 100.0),
    Measure("u_edge", "U_e", "%", 100.0),
)


def comparison_text(comparison: Comparison, *, width: int | None = None) -> str:
    """Return the tables of a comparison and its verdict as plain text.

    Parameters
    ----------
    comparison : Comparison
    width : int, optional
        Columns of the terminal: cells fold where they are too few. As wide as it takes where None.
    """
    from rich.console import Console
    from rich.table import Table

    columns = _columns(comparison)
    rows = {
        scenario: [_row(comparison, scenario, policy) for policy in comparison.policies]
        for scenario in comparison.scenarios
    }
    # The columns of all tables stand below one another.
    cells = zip(*itertools.chain([columns], *rows.values()), strict=True)
    widths = [max(map(len, column)) for column in cells]
    buffer = io.StringIO()
    console = Console(file=buffer, width=width or WIDEST, color_system=None, highlight=False)
    for scenario, found in rows.items():
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        for column, least in zip(columns, widths, strict=True):
            table.add_column(
                column,
                no_wrap=column == POLICY,
                justify="left" if column in (POLICY, STANDING) else "right",
                overflow="fold",
                min_width=least,
            )
        for row in found:
            table.add_row(*row)
        console.print(shown_scenario(scenario))
        console.print(table)
        console.print()
    prose = textwrap.TextWrapper(min(width or PROSE, PROSE), break_on_hyphens=False)
    lines = [buffer.getvalue().rstrip(), "", prose.fill(_note(comparison))]
    lines += ["", prose.fill(question(comparison)), ""]
    prose.initial_indent, prose.subsequent_indent = "- ", "  "
    lines += [prose.fill(item.replace("`", "")) for item in verdict(comparison)]
    return "\n".join(line.rstrip() for line in "\n".join(lines).splitlines()) + "\n"


def _columns(comparison: Comparison) -> list[str]:
    first, *others = (f"{one.name} {one.unit}".rstrip() for one in (*MEASURES, *MEANS))
    return [POLICY, first, STANDING, *others, *comparison.problem.candidates]


def _row(comparison: Comparison, scenario: str, policy: str) -> list[str]:
    row = [shown_contender(policy)]
    for measure in MEASURES:
        interval = comparison.interval(scenario, policy, measure.column)
        written = write_interval(interval, measure, larger_half=True)
        row.append(str(written).replace("± ", "±"))
        if measure is RATE:
            row.append(standing(comparison, scenario, policy))
    shares = [
        Measure(f"share_{name}", name, factor=100.0, decimals=0)
        for name in comparison.problem.candidates
    ]
    for measure in (*MEANS, *shares):
        interval = comparison.interval(scenario, policy, measure.column)
        row.append(write_interval(interval, measure).value)
    return row


def _note(comparison: Comparison) -> str:
    text = (
        f"Means over {len(comparison.seeds)} seeds; ± the larger half of the 95 % interval. "
        f"{listed(comparison.problem.candidates)}: % of the windows."
    )
    known = map(contended, comparison.policies)
    return f"{text} {OURS}" if any(one and one.family == "atp" for one in known) else text
