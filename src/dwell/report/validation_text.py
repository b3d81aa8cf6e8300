"""A validation as text for the terminal, at most 100 columns wide."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from dwell.report.formatting import shown_contender, shown_scenario, write_number
from dwell.report.validation_findings import GOAL_NAMES, remarks, totals, worst_use
from dwell.study.judged_prediction import Outcome
from dwell.study.validation import Group, Validation

__all__ = ["validation_text"]

WIDTH = 100
# Of names of policies; longer ones go on in the next line.
NAME = 15
HEAD = ("policy", "min", "L95 ms", "pred.", "", "V_D %", "pred.", "", "U off", "", "placed", "sum")
SHORT: dict[Outcome, str] = {"explained": "expl."}
LEFT = {0, 4, 7, 9, 10, 11}


def validation_text(validation: Validation) -> str:
    """Return the verdicts of a validation, its numbers, and what is to be said of them."""
    runs = sum(len(group.runs) for group in validation.groups)
    lines = [
        f"{validation.problem.name}: {runs} run{'' if runs == 1 else 's'}, each simulated "
        f"{validation.seeds} times",
        "",
        *_tables(validation),
        "L95: 95th percentile of all cycles. U off: error of the node predicted worst, in points.",
        "placed: the same dominant placement. sum: nearer to what was measured than the sum of "
        "means.",
        "",
    ]
    width = max(map(len, GOAL_NAMES.values()))
    lines += [
        f"{GOAL_NAMES[goal].ljust(width)}  {verdict.ljust(9)}  {counts}"
        for goal, verdict, counts in totals(validation)
    ]
    prose = textwrap.TextWrapper(
        WIDTH, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False
    )
    told = [prose.fill(text) for text in remarks(validation)]
    return "\n".join([*lines, *(["", *told] if told else [])]) + "\n"


def _tables(validation: Validation) -> Iterator[str]:
    scenarios = list(dict.fromkeys(group.scenario for group in validation.groups))
    rows = {
        name: [
            line for group in validation.groups if group.scenario == name for line in _lines(group)
        ]
        for name in scenarios
    }
    every = [HEAD, *(line for lines in rows.values() for line in lines)]
    widths = [max(len(line[i]) for line in every) for i in range(len(HEAD))]
    for name, lines in rows.items():
        yield shown_scenario(name)
        yield from (_aligned(line, widths) for line in (HEAD, *lines))
        yield ""


def _aligned(line: Sequence[str], widths: Sequence[int]) -> str:
    cells = []
    for i, (text, width) in enumerate(zip(line, widths, strict=True)):
        # A verdict stands close to the number that it is about.
        gap = "" if i == 0 else " " if i in LEFT and i < 10 else "  "
        cells.append(gap + (text.ljust(width) if i in LEFT else text.rjust(width)))
    return "".join(cells).rstrip()


def _lines(group: Group) -> Iterator[tuple[str, ...]]:
    names = textwrap.wrap(shown_contender(group.policy), NAME) or [""]
    l95, rate = group.figures["l95_ms"], group.figures["violation_rate"]
    _, use = worst_use(group)
    yield (
        names[0],
        write_number(group.minutes),
        write_number(l95.measured.value),
        write_number(l95.predicted.value),
        _short(l95.verdict),
        write_number(100 * rate.measured.value),
        write_number(100 * rate.predicted.value),
        _short(rate.verdict),
        write_number(100 * use.error.value, signed=True),
        _short(group.verdict("utilisation")),
        _short(group.verdict("dominant")),
        _short(group.verdict("sum_of_means")),
    )
    for name in names[1:]:
        yield (f"  {name}", *[""] * (len(HEAD) - 1))


def _short(verdict: Outcome) -> str:
    return SHORT.get(verdict, verdict)
