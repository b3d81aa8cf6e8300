"""The metrics of a run, each declared once: column, name, unit, format, better direction.

Terminal, pages, tables, intervals and docs use `METRICS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from dwell.display import Measure
from dwell.model.table_columns import (
    AGE_OF,
    OF_CHAINS,
    OVER_AGE_OF,
    REACTION_OF,
    SHARE_OF,
    USE_OF,
)

Better: TypeAlias = Literal["lower", "higher", ""]
#: Values of a column, which determine its interval over seeds: `median` if they may be infinite,
#: `share` in [0, 1], `positive` without negative values.
Values: TypeAlias = Literal["any", "positive", "share", "median"]


@dataclass(frozen=True, slots=True)
class Metric(Measure):
    """A column of a run's summary.

    Parameters
    ----------
    wording : str
        Meaning of `name` if that is a symbol; empty if the name is in words.
    better : {"lower", "higher", ""}
        Better direction, if there is one.
    values : {"any", "positive", "share", "median"}
        Values of the column (see `Values`).
    """

    wording: str = ""
    better: Better = "lower"
    values: Values = "any"

    @property
    def title(self) -> str:
        """Name and wording: ``V_D, deadlines missed``."""
        return f"{self.name}, {self.wording}" if self.wording else self.name


#: Columns with the name of a placement, a resource or a chain in them.
NAMED = (SHARE_OF, USE_OF, *OF_CHAINS)
#: All metrics by column; those of `NAMED` have one column per name.
METRICS: Mapping[str, Metric] = {
    metric.column: metric
    for metric in (
        Metric(
            *("violation_rate", "V_D", "%", 100.0, 2),
            fixed=True,
            wording="deadlines missed",
            values="share",
        ),
        Metric("l95_ms", "L95", "ms", wording="mean of windows", values="positive"),
        Metric("cost", "J", decimals=2, wording="mean of windows", values="positive"),
        Metric(AGE_OF, "age of {chain}", "ms", wording="L95, mean of windows", values="median"),
        Metric(OVER_AGE_OF, "{chain} too old", "%", 100.0, wording="actuations", values="share"),
        Metric(
            *(REACTION_OF, "reaction of {chain}", "ms"),
            wording="L95, mean of windows",
            values="median",
        ),
        Metric("seen_age_ms", "age in J", "ms", wording="mean of windows", values="positive"),
        Metric("seen_price_per_hour", "price of bytes", "/h", decimals=4, values="positive"),
        Metric("nodes_price_per_hour", "price of nodes", "/h", decimals=4, values="positive"),
        Metric("u_robot", "U_r", "%", 100.0, wording="busiest robot", values="positive"),
        Metric("u_edge", "U_e", "%", 100.0, wording="busiest edge node", values="positive"),
        Metric("migrations", "migrations", values="positive"),
        Metric("returns", "moves undone", values="positive"),
        Metric("guard_moves", "moves of the guard"),
        Metric(SHARE_OF, "{candidate}", "%", 100.0, 0, better="", values="share"),
        Metric(USE_OF, "U of {resource}", "%", 100.0),
        Metric("p95_ms", "P95", "ms", ends=True, wording="all cycles", values="median"),
        Metric("p50_ms", "median latency", "ms", ends=True, values="median"),
        Metric("spread_ms", "P95 − median", "ms", ends=True, values="median"),
        Metric("lost", "lost cycles"),
        Metric("in_flight", "unfinished at the end", better=""),
        Metric("compute_ms", "computing", "ms"),
        Metric("queue_ms", "waiting", "ms"),
        Metric("network_ms", "network", "ms"),
        Metric("longest_misses", "longest run of misses"),
        Metric("misses_in_20", "most misses in 20"),
        Metric("misses_in_100", "most misses in 100"),
        Metric("over_1_in_20", "20 with more than 1", "%", 100.0, values="share"),
        Metric("over_5_in_100", "100 with more than 5", "%", 100.0, values="share"),
        Metric("aoi_mean_ms", "mean age", "ms", wording="at the actuator"),
        Metric("aoi_p95_ms", "age in 95 % of the time", "ms", wording="at the actuator"),
        Metric("aoi_peak_ms", "largest age", "ms", wording="at the actuator"),
        Metric("aoi_mean_peak_ms", "mean peak age", "ms", wording="at the actuator"),
        Metric("tracking_rms_mm", "tracking error, RMS", "mm", decimals=2, values="median"),
        Metric("tracking_iae_mm", "tracking error, mean", "mm", decimals=2, values="median"),
        # Of runs that are compared with references.
        Metric("reference_cost", "J of the reference", decimals=2),
        Metric("regret", "regret", "%", 100.0),
        Metric("oracle_regret", "over oracle", "%", 100.0),
        Metric("share_kept", "windows kept", "%", 100.0, better="higher", values="share"),
        # Of fleets.
        Metric("mean_violation_rate", "mean V_D", "%", 100.0, 2, fixed=True),
        # Of studies that price moves afterwards.
        Metric("moved", "tasks moved", values="positive"),
        Metric("j_still", "J without moves", decimals=2, values="positive"),
    )
}


def further_columns(chains: Iterable[str]) -> list[str]:
    """Return the columns of ages and prices, which only some cells have."""
    ages = [of.format(chain=name) for name in chains for of in OF_CHAINS]
    return [*ages, "seen_age_ms", "seen_price_per_hour", "nodes_price_per_hour"]


def declared(column: str) -> Metric | None:
    """Return the declaration of a column, None for a user's own metric."""
    if column in METRICS:
        return METRICS[column]
    for named in NAMED:
        head = named.partition("{")[0]
        if column.startswith(head):
            name = column.removeprefix(head)
            metric = METRICS[named]
            called = metric.name.format(candidate=name, resource=name, chain=name)
            return metric.called(called, column)
    return None


def metric_of(column: str) -> Metric:
    """Return the metric of a column; a user's own metric has two decimals and no unit."""
    return declared(column) or Metric(column, column, decimals=2, better="")
