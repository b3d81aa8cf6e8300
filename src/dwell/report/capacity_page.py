"""The page of a capacity: how many robots there may be, V_D by their number, what would help."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dwell.report.charts import Limit, curves
from dwell.report.figure import Figure
from dwell.report.formatting import Measure
from dwell.report.page import Definitions, Fact, Page, Section
from dwell.report.palette import CIRCLE, INK, SOLID, Style
from dwell.report.table import Table, Text, interval_row

if TYPE_CHECKING:
    from dwell.study.capacity import Capacity, WhatIf

RATE = Measure("violation_rate", "V_D of the worst cell", "%", 100.0, decimals=2)


def capacity_page(name: str, found: Capacity, what_ifs: Sequence[WhatIf] = ()) -> Page:
    """Return what there is to show of a capacity.

    Parameters
    ----------
    name : str
        The fleet's.
    """
    low, high = found.interval
    facts = [Fact("robots", written(found), f"[{low}, {high}]")]
    if found.limits is not None:
        limits = found.limits
        facts.append(Fact("what limits", f"{limits.kind} {limits.name}", f"{limits.share:.0%}"))
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


def _assumed(found: Capacity) -> Definitions:
    """Return what was assumed, and what each number is."""
    excess = " beyond that of one cell alone" if found.limit_on == "excess" else ""
    entries = {
        "robots": "the largest number such that neither it nor a smaller one is over the limit; in "
        "brackets the same by the ends of the 95 % intervals over seeds",
        "limit": f"{found.limit * 100:g} % of deadlines missed{excess}, by the cell that misses "
        "most; the mean over seeds",
        "phases": PHASES.get(str(found.phases), "as listed"),
        "what limits": "the node or link that cycles which missed have waited for most, and its "
        "share of all that they waited, one robot beyond the limit",
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
    limit = Limit(found.bound * 100, f"limit: {found.bound * 100:.3g} %")
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
    return Table("changes", "Robots after a change", columns, rows)


def _numbers(found: Capacity) -> Table:
    rows = [
        {"robots": str(point.robots), **interval_row({RATE.column: point.violation_rate})}
        for point in found.curve
    ]
    return Table("curve", "V_D by number of robots", [Text("robots", "robots"), RATE], rows)
