"""What a validation comes to, in sentences: the same on the page and on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dwell.report.formatting import (
    listed,
    percent,
    shown_contender,
    shown_in_sentence,
    write_number,
)
from dwell.study.judged_prediction import ORDER, Judged, Outcome
from dwell.study.validation import GOALS, LEAST_MINUTES, Group, Validation

__all__ = ["GOAL_NAMES", "group_name", "remarks", "totals", "worst_use"]

GOAL_NAMES = {
    "l95_ms": "L95 within 10 %",
    "violation_rate": "V_D within 2 percentage points, or explained",
    "utilisation": "U of every node within 5 percentage points",
    "dominant": "the same dominant placement",
    "sum_of_means": "better than the sum of means",
}


def group_name(group: Group) -> str:
    """``LOC in robot CPU stress``."""
    return f"{shown_contender(group.policy)} in {shown_in_sentence(group.scenario)}"


def totals(validation: Validation) -> Iterator[tuple[str, Outcome, str]]:
    """Yield each goal, its verdict over all groups, and in how many groups it was what."""
    for goal in GOALS:
        found = [group.verdict(goal) for group in validation.groups]
        counts = [
            f"{found.count(verdict)} {verdict}" for verdict in ORDER if verdict and verdict in found
        ]
        yield goal, validation.verdict(goal), f"of {len(found)}: {listed(counts)}"


def worst_use(group: Group) -> tuple[str, Judged]:
    """Return the node whose utilisation is predicted worst, and what was found there."""
    uses = group.uses
    node = max(uses, key=lambda name: _rank(uses[name]))
    return node, uses[node]


def _rank(one: Judged) -> tuple[int, float]:
    error = abs(one.error.value)
    return ORDER.index(one.verdict), error if math.isfinite(error) else -1.0


def remarks(validation: Validation) -> Iterator[str]:
    """Yield what is missed or explained, group by group, and what limits the verdicts."""
    for group in validation.groups:
        for text in (*_missed(group), *_explained(group)):
            yield f"{group_name(group)}: {text}"
    short = [
        f"{group_name(group)} ({write_number(group.minutes)})"
        for group in validation.groups
        if group.short
    ]
    if short:
        yield (
            f"Less than {LEAST_MINUTES:g} minutes were measured (minutes in brackets) of "
            f"{listed(short)}: verdicts on so little say little."
        )
    excluded = sum(group.excluded for group in validation.groups)
    if excluded:
        windows = excluded + sum(group.measured.windows for group in validation.groups)
        yield (
            f"{excluded} of {windows} windows are left out, for reasons their runs give; under "
            "policies that move, so are those after them in which what was decided on them holds."
        )


def _missed(group: Group) -> Iterator[str]:
    l95, rate = group.figures["l95_ms"], group.figures["violation_rate"]
    if l95.verdict == "missed":
        low, high = (_signed(100 * end) for end in (l95.error.low, l95.error.high))
        yield (
            f"L95 is predicted as {write_number(l95.predicted.value)} ms, and was "
            f"{write_number(l95.measured.value)} ms, an error of "
            f"{_signed(100 * l95.error.value)} % [{low}, {high}]; {_cause(group)}."
        )
    if rate.verdict == "missed":
        yield (
            f"V_D is predicted as {percent(rate.predicted.value, 1)}, and was "
            f"{percent(rate.measured.value, 1)}{_factor(group)}."
        )
    for node, one in group.uses.items():
        if one.verdict == "missed":
            yield (
                f"U of {node} is predicted as {percent(one.predicted.value)}, and was "
                f"{percent(one.measured.value)}."
            )
    if group.verdict("dominant") == "missed":
        yield f"the dominant placement is {group.figures['dominant'].note}."
    if group.verdict("sum_of_means") == "missed":
        yield "the sum of means is nearer to what was measured."


def _cause(group: Group) -> str:
    """Say in which part of the latency measured and predicted means differ most."""
    names = {"compute": "computing", "queue": "waiting", "network": "network"}
    off = {
        name: group.predicted.parts_ms[part] - group.measured.parts_ms[part]
        for part, name in names.items()
    }
    known = {name: value for name, value in off.items() if math.isfinite(value)}
    if not known:
        return "no cycle finished"
    most = max(known, key=lambda name: abs(known[name]))
    return f"of the parts {most} is farthest off, by {_signed(known[most], 2)} ms in the mean"


def _explained(group: Group) -> Iterator[str]:
    rate = group.figures["violation_rate"]
    if rate.verdict == "explained":
        low, high = group.allowed_rates
        yield (
            f"V_D is predicted as {percent(rate.predicted.value, 1)}, and was "
            f"{percent(rate.measured.value, 1)}, which is explained: "
            f"{percent(group.predicted.share_near(0.1))} of the predicted latencies lie within "
            f"10 % of the deadline, so that the error L95 is allowed means a V_D of "
            f"{percent(low, 1)} to {percent(high, 1)}{_factor(group)}."
        )


def _factor(group: Group) -> str:
    if not math.isfinite(group.factor):
        return ""
    change = 100 * (group.factor - 1)
    longer = "longer" if change >= 0 else "shorter"
    return (
        f"; latencies {write_number(abs(change), 1)} % {longer} than predicted would give what "
        "was measured"
    )


def _signed(value: float, decimals: int = 1) -> str:
    return write_number(value, decimals, signed=True)
