"""A comparison on the terminal: its tables as text, and what they come to."""

from __future__ import annotations

import io
import textwrap

from dwell.report.findings import COST, RATE, question, standing, verdict
from dwell.report.wording import Measure, shown_policy, shown_scenario, write_interval
from dwell.study import Comparison

__all__ = ["comparison_text"]

# Of tables where the terminal's width is not given, and of sentences at most.
WIDEST = 1000
PROSE = 100
MEASURES = (
    RATE,
    Measure("l95_ms", "L95", "ms"),
    COST,
    Measure("u_robot", "U_r", "%", 100.0),
    Measure("u_edge", "U_e", "%", 100.0),
    Measure("migrations", "migr."),
)
# Narrower than in a page, with the remark below the table.
NAMES = {"atp": "ATP *"}
REMARK = "* our reconstruction of ATP, whose rule has no public numbers"


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

    shares = [
        Measure(f"share_{name}", name, "%", 100.0, decimals=0)
        for name in comparison.problem.candidates
    ]
    measures = (*MEASURES, *shares)
    buffer = io.StringIO()
    console = Console(file=buffer, width=width or WIDEST, color_system=None, highlight=False)
    for scenario in comparison.scenarios:
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column(shown_scenario(scenario), no_wrap=True)
        for measure in measures:
            table.add_column(
                f"{measure.name} {measure.unit}".rstrip(), justify="right", overflow="fold"
            )
            if measure is RATE:
                table.add_column("", overflow="fold")
        for policy in comparison.policies:
            table.add_row(*_row(comparison, measures, scenario, policy))
        console.print(table)
        console.print()
    prose = textwrap.TextWrapper(min(width or PROSE, PROSE), break_on_hyphens=False)
    note = (
        f"Mean over {len(comparison.seeds)} seeds and half of its 95 % interval, or the interval. "
        f"Columns {', '.join(comparison.problem.candidates)}: share of the windows."
    )
    lines = [buffer.getvalue().rstrip(), "", prose.fill(note)]
    if any(policy in NAMES for policy in comparison.policies):
        lines.append(prose.fill(REMARK))
    lines += ["", prose.fill(question(comparison)), ""]
    prose.initial_indent, prose.subsequent_indent = "- ", "  "
    lines += [prose.fill(item.replace("`", "")) for item in verdict(comparison)]
    return "\n".join(line.rstrip() for line in "\n".join(lines).splitlines()) + "\n"


def _row(
    comparison: Comparison, measures: tuple[Measure, ...], scenario: str, policy: str
) -> list[str]:
    row = [NAMES.get(policy, shown_policy(policy))]
    for measure in measures:
        written = write_interval(comparison.interval(scenario, policy, measure.column), measure)
        row.append(str(written).replace("± ", "±"))
        if measure is RATE:
            row.append(standing(comparison, scenario, policy))
    return row
