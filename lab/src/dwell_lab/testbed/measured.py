"""Measured: the times and loads of tasks, links and nodes in the windows of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import RunError
from dwell.model import LinkDisturbance, Problem
from dwell.model.number_arrays import Floats
from dwell.model.scenario import is_always_on
from dwell_lab.testbed.speeds import work_ms

if TYPE_CHECKING:
    import polars as pl

    from dwell.model import Execution
    from dwell.record import Run

SiteName: TypeAlias = tuple[str, str]

#: Smallest number of jobs for an estimate.
LEAST_JOBS = 100
#: Quantile of a waiting time at which quotas have almost no effect.
UNHINDERED = 0.05


@dataclass(frozen=True, slots=True)
class DisturbedPlaces:
    """Nodes and links that a run's scenario disturbed.

    Parameters
    ----------
    nodes : frozenset of str
        Nodes with any disturbance, such as stress threads or an outage.
    stressed : frozenset of str
        Nodes that had stress threads all the time.
    """

    nodes: frozenset[str]
    links: frozenset[tuple[str, str]]
    stressed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, run: Run) -> DisturbedPlaces:
        """Read the disturbed places from a run's record.

        Raises
        ------
        RunError
            If the cell lacks the scenario of the run, or cannot be read.
        """
        scenario = str(run.meta.get("scenario") or "baseline")
        scenarios = run.problem.scenarios
        if scenario not in scenarios and scenario not in ("baseline", "live"):
            raise RunError(f"scenario {scenario!r} is none of the cell's; what was it?")
        nodes, links, stressed = set(), set(), set()
        for item in (*scenarios.get(scenario, ()), *(run.played or ())):
            if isinstance(item, LinkDisturbance):
                links.add((item.source, item.target))
                continue
            nodes.add(item.node)
            if item.stress_threads and is_always_on(item):
                stressed.add(item.node)
        return cls(frozenset(nodes), frozenset(links), frozenset(stressed))


@dataclass(frozen=True, slots=True)
class Visit:
    """Jobs of one task on one node in one run.

    Parameters
    ----------
    stage_ms : float64 array, shape (jobs,)
        Time of the stage without waiting, in the order of cycles.
    beside_ms : float64 array, shape (jobs,)
        CPU time of other threads of the node during the job, minus its mean for the job's duration,
        per thread of the job. It matters because it uses the same quota. 0 if it is not counted, or
        if an accelerator runs the task.
    cycles, windows : int64 array, shape (jobs,)
    """

    stage_ms: Floats
    beside_ms: Floats
    cycles: NDArray[np.int64]
    windows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Measurements of a run, from its usable windows (see `usable`).

    Parameters
    ----------
    placement : str
        Candidate of all windows; empty if there are several.
    windows : int
        Number of usable windows.
    visits : dict of (str, str) to Visit
        Jobs by task and node.
    rates : dict of (str, str) to float
        Mean number of cores used, by node and process.
    starts : dict of (str, str, bool) to float
        Jobs per second, by task, node, and whether they are shadows.
    spent_ms : dict of (str, str, bool) to float
        Mean CPU time of the stage, by the same keys.
    used : dict of str to float
        Mean number of busy cores, by node.
    work_ms : dict of str to float
        CPU time of a fixed piece of work, by node (`dwell_lab.testbed.speeds`).
    begins_ms, ends_ms : dict of (str, str) to float
        Undelayed time from the last input or the release to the start of the job, and from the end
        of a sink's job to the end of the cycle. Counted CPU time of the node, if available,
        replaces it for sources and sinks.
    handovers_ms : dict of (str, str) to float
        Counted CPU time of the node between a release, or the previous job on the same node, and
        the job; by task and node.
    beside : dict of str to (float, float)
        CPU time of other processes during jobs, and the duration of these jobs, s; by node, if it
        is counted.
    delays_ms : dict of (str, str, str, str) to float64 array
        Times from the end of the sending job to the arrival of the message; by source, target, and
        their nodes.
    """

    name: str
    run: Run
    disturbed: DisturbedPlaces
    placement: str
    windows: int
    visits: dict[SiteName, Visit]
    rates: dict[tuple[str, str], float]
    starts: dict[tuple[str, str, bool], float]
    spent_ms: dict[tuple[str, str, bool], float]
    used: dict[str, float]
    handovers_ms: dict[SiteName, float] = field(default_factory=dict)
    beside: dict[str, tuple[float, float]] = field(default_factory=dict)
    work_ms: dict[str, float] = field(default_factory=dict)
    begins_ms: dict[SiteName, float] = field(default_factory=dict)
    ends_ms: dict[SiteName, float] = field(default_factory=dict)
    delays_ms: dict[tuple[str, str, str, str], Floats] = field(default_factory=dict)


def _visit(jobs: pl.DataFrame, execution: Execution) -> Visit:
    """Return the jobs of a task on one node."""
    cycles, windows = jobs["cycle"].to_numpy(), jobs["window"].to_numpy().astype(np.int64)
    if execution.accelerator is not None:
        stage_ms = jobs["took"].to_numpy() / 1e6
        return Visit(np.asarray(stage_ms, np.float64), np.zeros(jobs.height), cycles, windows)
    stage_ms = jobs["cpu_ns"].to_numpy() / 1e6 / execution.threads
    beside_ms = _beside_ms(jobs) / execution.threads
    return Visit(np.asarray(stage_ms, np.float64), beside_ms, cycles, windows)


def look_at(name: str, run: Run, problem: Problem) -> Measured:
    """Return the measurements of a run with recorded jobs.

    Raises
    ------
    RunError
        If jobs or their CPU times are missing, the pipeline differs, or no window is usable.
    """
    import polars as pl

    if not run.has_jobs or "cpu_ns" not in run.jobs.columns:
        raise RunError(f"{name}: it kept no jobs with CPU times; record it with --jobs")
    _require_same(name, run, problem)
    windows = usable(run)
    if not windows.height:
        raise RunError(f"{name}: no window is left after warm-up, mixed and excluded ones")
    jobs = run.jobs.with_columns(pl.col("cycle").cast(pl.Int64))
    if "shadow" not in jobs.columns:
        jobs = jobs.with_columns(shadow=False)
    jobs = jobs.join(cycles_in(windows, problem), on="cycle").filter(
        pl.col("outcome").cast(str) == "done"
    )
    jobs = jobs.with_columns(
        pl.col("task", "node").cast(str), took=pl.col("end_ns") - pl.col("start_ns")
    ).filter(pl.col("cpu_ns").is_not_null() & (pl.col("took") >= 0))
    jobs = jobs.sort("cycle", maintain_order=True)
    placements = set(windows["placement"].cast(str))
    jobs_s = windows.height * problem.window_cycles * problem.pipeline.period_ms / 1e3
    jobs = jobs.with_columns(accompanied=_accompanied(jobs))
    visits, starts, spent_ms = {}, {}, {}
    for (task, node, shadow), of in jobs.group_by("task", "node", "shadow", maintain_order=True):
        key = str(task), str(node), bool(shadow)
        starts[key] = of.height / jobs_s
        spent_ms[key] = float((of["cpu_ns"].to_numpy() / 1e6).mean())
        if not shadow:
            visits[key[:2]] = _visit(of, problem.pipeline.tasks[key[0]].on[key[1]])
    own = jobs.filter(~pl.col("shadow"))
    handovers_ms = _taken_ms(own, "handover_ns")
    sources = {
        site: ms for site, ms in handovers_ms.items() if not problem.pipeline.inputs(site[0])
    }
    endings_ms = _taken_ms(own, "ending_ns")
    return Measured(
        name=name,
        run=run,
        disturbed=DisturbedPlaces.of(run),
        placement=placements.pop() if len(placements) == 1 else "",
        windows=windows.height,
        visits=visits,
        rates=_rates(run, windows, problem),
        starts=starts,
        spent_ms=spent_ms,
        used={
            node: float(windows[f"u_{node}"].to_numpy().mean()) * of.capacity
            for node, of in problem.fabric.nodes.items()
        },
        handovers_ms=handovers_ms,
        beside=_while_jobs_ran(own.filter(~pl.col("accompanied")), "others_ns"),
        work_ms=work_ms(run),
        delays_ms=_delays(own, problem),
        begins_ms=_begins(own, run, problem) | sources,
        ends_ms=_ends(own, run, problem) | endings_ms,
    )


def _require_same(name: str, run: Run, problem: Problem) -> None:
    try:
        theirs = run.problem
    except RunError as error:
        raise RunError(f"{name}: {error}") from None
    faults = [
        f"{name}: its {what} are {', '.join(sorted(was))}, those of the cell "
        f"{', '.join(sorted(own))}"
        for what, was, own in (
            ("tasks", set(theirs.pipeline.tasks), set(problem.pipeline.tasks)),
            ("nodes", set(theirs.fabric.nodes), set(problem.fabric.nodes)),
        )
        if was != own
    ]
    sites = run.jobs.select("task", "node").unique().cast(dict.fromkeys(("task", "node"), str))
    faults += [
        f"{name}: {task} ran on {node}, where the cell has no such task"
        for task, node in sites.iter_rows()
        if not faults and node not in problem.pipeline.tasks[task].on
    ]
    for field_name, there, here in (
        ("window_cycles", theirs.window_cycles, problem.window_cycles),
        ("period_ms", theirs.pipeline.period_ms, problem.pipeline.period_ms),
    ):
        if there != here:
            faults.append(f"{name}: {field_name} was {there}, not {here}")
    if faults:
        raise RunError("\n".join(faults))


def usable(run: Run) -> pl.DataFrame:
    """Return the windows of a run except warm-up, mixed, unproven and excluded windows."""
    import polars as pl

    windows = run.windows.filter(~pl.col("warmup") & ~pl.col("mixed"))
    if "unproven" in windows.columns:
        windows = windows.filter(~pl.col("unproven"))
    pressure = run.meta.get("pressure")
    out = pressure.get("excluded", ()) if isinstance(pressure, Mapping) else ()
    return windows.filter(~pl.col("window").is_in([int(number) for number in out]))


def cycles_in(windows: pl.DataFrame, problem: Problem) -> pl.DataFrame:
    """Return the cycles of windows, with columns `window` and `cycle` (Int64)."""
    import polars as pl

    ranges = pl.int_ranges("first_cycle", pl.col("first_cycle") + problem.window_cycles)
    return windows.select("window", cycle=ranges).explode("cycle").cast({"cycle": pl.Int64})


def _while_jobs_ran(own: pl.DataFrame, column: str) -> dict[str, tuple[float, float]]:
    """Return the CPU time of others during jobs, and the duration of the jobs, s, by node."""
    import polars as pl

    if column not in own.columns:
        return {}
    sums = (
        own.filter(pl.col(column).is_not_null())
        .group_by("node")
        .agg(pl.col(column).sum() / 1e9, pl.col("took").sum() / 1e9)
    )
    return {node: (taken_s, took_s) for node, taken_s, took_s in sums.iter_rows()}


def _accompanied(jobs: pl.DataFrame) -> pl.Series:
    """Return for each job whether another job or a shadow overlapped it on the same node."""
    import polars as pl

    order = jobs.with_row_index().sort("node", "start_ns", "end_ns")
    ended = pl.col("end_ns").cum_max().shift(1).over("node")
    follows = pl.col("start_ns").shift(-1).over("node")
    met = order.with_columns(
        accompanied=((ended > pl.col("start_ns")) | (follows < pl.col("end_ns"))).fill_null(
            value=False
        )
    )
    return met.sort("index")["accompanied"]


def _beside_ms(of: pl.DataFrame) -> Floats:
    """Return the CPU time of other threads during each job of a site, minus its mean, ms.

    A job that overlaps another job takes the value of the previous job.
    """
    import polars as pl

    if "others_ns" not in of.columns:
        return np.zeros(of.height)
    alone = ~pl.col("accompanied") & pl.col("others_ns").is_not_null()
    known = of.filter(alone)
    if not known.height:
        return np.zeros(of.height)
    rate = float(known["others_ns"].sum()) / max(float(known["took"].sum()), 1.0)
    more = pl.when(alone).then(pl.col("others_ns") - rate * pl.col("took")) / 1e6
    return of.select(more.forward_fill().backward_fill()).to_series().to_numpy()


def _taken_ms(own: pl.DataFrame, column: str) -> dict[SiteName, float]:
    """Return the mean of a counted CPU time by task and node, if enough jobs have it, ms."""
    import polars as pl

    if column not in own.columns:
        return {}
    means = (
        own.filter(pl.col(column).is_not_null())
        .group_by("task", "node")
        .agg(pl.col(column).mean() / 1e6, jobs=pl.len())
        .filter(pl.col("jobs") >= LEAST_JOBS)
    )
    return {(task, node): mean_ms for task, node, mean_ms, _ in means.iter_rows()}


def _rates(run: Run, windows: pl.DataFrame, problem: Problem) -> dict[tuple[str, str], float]:
    """Return the cores that each process used in the windows, from first release to the end."""
    import polars as pl

    if not run.has_processes:
        return {}
    size, grace_ns = problem.window_cycles, problem.controller.close_grace_ms * 1e6
    span_ns = windows.height * (size * problem.pipeline.period_ms * 1e6 + grace_ns)
    counted = run.processes.filter(pl.col("window").is_in(windows["window"].to_list()))
    sums = counted.group_by(pl.col("node").cast(str), "process").agg(pl.col("cpu_ns").sum())
    return {(node, process): cpu_ns / span_ns for node, process, cpu_ns in sums.iter_rows()}


def _delays(own: pl.DataFrame, problem: Problem) -> dict[tuple[str, str, str, str], Floats]:
    """Return the delays of messages by flow and nodes; tasks with several inputs are left out."""
    import polars as pl

    delays: dict[tuple[str, str, str, str], Floats] = {}
    for flow in problem.pipeline.flows:
        if len(problem.pipeline.inputs(flow.target)) > 1:
            continue
        sent = own.filter(pl.col("task") == flow.source).select("cycle", "end_ns", "node")
        came = own.filter(pl.col("task") == flow.target).select("cycle", "ready_ns", to="node")
        both = sent.join(came, on="cycle", maintain_order="left")
        for (node, to), of in both.group_by("node", "to", maintain_order=True):
            delay_ms = (of["ready_ns"] - of["end_ns"]).to_numpy() / 1e6
            delays[flow.source, flow.target, str(node), str(to)] = delay_ms
    return delays


def _begins(own: pl.DataFrame, run: Run, problem: Problem) -> dict[SiteName, float]:
    import polars as pl

    tasks, pipeline = problem.pipeline.tasks, problem.pipeline
    offset_ms = {name: task.offset_ms for name, task in tasks.items() if not pipeline.inputs(name)}
    released = run.cycles.select(pl.col("cycle").cast(pl.Int64), "release_ns")
    since_ns = (
        pl.when(pl.col("task").is_in(list(offset_ms))).then("release_ns").otherwise("ready_ns")
    )
    offsets = pl.col("task").replace_strict(offset_ms, default=0.0, return_dtype=pl.Float64)
    waits = own.join(released, on="cycle", how="left")
    return _unhindered(waits, (pl.col("start_ns") - since_ns) / 1e6 - offsets)


def _ends(own: pl.DataFrame, run: Run, problem: Problem) -> dict[SiteName, float]:
    import polars as pl

    sinks = [name for name in problem.pipeline.tasks if not problem.pipeline.outputs(name)]
    if len(sinks) > 1:
        return {}
    cycles = run.cycles.filter(pl.col("latency_ns").is_not_null())
    done = cycles.select(
        pl.col("cycle").cast(pl.Int64), done=pl.col("release_ns") + pl.col("latency_ns")
    )
    of = own.filter(pl.col("task") == sinks[0]).join(done, on="cycle")
    return _unhindered(of, (pl.col("done") - pl.col("end_ns")) / 1e6)


def _unhindered(jobs: pl.DataFrame, wait_ms: pl.Expr) -> dict[SiteName, float]:
    """Return the quantile `UNHINDERED` of the waits of jobs, by task and node."""
    quick_ms = wait_ms.quantile(UNHINDERED, "linear").clip(0.0)
    quick = jobs.group_by("task", "node").agg(quick_ms.alias("ms"))
    return {(task, node): ms for task, node, ms in quick.iter_rows()}
