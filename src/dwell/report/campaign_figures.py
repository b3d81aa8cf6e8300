"""Figures and tables of a campaign: what was measured, as data for the drawings of the studies."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from dwell.report.scales import is_wide
from dwell.study import AIM
from dwell.study.chapter import Figure, Table, Unit
from dwell.study.measured_campaign import MeasuredCampaign

if TYPE_CHECKING:
    import polars as pl

__all__ = [
    "delays_figure",
    "failed_table",
    "links_table",
    "log_table",
    "measures_figure",
    "profiles_figure",
    "profiles_table",
    "window_figures",
]

#: What is shown of every policy and scenario: its name, its unit, and the line to be under.
MEASURES: dict[str, tuple[str, Unit]] = {
    "violation_rate": ("V_D", "percent"),
    "l95_ms": ("L95", "ms"),
    "u_robot": ("U_r", "percent"),
    "u_edge": ("U_e", "percent"),
}
#: Points of a distribution over windows.
POINTS = 200
#: An axis of latencies ends after so many deadlines.
DEADLINES = 4


def measures_figure(measured: MeasuredCampaign, measure: str) -> Figure:
    """Return one measure of every policy and scenario, with its interval over repetitions."""
    import polars as pl

    comparison = measured.comparison
    name, unit = MEASURES[measure]
    limits = {
        "violation_rate": (AIM, "the aim, 5 %"),
        "l95_ms": (comparison.problem.pipeline.deadline_ms, "the deadline"),
    }
    limit, called = limits.get(measure, (None, ""))
    rows = [
        (scenario, policy, *comparison.interval(scenario, policy, measure))
        for scenario in comparison.scenarios
        for policy in comparison.policies
        if len(comparison.values(scenario, policy, measure))
    ]
    columns = ["scenario", "policy", "y", "y_low", "y_high"]
    return Figure(
        slug=f"measured-{measure}",
        title=f"{name} by scenario and policy",
        kind="intervals",
        frame=pl.DataFrame(rows, schema=columns, orient="row").fill_nan(None),
        x="policy",
        y="y",
        series="policy",
        facet="scenario",
        y_label=name,
        y_unit=unit,
        line_at=limit,
        line_label=called,
        log_y=unit == "ms" and is_wide([row[2] for row in rows if row[2] > 0]),
    )


def window_figures(measured: MeasuredCampaign) -> Iterator[Figure]:
    """Yield the empirical distributions over windows of every measure, a panel a scenario."""
    deadline_ms = measured.comparison.problem.pipeline.deadline_ms
    for measure, (name, unit) in MEASURES.items():
        sign = "ms" if unit == "ms" else "%"
        yield Figure(
            slug=f"windows-{measure}",
            title=f"Windows by their {name}",
            kind="lines",
            frame=_within(measured, measure, 100.0 if unit == "percent" else 1.0),
            x="x",
            y="share",
            series="policy",
            facet="scenario",
            x_label=f"{name} of a window ({sign})"
            + (f"; D is {deadline_ms:g} ms" if measure == "l95_ms" else ""),
            y_label="windows at or below",
            y_unit="percent",
        )


def _within(measured: MeasuredCampaign, measure: str, factor: float) -> pl.DataFrame:
    """Return steps of the distributions of a measure over windows."""
    import polars as pl

    comparison = measured.comparison
    every = measured.windows[measure].to_numpy() * factor
    high = float(every.max())
    if measure == "l95_ms":
        high = min(high, DEADLINES * comparison.problem.pipeline.deadline_ms)
    across = np.linspace(0.0, high or 1.0, POINTS)
    parts = []
    for scenario in comparison.scenarios:
        here = measured.windows.filter(pl.col("scenario") == scenario)
        for policy in comparison.policies:
            mine = here.filter(pl.col("policy") == policy)[measure].to_numpy() * factor
            if len(mine):
                share = np.searchsorted(np.sort(mine), across + 1e-9, side="right") / len(mine)
                parts.append(
                    pl.DataFrame({"x": across, "share": share}).select(
                        pl.lit(scenario).alias("scenario"),
                        pl.lit(policy).alias("policy"),
                        pl.all(),
                    )
                )
    return pl.concat(parts)


# ---------------------------------------------------------------------- profiles and links


def profiles_figure(measured: MeasuredCampaign) -> Figure:
    """Return what the jobs of each task took on each node in the baseline: 5 % to 95 % of them."""
    import polars as pl

    rows = []
    for row in measured.profiles.to_dicts():
        where = f"{row['task']} on {row['node']}"
        for kind, called in (("wall", "start to end"), ("cpu", "core time")):
            if row[f"{kind}_ms"] is not None:
                ends = (row[f"{kind}_ms{end}"] for end in ("_p50", "_p5", "_p95"))
                rows.append((where, called, *ends))
    columns = ["job", "time", "y", "y_low", "y_high"]
    return Figure(
        slug="profiles",
        title="What jobs took where nothing was disturbed",
        kind="intervals",
        frame=pl.DataFrame(rows, schema=columns, orient="row"),
        x="job",
        y="y",
        series="time",
        y_label="time of a job",
        y_unit="ms",
        note="Median of all jobs in the baseline after the warm-up; the bars hold 90 % of them.",
    )


def profiles_table(measured: MeasuredCampaign) -> Table:
    """Return c_v(n): every task and node, beside what the cell says."""
    kinds: dict[str, Unit] = {"task": "text", "node": "text", "jobs": "count", "runs": "count"}
    times = ("cpu", "wall") if measured.profiles["cpu_ms"].is_not_null().any() else ("wall",)
    called = {"cpu": "core time", "wall": "start to end"}
    headings = {"told_ms": "the cell says (ms)"}
    for kind in times:
        kinds |= {f"{kind}_ms": "ms", f"{kind}_ms_p50": "ms", f"{kind}_ms_p95": "ms"}
        headings |= {
            f"{kind}_ms": f"{called[kind]}, mean (ms)",
            f"{kind}_ms_p50": "median (ms)",
            f"{kind}_ms_p95": "95 % (ms)",
        }
    return Table(
        slug="profiles",
        title="Compute profiles",
        frame=measured.profiles,
        units={**kinds, "told_ms": "ms"},
        headings=headings,
        note=(
            "Jobs of the baseline after the warm-up, those of shadows left out. Means over runs "
            "with 95 % intervals; percentiles of all jobs together. Under a quota, a job takes "
            "longer from start to end than its core time."
        ),
    )


def links_table(measured: MeasuredCampaign) -> Table:
    """Return what messages took, by scenario, link and flow."""
    return Table(
        slug="links",
        title="Link delays",
        frame=measured.links,
        units={
            "scenario": "text",
            "link": "text",
            "flow": "text",
            "messages": "count",
            "mean_ms": "ms",
            "std_ms": "ms",
            "p50_ms": "ms",
            "p95_ms": "ms",
        },
        headings={
            "mean_ms": "mean (ms)",
            "std_ms": "std (ms)",
            "p50_ms": "median (ms)",
            "p95_ms": "95 % (ms)",
        },
        note=(
            "From the end of the job that sent a message until it was there: delay, transmission "
            "and what the sender's and the receiver's processes add, by the clocks of both nodes. "
            "All policies together; messages that were lost are not in it."
        ),
    )


def delays_figure(measured: MeasuredCampaign) -> Figure:
    """Return the distributions of what messages took, a panel a scenario."""
    return Figure(
        slug="delays",
        title="Link delays by scenario",
        kind="lines",
        frame=measured.delays,
        x="delay_ms",
        y="share",
        series="link",
        facet="scenario",
        x_label="what a message took (ms)",
        y_label="messages within",
        y_unit="percent",
        note="All flows that cross a link together.",
    )


# ------------------------------------------------------------------------------- the record


def log_table(measured: MeasuredCampaign) -> Table:
    """Return what was run when."""
    import polars as pl

    begun = [
        datetime.fromtimestamp(value, UTC).strftime("%Y-%m-%d %H:%M:%S")
        for value in measured.log["began_unix_s"]
    ]
    frame = measured.log.with_columns(
        begun=pl.Series(begun, dtype=pl.String),
        idle=pl.when("idle").then(pl.lit("yes")).otherwise(pl.lit("no")),
        excluded=pl.col("excluded").cast(pl.String) + " of " + pl.col("windows").cast(pl.String),
        place=pl.col("place").cast(pl.String),
    )
    return Table(
        slug="log",
        title="What was run when",
        frame=frame,
        units={
            "place": "text",
            "begun": "text",
            "repetition": "count",
            "scenario": "text",
            "policy": "text",
            "attempt": "count",
            "idle": "text",
            "waited_s": "number",
            "excluded": "text",
        },
        headings={
            "place": "run",
            "begun": "begun (UTC)",
            "idle": "machine idle before",
            "waited_s": "waited for that (s)",
            "excluded": "windows excluded",
        },
    )


def failed_table(measured: MeasuredCampaign) -> Table:
    """Return the attempts that failed."""
    return Table(
        slug="failed",
        title="Attempts that failed",
        frame=measured.failed,
        units={
            "scenario": "text",
            "policy": "text",
            "repetition": "count",
            "attempt": "count",
            "outcome": "text",
            "reason": "text",
        },
    )
