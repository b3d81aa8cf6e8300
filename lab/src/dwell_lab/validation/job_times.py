"""Times of jobs on each node and of messages on each link, measured and predicted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.model import Problem
from dwell.model.number_arrays import Floats
from dwell.model.order_statistic import percentile
from dwell.study.intervals import Interval, mean_interval
from dwell.study.summary import count_in

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run


BASELINE = "baseline"
ENDS = ("", "_low", "_high", "_p5", "_p50", "_p95")
#: Points of a distribution of delays.
POINTS = 101
#: Values of a process that its 95th percentile is taken from.
DRAWN = 20_000
TIMES = ("measured", "predicted", "core", "cell")


def jobs_of(run: Run, scenario: str, policy: str, number: int) -> pl.DataFrame:
    """Return the finished jobs of the counted cycles, without shadows.

    Parameters
    ----------
    run : Run
        With its jobs.
    number : int
        Tells the run from others.

    Returns
    -------
    DataFrame
        ``cycle``, ``task``, ``node``, ``ready_ns``, ``start_ns``, ``end_ns``, ``cpu_ns`` where it
        was measured; ``scenario``, ``policy``, ``run``.
    """
    import polars as pl

    first = int(run.windows.filter(~pl.col("warmup"))["first_cycle"][0])
    last = int(run.cycles["cycle"][run.last_window_end - 1])
    jobs = run.jobs.filter(pl.col("cycle").is_between(first, last))
    if "shadow" in jobs.columns:
        jobs = jobs.filter(~pl.col("shadow"))
    columns = ["cycle", "task", "node", "ready_ns", "start_ns", "end_ns"]
    columns += ["cpu_ns"] if "cpu_ns" in jobs.columns else []
    return jobs.filter(pl.col("outcome").cast(pl.String) == "done").select(
        *(pl.col(name).cast(pl.String) if name in ("task", "node") else name for name in columns),
        scenario=pl.lit(scenario),
        policy=pl.lit(policy),
        run=pl.lit(number),
    )


def profiles_of(jobs: pl.DataFrame | None, problem: Problem) -> pl.DataFrame:
    """Return the times of each task's jobs on each node in the baseline.

    Parameters
    ----------
    jobs : DataFrame or None
        Jobs of all runs; None if no run kept them.

    Returns
    -------
    DataFrame
        ``task``, ``node``, ``jobs``, ``runs``; ``wall_ms`` from start to end, and ``cpu_ms``, the
        core time (null if it was not measured): each the mean over runs of their means, with its
        interval (``_low``, ``_high``), and ``_p5``, ``_p50``, ``_p95`` of all jobs; ``told_ms``,
        the mean in the cell file.
    """
    import polars as pl

    rows: list[dict[str, object]] = []
    if jobs is not None:
        baseline = jobs.filter(pl.col("scenario") == BASELINE)
        for task in problem.pipeline.tasks:
            for node in problem.fabric.nodes:
                here = baseline.filter(task=task, node=node)
                if here.is_empty():
                    continue
                here = here.with_columns(wall_ns=pl.col("end_ns") - pl.col("start_ns"))
                on = problem.pipeline.tasks[task].on.get(node)
                row: dict[str, object] = {"task": task, "node": node, "jobs": here.height}
                row |= {"runs": here["run"].n_unique(), **_spread(here, "wall")}
                row |= _spread(here, "cpu") if "cpu_ns" in here.columns else {}
                row["told_ms"] = None if on is None else float(on.exec_ms.expectation)
                rows.append(row)
    names = [f"{kind}_ms{end}" for kind in ("wall", "cpu") for end in ENDS]
    schema = {"task": pl.String(), "node": pl.String(), "jobs": pl.Int64(), "runs": pl.Int64()}
    schema |= {name: pl.Float64() for name in (*names, "told_ms")}
    return pl.DataFrame(rows, schema=schema).fill_nan(None)


def _spread(jobs: pl.DataFrame, kind: str) -> dict[str, float | None]:
    """Return the mean over runs with its interval, and percentiles of job times, milliseconds."""
    import polars as pl

    known = jobs.filter(pl.col(f"{kind}_ns").is_not_null())
    if known.is_empty():
        return {f"{kind}_ms{end}": None for end in ENDS}
    taken_ms = (known[f"{kind}_ns"] / 1e6).to_numpy()
    means = known.group_by("run").agg(pl.col(f"{kind}_ns").mean()).sort("run")
    over: Interval = mean_interval((means[f"{kind}_ns"] / 1e6).to_numpy())
    ranked = [percentile(taken_ms, percent) for percent in (5, 50, 95)]
    values: Sequence[float] = (*over, *ranked)
    return dict(zip((f"{kind}_ms{end}" for end in ENDS), values, strict=True))


def links_of(jobs: pl.DataFrame | None, problem: Problem) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return delays of messages, from the end of the sending job to the arrival.

    Only flows into tasks with one input count: with several inputs only the last arrival is known.

    Returns
    -------
    table : DataFrame
        ``scenario``, ``link``, ``flow``, ``messages``, ``mean_ms``, ``std_ms``, ``p50_ms``,
        ``p95_ms``.
    distribution : DataFrame
        ``scenario``, ``link``, ``delay_ms``, ``share`` within it.
    """
    import polars as pl

    inputs = [flow.target for flow in problem.pipeline.flows]
    flows = [flow for flow in problem.pipeline.flows if inputs.count(flow.target) == 1]
    text, keys = ("scenario", "link", "flow"), ["run", "scenario", "cycle"]
    sent = [
        jobs.filter(pl.col("task") == flow.source)
        .select(*keys, "end_ns", source="node")
        .join(
            jobs.filter(pl.col("task") == flow.target).select(*keys, "ready_ns", target="node"),
            on=keys,
        )
        .filter(pl.col("source") != pl.col("target"))
        .select(
            "scenario",
            link=pl.col("source") + "->" + pl.col("target"),
            flow=pl.lit(f"{flow.source} to {flow.target}"),
            took_ms=(pl.col("ready_ns") - pl.col("end_ns")) / 1e6,
        )
        for flow in flows
        if jobs is not None
    ]
    none = pl.DataFrame(schema=dict.fromkeys(text, pl.String) | {"took_ms": pl.Float64})
    every = pl.concat([none, *sent])
    took = pl.col("took_ms")
    table = every.group_by(*text, maintain_order=True).agg(
        messages=pl.len().cast(pl.Int64),
        mean_ms=took.mean(),
        std_ms=took.std(),
        p50_ms=took.median(),
        p95_ms=took.quantile(0.95, "higher"),
    )
    # The scenarios as they come; by name within.
    scenarios = list(every["scenario"].unique(maintain_order=True))
    order = pl.col("scenario").replace_strict(scenarios, list(range(len(scenarios))))
    return table.sort(order, "link", "flow"), _shares(every.sort(order, "link"))


def _shares(sent: pl.DataFrame) -> pl.DataFrame:
    """Distribution of delays by scenario and link, at evenly spaced shares."""
    import polars as pl

    shares = np.linspace(0, 1, POINTS)
    names, numbers = ("scenario", "link"), ("delay_ms", "share")
    schema = dict.fromkeys(names, pl.String) | dict.fromkeys(numbers, pl.Float64)
    parts = [pl.DataFrame(schema=schema)]
    for (scenario, link), mine in sent.group_by("scenario", "link", maintain_order=True):
        delays_ms = np.quantile(mine["took_ms"].to_numpy(), shares, method="higher")
        parts.append(
            pl.DataFrame({"delay_ms": delays_ms, "share": shares}).select(
                pl.lit(scenario).alias("scenario"), pl.lit(link).alias("link"), pl.all()
            )
        )
    return pl.concat(parts)


# ------------------------------------------------------------------------ beside predictions


def job_times(
    scenario: str,
    policy: str,
    problem: Problem,
    measured: Sequence[pl.DataFrame],
    predicted: Sequence[pl.DataFrame],
) -> pl.DataFrame:
    """Return the times of the jobs of a group.

    Parameters
    ----------
    measured, predicted : sequence of DataFrame
        Tables of `finished_jobs`: of the runs that kept their jobs, and of their simulations.

    Returns
    -------
    DataFrame
        See `dwell_lab.validation.validation.Validation.jobs`; no row where no run kept its jobs.
    """
    import polars as pl

    schema = {
        **dict.fromkeys(("scenario", "policy", "task", "node"), pl.String),
        "jobs": pl.Int64,
        **{column: pl.Float64 for name in TIMES for column in (f"{name}_ms", f"{name}_p95_ms")},
    }
    if not measured:
        return pl.DataFrame(schema=schema)
    seen = pl.concat(measured, how="diagonal_relaxed")
    simulated = pl.concat(predicted, how="diagonal_relaxed")
    rows = []
    for task in problem.pipeline.tasks.values():
        for node in task.on:
            here, there = (jobs.filter(task=task.name, node=node) for jobs in (seen, simulated))
            if here.is_empty():
                continue
            rows.append(
                {
                    "scenario": scenario,
                    "policy": policy,
                    "task": task.name,
                    "node": node,
                    "jobs": here.height,
                    **_times("measured", here["wall_ns"].to_numpy()),
                    **_times("predicted", there["wall_ns"].to_numpy()),
                    **_times("core", here["cpu_ns"].drop_nulls().to_numpy()),
                    **_times("cell", _drawn(problem, task.name, node) * 1e6),
                }
            )
    return pl.DataFrame(rows, schema=schema)


def finished_jobs(run: Run, window_cycles: int) -> pl.DataFrame:
    """Return the jobs of a run that finished, of cycles after the warm-up.

    Parameters
    ----------
    run : Run
        That kept its jobs.
    window_cycles : int
        W.

    Returns
    -------
    DataFrame
        ``task``, ``node``, ``wall_ns`` from start to end, and ``cpu_ns``, null where the run does
        not know it.
    """
    import polars as pl

    cycles = count_in(run, window_cycles).cycles["cycle"]
    jobs = run.jobs.with_columns(pl.col("task", "node", "outcome").cast(pl.String))
    known = pl.col("cpu_ns") if "cpu_ns" in jobs.columns else pl.lit(None)
    return jobs.filter(
        pl.col("start_ns").is_not_null()
        & pl.col("end_ns").is_not_null()
        & (pl.col("outcome") == "done")
        & pl.col("cycle").is_between(cycles[0], cycles[-1])
    ).select(
        "task",
        "node",
        wall_ns=pl.col("end_ns") - pl.col("start_ns"),
        cpu_ns=known.cast(pl.Float64),
    )


def _drawn(problem: Problem, task: str, node: str) -> Floats:
    """Execution times of a job, drawn from the cell file (ms)."""
    rng = np.random.default_rng(1)
    one = problem.pipeline.tasks[task]
    values = one.on[node].exec_ms.marginal(rng, DRAWN)
    if one.scale is None:
        return values
    scaled: Floats = values * problem.pipeline.scales[one.scale].marginal(rng, DRAWN)
    return scaled


def _times(name: str, values_ns: Iterable[float]) -> dict[str, float | None]:
    values_ms = np.asarray(values_ns, np.float64) / 1e6
    if not len(values_ms):
        return {f"{name}_ms": None, f"{name}_p95_ms": None}
    return {
        f"{name}_ms": float(values_ms.mean()),
        f"{name}_p95_ms": percentile(values_ms, 95),
    }
