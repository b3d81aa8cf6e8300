"""Page of a capacity: largest number of robots, V_D by number of robots, effects of changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dwell.report.charts import Limit, curves
from dwell.report.figure import Figure
from dwell.report.page import Definitions, Fact, Page, Section
from dwell.report.palette import CIRCLE, INK, SOLID, Style
from dwell.report.table import WITHOUT_WARMUP, Columns, Table, Text, interval_row
from dwell.study.metric import METRICS

if TYPE_CHECKING:
    from dwell.study.capacity import Capacity, CapacityPoint
    from dwell.study.what_ifs import WhatIf

RATE = METRICS["violation_rate"].called("V_D of the worst cell")


def capacity_page(name: str, found: Capacity, what_ifs: Sequence[WhatIf] = ()) -> Page:
    """Return the page of a capacity; `name` is the name of the fleet."""
    low, high = found.interval
    facts = [Fact("robots", written(found), f"[{low}, {high}]")]
    if found.limit_on == "excess":
        facts.append(Fact(f"robots at ≤ {found.limit:.0%}", f"{found.robots_at_limit}"))
    if found.limits is not None:
        limits = found.limits
        used = found.point(found.robots).utilisation.get(limits.name)
        told = "" if used is None else f", busy {used:.0%}"
        facts.append(Fact("what limits", limits.name, f"{limits.share:.0%} of the waiting{told}"))
    blocks: list[Figure | Table | Definitions] = [_figure(found), _assumed(found)]
    sections = [Section("V_D by number of robots", blocks)]
    if what_ifs:
        sections.append(Section("What would change it", [_changes(found, what_ifs)]))
    sections.append(Section("Numbers", [_numbers(found)], folded=True))
    return Page(
        title=f"How many robots: {name}",
        subtitle=f"{found.policy}, phases {found.phases}",
        sections=sections,
        facts=facts,
    )


def written(found: Capacity) -> str:
    """Return the number of robots: ``9``, or ``at least 128``."""
    return f"at least {found.robots}" if found.at_least else str(found.robots)


def answer(found: Capacity) -> str:
    """Return numbers of robots by V_D: ``0 at ≤ 5 %; 9 [8, 9] at ≤ 10.31 % (one alone: …)``."""
    interval = "[{}, {}]".format(*found.interval)
    if found.limit_on == "violation_rate":
        return f"{written(found)} {interval}"
    return (
        f"{found.robots_at_limit} at ≤ {found.limit * 100:g} %; {written(found)} {interval} at ≤ "
        f"{RATE.text(found.bound)} (one alone: {RATE.text(found.alone)})"
    )


def _assumed(found: Capacity) -> Definitions:
    """Return the assumptions, and the meaning of each number."""
    excess = " beyond that of one cell alone" if found.limit_on == "excess" else ""
    entries = {
        "robots": "the largest number such that neither it nor a smaller one is over the limit; in "
        "brackets the same by the ends of the 95 % intervals over seeds",
        **({"errors": errors(found)} if found.phases == "random" else {}),
        "limit": f"{found.limit * 100:g} % of deadlines missed{excess}, by the cell that misses "
        "most; the mean over seeds",
        "phases": PHASES.get(str(found.phases), "as listed"),
        "what limits": "the resource or link for which cycles that missed have waited most, and "
        "its share of their waiting, one robot beyond the limit",
    }
    return Definitions(entries | ({"none": found.reason} if found.reason else {}))


PHASES = {
    "sync": "all cells begin their cycles at one instant",
    "even": "the cells' cycles begin evenly spread over a period",
    "random": "every cell begins anywhere in its period, drawn anew for every seed",
}


def _figure(found: Capacity) -> Figure:
    import polars as pl

    rows = [(found.policy, point.robots, *point.violation_rate) for point in found.curve]
    ends = ("mean", "low", "high")
    frame = pl.DataFrame(rows, schema=["policy", "at", *ends], orient="row")
    frame = frame.with_columns(pl.col(ends).fill_nan(None) * 100)
    limit = Limit(found.bound * 100, f"limit: {RATE.text(found.bound)}")
    return Figure(
        "capacity",
        "V_D of the worst cell by number of robots",
        {"rows": frame},
        curves(frame, RATE, {found.policy: Style(INK, CIRCLE, SOLID)}, "robots", limit),
        "Mean over seeds of the cell that misses most, with its 95 % interval; dashed: the limit.",
    )


def _changes(found: Capacity, what_ifs: Sequence[WhatIf]) -> Table:
    changes = [("as it is", found), *((one.change, one.capacity) for one in what_ifs)]
    rows = [
        {
            "change": change,
            "robots": written(one),
            "interval": f"[{one.interval[0]}, {one.interval[1]}]",
        }
        for change, one in changes
    ]
    columns = [
        Text("change", "change"),
        Text("robots", "robots"),
        Text("interval", "95 % interval"),
    ]
    return Table("changes", "Robots after a change", columns, rows, caption=WITHOUT_WARMUP)


def _numbers(found: Capacity) -> Table:
    rows = [
        {
            "robots": str(point.robots),
            **interval_row({RATE.column: point.violation_rate}),
            "used": busy(point),
        }
        for point in found.curve
    ]
    columns: Columns = [Text("robots", "robots"), RATE, Text("used", "utilisation")]
    return Table("curve", "V_D by number of robots", columns, rows, caption=WITHOUT_WARMUP)


def errors(found: Capacity) -> str:
    """Return the errors of V_D from sampled phases and from simulated cycles, as text."""
    point = found.point(found.robots)
    by_phases, by_cycles = point.phases_error * 100, point.cycles_error * 100
    return f"at {point.robots}: phases ± {by_phases:.2f}, cycles ± {by_cycles:.2f} points of V_D"


def busy(point: CapacityPoint) -> str:
    """Return the utilisation of the shared resources: ``E 9 %, E.gpu 98 %``."""
    return ", ".join(f"{name} {share:.0%}" for name, share in point.utilisation.items())
