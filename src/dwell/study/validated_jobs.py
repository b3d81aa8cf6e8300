"""Times of jobs, measured and predicted, by task and node: where a prediction goes wrong."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.study.summary import count_in, order_statistic

if TYPE_CHECKING:
    import polars as pl

    from dwell.model import Problem
    from dwell.record import Run

__all__ = ["finished_jobs", "job_times"]

Floats: TypeAlias = NDArray[np.float64]

#: Values of a process that its 95th percentile is taken from.
DRAWN = 20_000
TIMES = ("measured", "predicted", "core", "cell")


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
        What `finished_jobs` gives of the runs that kept their jobs, and of simulations of them.

    Returns
    -------
    DataFrame
        See `dwell.study.validation.Validation.jobs`; no row where no run kept its jobs.
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
    said = pl.concat(predicted, how="diagonal_relaxed")
    rows = []
    for task in problem.pipeline.tasks.values():
        for node in task.on:
            here = (pl.col("task") == task.name) & (pl.col("node") == node)
            mine, theirs = seen.filter(here), said.filter(here)
            if mine.is_empty():
                continue
            rows.append(
                {
                    "scenario": scenario,
                    "policy": policy,
                    "task": task.name,
                    "node": node,
                    "jobs": mine.height,
                    **_times("measured", mine["wall_ns"].to_numpy()),
                    **_times("predicted", theirs["wall_ns"].to_numpy()),
                    **_times("core", mine["cpu_ns"].drop_nulls().to_numpy()),
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
    """Execution times that the cell says a job has (ms)."""
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
        f"{name}_p95_ms": order_statistic(values_ms, 95),
    }
