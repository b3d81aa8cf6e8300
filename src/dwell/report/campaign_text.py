"""A campaign on the terminal: one line a policy and scenario, and what is answered."""

from __future__ import annotations

import textwrap

from dwell.report.campaign_page import counted_windows
from dwell.report.contenders import palette_of
from dwell.report.formatting import (
    OURS,
    Measure,
    shown_contender,
    shown_scenario,
    write_interval,
)
from dwell.report.style import PageStyle
from dwell.study.campaign_questions import questions
from dwell.study.measured_campaign import MeasuredCampaign

__all__ = ["campaign_text"]

WIDTH = 100
MEASURES = (
    Measure("violation_rate", "V_D %", "", 100.0, ends=True),
    Measure("l95_ms", "L95 ms"),
    Measure("u_robot", "U_r %", "", 100.0),
    Measure("u_edge", "U_e %", "", 100.0),
    Measure("migrations", "moves"),
)


def campaign_text(measured: MeasuredCampaign) -> str:
    """Return the results of a campaign as plain text of at most 100 columns."""
    comparison = measured.comparison
    look = PageStyle(
        palette_of(comparison.problem, comparison.policies), frozenset(comparison.scenarios)
    )
    head = ["", "runs", *(measure.heading for measure in MEASURES)]
    groups = {scenario: _rows(measured, scenario) for scenario in comparison.scenarios}
    rows = [row for group in groups.values() for row in group]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for scenario, group in groups.items():
        lines += [shown_scenario(scenario)]
        lines += [_line(row, widths) for row in (head, *group)] + [""]
    fill = textwrap.TextWrapper(WIDTH, break_on_hyphens=False).fill
    repetitions = len(comparison.seeds)
    note = f"Means over {repetitions} repetitions; ± the larger half of the 95 % interval."
    if repetitions == 1:
        note = "One repetition: no intervals."
    atp = any(name.partition("+")[0] == "atp" for name in comparison.policies)
    lines += [fill(f"{note} {OURS}" if atp else note), fill(counted_windows(measured))]
    for chapter in questions(measured):
        text = look.prose(f"{chapter.title} {chapter.answer.capitalize()}. {chapter.verdict}")
        lines += ["", fill(text)]
    return "\n".join(line.rstrip() for line in lines)


def _rows(measured: MeasuredCampaign, scenario: str) -> list[list[str]]:
    comparison = measured.comparison
    rows = []
    for policy in comparison.policies:
        count = len(comparison.values(scenario, policy, "cost"))
        if not count:
            continue
        row = [shown_contender(policy), str(count)]
        for measure in MEASURES:
            interval = comparison.interval(scenario, policy, measure.column)
            row.append(str(write_interval(interval, measure, larger_half=True)))
        rows.append([cell.replace("± ", "±") for cell in row])
    return rows


def _line(row: list[str], widths: list[int]) -> str:
    first, *rest = zip(row, widths, strict=True)
    cells = [f"  {first[0].ljust(first[1])}", *(text.rjust(width) for text, width in rest)]
    return "  ".join(cells)
