"""A comparison on the terminal: its tables as text, and what they come to."""

from __future__ import annotations

import io
import textwrap

from dwell.report.findings import COST, RATE, question, standing, verdict
from dwell.report.wording import Measure, shown_policy, shown_scenario, write_interval
from dwell.study import Comparison

__all__ = ["comparison_text"]

WIDTH = 110
MEASURES = (
    RATE,
    Measure("l95_ms", "L95", "ms"),
    Measure("u_robot", "U_r", "%", 100.0),
    Measure("u_edge", "U_e", "%", 100.0),
    Measure("migrations", "migr."),
)
# Narrower than in a page, with the remark below the table.
NAMES = {"atp": "ATP *"}
REMARK = "* our reconstruction of ATP, whose rule has no public numbers"


def comparison_text(comparison: Comparison, *, width: int = WIDTH) -> str:
    """Return the tables of a comparison and its verdict as plain text.

    Parameters
    ----------
    comparison : Comparison
    width : int
        Columns of the terminal; cells fold where they are too few.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    shares = [
        Measure(f"share_{name}", name, "%", 100.0, decimals=0)
        for name in comparison.problem.candidates
    ]
    measures = (*MEASURES, *shares, COST)
    buffer = io.StringIO()
    console = Console(file=buffer, width=width, color_system=None, highlight=False)
    for scenario in comparison.scenarios:
        table = Table(box=SIMPLE_HEAD, title=shown_scenario(scenario), title_justify="left")
        table.add_column("policy")
        for measure in measures:
            table.add_column(measure.heading, justify="right")
            if measure is RATE:
                table.add_column("is")
        for policy in comparison.policies:
            table.add_row(*_row(comparison, measures, scenario, policy))
        console.print(table)
    lines = [buffer.getvalue().rstrip(), ""]
    lines.append(
        f"Mean over {len(comparison.seeds)} seeds and half of the 95 % interval. Columns "
        f"{', '.join(comparison.problem.candidates)}: share of the windows."
    )
    if any(policy in NAMES for policy in comparison.policies):
        lines.append(REMARK)
    lines += ["", question(comparison), ""]
    for item in verdict(comparison):
        lines.append(
            textwrap.fill(item.replace("`", ""), width, initial_indent="- ", subsequent_indent="  ")
        )
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
