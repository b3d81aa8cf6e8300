"""Measured: what runs that kept their jobs show of tasks, links and nodes.

A job costs its node more CPU than its stage takes: its worker reads and writes messages, and at
both ends of the pipeline a stamp and a command are handed over. A simulator that knows nothing of
messages on one node, and of what they cost, is told so by way of the execution times:

- a worker's CPU time is idle · wall + Σ (stage + overhead) over its jobs. Runs in which it has jobs
  and runs in which it has none tell the two apart; a worker that always has jobs idles like others;
- of the overhead, what lies on the way of messages delays the cycle (`dwell.testbed.hops`);
- a job takes, besides, what passes between its last input and its start, and a sink's what passes
  between its end and the command's hand-over, as where the quota does not interfere;
- where something counts what a node takes between a release and its source's start, or between two
  jobs of a cycle that both run on it, the job takes that: whoever takes it, the job waits for it.

Everything else that a node does (agents, stampers, sinks, the controller, workers without jobs and
the messaging that delays nothing) is its background. A link adds to the delay that is asked of it
what a message takes beyond that, its transmission and the CPU time of sender and receiver, which
their jobs have already.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import RunError
from dwell.model import Flow, Problem
from dwell.model.bounds import BACKGROUND_HZ, CONTENTION
from dwell.testbed.hops import LEAST_JOBS, OnTheWay, share
from dwell.testbed.paired import Part
from dwell.testbed.speeds import Usual, work_ms

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

__all__ = [
    "Disturbed",
    "Measured",
    "Site",
    "Visit",
    "backgrounds",
    "beside_jobs",
    "contentions",
    "interferences",
    "look_at",
    "messaging",
    "sites",
    "usable",
    "wakes",
]

Floats: TypeAlias = NDArray[np.float64]
SiteName: TypeAlias = tuple[str, str]

#: How many times as long as usual messaging takes where a stage takes longer: in the runs of the
#: example as many as that, window by window; a job that finds nothing to do has its messages still.
SLOWER = 0.5, 2.0
#: What a disturbance has that is not there all the time.
SOMETIMES = ("at_s", "for_s", "episodes", "ramp_s")
#: Sides of a hop, in its times and, behind source and target, in its name.
SENDER, RECEIVER = range(2)
#: Wakes that come together: a message wakes a thread that waits for sockets, one that reads, and a
#: worker's. In a trace of the scheduler under the example, the time from any instant until a thread
#: wakes or sleeps is as long as with 0.40 (E) to 0.52 (R1) times as many that come alone.
TOGETHER = 2.2
#: Quantile of a waiting time at which a quota has hardly had a part in it.
UNHINDERED = 0.05


@dataclass(frozen=True, slots=True)
class Disturbed:
    """What a run's scenario did.

    Parameters
    ----------
    nodes : frozenset of str
        With foreign threads, or down.
    links : frozenset of (str, str)
    stressed : frozenset of str
        Nodes that had foreign threads all the time.
    """

    nodes: frozenset[str]
    links: frozenset[tuple[str, str]]
    stressed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> Disturbed:
        """Read a run's record.

        Raises
        ------
        RunError
            If its scenario is not among those of its cell.
        """
        scenario = str(meta.get("scenario") or "baseline")
        scenarios = meta["problem"].get("scenarios") or {}
        if scenario not in scenarios and scenario not in ("baseline", "live"):
            raise RunError(f"scenario {scenario!r} is none of the cell's; what was it?")
        nodes, links, stressed = set(), set(), set()
        for item in (*scenarios.get(scenario, ()), *_played(meta)):
            if "node" in item:
                nodes.add(str(item["node"]))
                if item.get("stress_threads") and not any(item.get(key) for key in SOMETIMES):
                    stressed.add(str(item["node"]))
            if "link" in item:
                source, _, target = str(item["link"]).partition("->")
                links.add((source, target))
                if item.get("both_ways"):
                    links.add((target, source))
        return cls(frozenset(nodes), frozenset(links), frozenset(stressed))


def _played(meta: Mapping[str, Any]) -> Iterable[Mapping[str, Any]]:
    played = meta.get("played")
    found = played if isinstance(played, Sequence) and not isinstance(played, str) else ()
    return (item for item in found if isinstance(item, Mapping))


@dataclass(frozen=True, slots=True)
class Visit:
    """Jobs of one task on one node in one run.

    Parameters
    ----------
    cpu_ms : float64 array, shape (jobs,)
        CPU time of the stage, in the order of cycles; 0 of a task that an accelerator runs.
    stage_ms : float64 array, shape (jobs,)
        Time that the stage needs where nothing hinders it.
    beside_ms : float64 array, shape (jobs,)
        CPU time that its node took meanwhile for others, by thread of the job, beyond what it takes
        in the mean of as long: both use up the quota. 0 where nothing counts it, and of a task that
        an accelerator runs.
    cycles, windows : int64 array, shape (jobs,)
    """

    cpu_ms: Floats
    stage_ms: Floats
    beside_ms: Floats
    cycles: NDArray[np.int64]
    windows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One run: what its windows show that are neither warm-up nor mixed nor excluded.

    Parameters
    ----------
    name : str
    run : Run
    disturbed : Disturbed
    placement : str
        Candidate of all its windows; empty where it moved.
    windows, cycles : int
        Used.
    jobs_s : float
        Time in which the jobs of the used windows became due, seconds.
    visits : dict of (str, str) to Visit
        By task and node.
    rates : dict of (str, str) to float
        Cores that each process took, by node and process.
    starts : dict of (str, str, bool) to float
        Jobs a second, by task, node, and whether they are shadows.
    spent_ms : dict of (str, str, bool) to float
        Mean CPU time of their stage.
    used : dict of str to float
        Cores that were busy on each node.
    work_ms : dict of str to float
        CPU time of a fixed piece of work on every node (`dwell.testbed.speeds`).
    begins_ms, ends_ms : dict of (str, str) to float
        From the arrival of the last input, or a release, to the start of the job; of sinks, from
        the end of the job to that of the cycle. Unhindered, but where something counts what the
        node took: since a release, and to the end of the cycle.
    handovers_ms : dict of (str, str) to float
        By task and node: CPU time that the node took between a release, or the job before on the
        same node, and the job; where something counts it.
    beside : dict of str to (float, float)
        By node: CPU time of other processes while jobs ran, and how long these ran, seconds; of
        nodes where something counts it.
    outside : dict of str to (float, float)
        The same of everybody else on the node's CPUs.
    delays_ms : dict of (str, str, str, str) to float64 array
        By source, target, and the nodes of both: from the end of the job that sent a message to its
        arrival.
    """

    name: str
    run: Run
    disturbed: Disturbed
    placement: str
    windows: int
    cycles: int
    jobs_s: float
    visits: dict[SiteName, Visit]
    rates: dict[tuple[str, str], float]
    starts: dict[tuple[str, str, bool], float]
    spent_ms: dict[tuple[str, str, bool], float]
    used: dict[str, float]
    handovers_ms: dict[SiteName, float] = field(default_factory=dict)
    beside: dict[str, tuple[float, float]] = field(default_factory=dict)
    outside: dict[str, tuple[float, float]] = field(default_factory=dict)
    work_ms: dict[str, float] = field(default_factory=dict)
    begins_ms: dict[SiteName, float] = field(default_factory=dict)
    ends_ms: dict[SiteName, float] = field(default_factory=dict)
    delays_ms: dict[tuple[str, str, str, str], Floats] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Site:
    """A task on a node, over all runs.

    Parameters
    ----------
    samples : dict of str to Part
        What an undisturbed job takes of the node, its share of messaging included, by run.
    stage_ms, messaging_ms : float
        Means of the stage alone, and of its worker's messaging what lies on the way.
    before_ms, after_ms : float
        Means of what other threads do before the stage (input or release, messaging) and after it
        (messaging, the end of the cycle).
    """

    samples: dict[str, Part]
    stage_ms: float
    messaging_ms: float
    before_ms: float
    after_ms: float

    @property
    def samples_ms(self) -> Floats:
        """Those of all runs, one after the other."""
        return np.concatenate([part.times_ms for part in self.samples.values()])


def look_at(name: str, run: Run, problem: Problem) -> Measured:
    """Take out of a run what there is to measure.

    Raises
    ------
    RunError
        If it kept no jobs or no CPU times, is of another pipeline, or no window can be used.
    """
    import polars as pl

    if not run.has_jobs or "cpu_ns" not in run.jobs.columns:
        raise RunError(f"{name}: it kept no jobs with CPU times; record it with --jobs")
    _require_same(name, run, problem)
    windows = usable(run)
    if not windows.height:
        raise RunError(f"{name}: no window is left after warm-up, mixed and excluded ones")
    size = problem.window_cycles
    in_window = (
        windows.select("window", cycle=pl.int_ranges("first_cycle", pl.col("first_cycle") + size))
        .explode("cycle")
        .cast({"cycle": pl.Int64})
    )
    jobs = run.jobs.with_columns(pl.col("cycle").cast(pl.Int64))
    if "shadow" not in jobs.columns:
        jobs = jobs.with_columns(shadow=False)
    jobs = jobs.join(in_window, on="cycle").filter(pl.col("outcome").cast(str) == "done")
    jobs = jobs.with_columns(
        pl.col("task", "node").cast(str), took=pl.col("end_ns") - pl.col("start_ns")
    ).filter(pl.col("cpu_ns").is_not_null() & (pl.col("took") >= 0))
    jobs = jobs.sort("cycle", maintain_order=True)
    placements = set(windows["placement"].cast(str))
    jobs_s = windows.height * size * problem.pipeline.period_ms / 1e3
    jobs = jobs.with_columns(accompanied=_accompanied(jobs))
    visits, starts, spent_ms = {}, {}, {}
    for (task, node, shadow), of in jobs.group_by("task", "node", "shadow", maintain_order=True):
        key = str(task), str(node), bool(shadow)
        cpu_ms = of["cpu_ns"].to_numpy() / 1e6
        starts[key] = of.height / jobs_s
        spent_ms[key] = float(cpu_ms.mean())
        if not shadow:
            execution = problem.pipeline.tasks[key[0]].on[key[1]]
            on_cpu = execution.accelerator is None
            stage_ms = cpu_ms / execution.threads if on_cpu else of["took"].to_numpy() / 1e6
            visits[key[:2]] = Visit(
                cpu_ms,
                np.asarray(stage_ms, np.float64),
                _beside_ms(of) / execution.threads if on_cpu else np.zeros(of.height),
                of["cycle"].to_numpy(),
                of["window"].to_numpy().astype(np.int64),
            )
    own = jobs.filter(~pl.col("shadow"))
    handovers_ms = _taken_ms(own, "handover_ns")
    sources = {
        site: ms for site, ms in handovers_ms.items() if not problem.pipeline.inputs(site[0])
    }
    endings_ms = _taken_ms(own, "ending_ns")
    return Measured(
        name=name,
        run=run,
        disturbed=Disturbed.of(run.meta),
        placement=placements.pop() if len(placements) == 1 else "",
        windows=windows.height,
        cycles=windows.height * size,
        jobs_s=jobs_s,
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
        outside=_while_jobs_ran(own, "outside_ns"),
        work_ms=work_ms(run.meta),
        delays_ms=_delays(own, problem),
        begins_ms=_begins(own, run, problem) | sources,
        ends_ms=_ends(own, run, problem) | endings_ms,
    )


def _require_same(name: str, run: Run, problem: Problem) -> None:
    theirs = run.meta.get("problem")
    if not isinstance(theirs, Mapping):
        raise RunError(f"{name}: its record does not say which cell it ran")
    faults = [
        f"{name}: its {what} are {', '.join(sorted(theirs.get(what, {})))}, those of the cell "
        f"{', '.join(sorted(own))}"
        for what, own in (("tasks", problem.pipeline.tasks), ("nodes", problem.fabric.nodes))
        if set(theirs.get(what, {})) != set(own)
    ]
    sites = run.jobs.select("task", "node").unique().cast(dict.fromkeys(("task", "node"), str))
    faults += [
        f"{name}: {task} ran on {node}, where the cell has no such task"
        for task, node in sites.iter_rows()
        if not faults and node not in problem.pipeline.tasks[task].on
    ]
    for field_name, here in (
        ("window_cycles", problem.window_cycles),
        ("period_ms", problem.pipeline.period_ms),
    ):
        if theirs.get(field_name) != here:
            faults.append(f"{name}: {field_name} was {theirs.get(field_name)}, not {here}")
    if faults:
        raise RunError("\n".join(faults))


def usable(run: Run) -> pl.DataFrame:
    """Return the windows of a run after the warm-up that are of one placement and undisturbed."""
    import polars as pl

    windows = run.windows.filter(~pl.col("warmup") & ~pl.col("mixed"))
    if "unproven" in windows.columns:
        windows = windows.filter(~pl.col("unproven"))
    pressure = run.meta.get("pressure")
    out = pressure.get("excluded", ()) if isinstance(pressure, Mapping) else ()
    return windows.filter(~pl.col("window").is_in([int(number) for number in out]))


def _while_jobs_ran(own: pl.DataFrame, column: str) -> dict[str, tuple[float, float]]:
    """CPU time that somebody took while jobs ran, and how long these ran, by node."""
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
    """Whether another job of the cell, or a shadow, ran on the same node meanwhile."""
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
    """What a site's jobs took of their node beside them beyond the mean, ms.

    Of one that another job accompanied it is not known; it takes what the one before did.
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
    """Mean of what nodes took around their jobs, by task and node, where it is often known."""
    import polars as pl

    if column not in own.columns:
        return {}
    found = (
        own.filter(pl.col(column).is_not_null())
        .group_by("task", "node")
        .agg(pl.col(column).mean() / 1e6, jobs=pl.len())
        .filter(pl.col("jobs") >= LEAST_JOBS)
    )
    return {(task, node): mean_ms for task, node, mean_ms, _ in found.iter_rows()}


def _rates(run: Run, windows: pl.DataFrame, problem: Problem) -> dict[tuple[str, str], float]:
    """Cores that each process took in the windows; each counts from its release to its close."""
    import polars as pl

    if not run.has_processes:
        return {}
    size, grace_ns = problem.window_cycles, problem.controller.close_grace_ms * 1e6
    span_ns = windows.height * (size * problem.pipeline.period_ms * 1e6 + grace_ns)
    found = run.processes.filter(pl.col("window").is_in(windows["window"].to_list()))
    sums = found.group_by(pl.col("node").cast(str), "process").agg(pl.col("cpu_ns").sum())
    return {(node, process): cpu_ns / span_ns for node, process, cpu_ns in sums.iter_rows()}


def _delays(own: pl.DataFrame, problem: Problem) -> dict[tuple[str, str, str, str], Floats]:
    """Delays of messages, by flow and nodes; of joins it is not known which input came last."""
    import polars as pl

    found: dict[tuple[str, str, str, str], Floats] = {}
    for flow in problem.pipeline.flows:
        if len(problem.pipeline.inputs(flow.target)) > 1:
            continue
        sent = own.filter(pl.col("task") == flow.source).select("cycle", "end_ns", "node")
        came = own.filter(pl.col("task") == flow.target).select("cycle", "ready_ns", to="node")
        both = sent.join(came, on="cycle", maintain_order="left")
        for (node, to), of in both.group_by("node", "to", maintain_order=True):
            delay_ms = (of["ready_ns"] - of["end_ns"]).to_numpy() / 1e6
            found[flow.source, flow.target, str(node), str(to)] = delay_ms
    return found


def _begins(own: pl.DataFrame, run: Run, problem: Problem) -> dict[SiteName, float]:
    import polars as pl

    released = run.cycles.select(pl.col("cycle").cast(pl.Int64), "release_ns")
    found: dict[SiteName, float] = {}
    for task in problem.pipeline.tasks.values():
        of = own.filter(pl.col("task") == task.name)
        since, offset_ms = "ready_ns", 0.0
        if not problem.pipeline.inputs(task.name):
            of, since, offset_ms = of.join(released, on="cycle"), "release_ns", task.offset_ms
        wait_ms = (of["start_ns"] - of[since]).to_numpy() / 1e6 - offset_ms
        found |= _unhindered(task.name, of["node"].to_list(), wait_ms)
    return found


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
    return _unhindered(sinks[0], of["node"].to_list(), (of["done"] - of["end_ns"]).to_numpy() / 1e6)


def _unhindered(task: str, nodes: Sequence[str], wait_ms: Floats) -> dict[SiteName, float]:
    where = np.array(nodes)
    return {
        (task, str(node)): max(float(np.quantile(wait_ms[where == node], UNHINDERED)), 0.0)
        for node in np.unique(where)
    }


# ------------------------------------------------------------------------------------ tasks


def sites(
    measured: Sequence[Measured],
    messaging_ms: Mapping[SiteName, float],
    known: OnTheWay,
    problem: Problem,
    usual: Usual,
) -> dict[SiteName, Site]:
    """Execution times of every task on every node that was visited undisturbed.

    Parameters
    ----------
    messaging_ms : mapping of (str, str) to float
        CPU time that a worker takes for a job besides its stage (`messaging`).
    known : OnTheWay
        What of that lies on the way of messages.
    problem : Problem
    usual : Usual
        How fast the CPUs were in all runs together: samples are of CPUs as fast as that.
    """
    found: dict[SiteName, Site] = {}
    for site in sorted({site for one in measured for site in one.visits}):
        of = [one for one in measured if site in one.visits and site[1] not in one.disturbed.nodes]
        if sum(len(one.visits[site].stage_ms) for one in of) < LEAST_JOBS:
            continue
        # As long as it would have taken at the runs' mean speed.
        stages_ms = {
            one.name: one.visits[site].stage_ms / usual.factor(one.work_ms, *site) for one in of
        }
        begin_ms, end_ms = (
            float(np.mean([ends[site] for ends in ways if site in ends] or 0.0))
            for ways in ([one.begins_ms for one in of], [one.ends_ms for one in of])
        )
        read_ms, write_ms = _on_the_way_ms(site, messaging_ms.get(site, 0.0), known, problem)
        before_ms, after_ms = begin_ms + read_ms, write_ms + end_ms
        stage_ms = float(np.concatenate(list(stages_ms.values())).mean())
        samples = {
            one.name: Part(
                one.visits[site].cycles,
                _with_messaging(stages_ms[one.name], stage_ms, before_ms + after_ms)
                + one.visits[site].beside_ms,
            )
            for one in of
        }
        found[site] = Site(samples, stage_ms, read_ms + write_ms, before_ms, after_ms)
    return found


def _with_messaging(stages_ms: Floats, mean_ms: float, around_ms: float) -> Floats:
    """Add what is done around a stage: what slows the stage down slows that."""
    if mean_ms <= 0:
        return stages_ms + around_ms
    return stages_ms + around_ms * np.clip(stages_ms / mean_ms, *SLOWER)


def _on_the_way_ms(
    site: SiteName, messaging_ms: float, known: OnTheWay, problem: Problem
) -> tuple[float, float]:
    """CPU time of a worker on the way of its job's inputs, and outputs; all of it if unknown."""
    task, node = site

    def part_ms(flow: Flow, side: int) -> float:
        ends = flow.source, flow.target
        ways = [
            hop[side]
            for name, hop in known.hops.items()
            if name[:2] == ends and name[2 + side] == node
        ]
        return float(np.mean(ways)) if ways else messaging_ms * share(problem, task, *ends)

    pipeline = problem.pipeline
    return (
        sum(part_ms(flow, RECEIVER) for flow in pipeline.inputs(task)),
        sum(part_ms(flow, SENDER) for flow in pipeline.outputs(task)),
    )


def messaging(measured: Sequence[Measured], problem: Problem) -> dict[SiteName, float]:
    """CPU time, ms, that every worker takes for a job besides its stage's, by task and node."""
    of: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for one in measured:
        for (node, process), rate in one.rates.items():
            task, at, rest = process.partition("@")
            worker = at and task in problem.pipeline.tasks and rest == node
            if not worker or node in one.disturbed.nodes:
                continue
            key = task, node, False
            jobs = one.starts.get(key, 0.0)
            # Cores besides those of the stage, and jobs a millisecond.
            besides = rate - jobs * one.spent_ms.get(key, 0.0) / 1e3
            of.setdefault((process, task, node), []).append((jobs / 1e3, besides))
    idle: list[float] = []
    open_ones: list[tuple[str, str, str]] = []
    overhead_ms: dict[SiteName, float] = {}
    for (process, task, node), points in of.items():
        jobs, besides = np.array(points).T
        if jobs.max() == 0.0:
            idle.append(max(float(besides.mean()), 0.0))
        elif np.ptp(jobs) > 0.5 * jobs.max():
            slope, start = np.polyfit(jobs, besides, 1)
            idle.append(max(float(start), 0.0))
            overhead_ms[task, node] = max(float(slope), 0.0)
        else:
            open_ones.append((process, task, node))
    usual = float(np.mean(idle)) if idle else 0.0
    for process, task, node in open_ones:
        jobs, besides = np.array(of[process, task, node]).T
        overhead_ms[task, node] = max(float((besides - usual).mean() / jobs.mean()), 0.0)
    return overhead_ms


# ------------------------------------------------------------------------------------ nodes


def backgrounds(
    measured: Sequence[Measured], found: Mapping[SiteName, Site], problem: Problem
) -> dict[str, float]:
    """Cores of every node that neither its jobs nor foreign threads took.

    Of a node with a quota its control group says what was taken in all; elsewhere, where others
    may have the same CPUs, only the cell's own processes are counted.
    """
    result = {}
    for node, of in problem.fabric.nodes.items():
        left = []
        for one in measured:
            processes = [rate for (where, _), rate in one.rates.items() if where == node]
            if node in one.disturbed.nodes or not processes:
                continue
            used = one.used[node] if of.quota is not None else sum(processes)
            sites_ = ((key, rate) for key, rate in one.starts.items() if key[1] == node)
            jobs = sum(rate * _cores_ms(key, one, found, problem) / 1e3 for key, rate in sites_)
            left.append((used - jobs, one.windows))
        if left:
            values, weights = zip(*left, strict=True)
            mean = float(np.average(values, weights=weights))
            result[node] = min(max(mean, 0.0), 0.9 * of.capacity)
    return result


def beside_jobs(measured: Sequence[Measured], behind: Mapping[str, float]) -> dict[str, float]:
    """Cores of every node's background that were taken while its jobs ran, where it is known.

    Parameters
    ----------
    behind : mapping of str to float
        The backgrounds.
    """
    result = {}
    for node, cores in behind.items():
        of = [
            one.beside[node] for one in measured if node in one.beside.keys() - one.disturbed.nodes
        ]
        if (taken := _cores(of)) is not None:
            result[node] = min(taken, cores)
    return result


def _cores(of: Sequence[tuple[float, float]]) -> float | None:
    """What somebody took while jobs ran, over how long these ran; None where none did."""
    took_s = sum(took for _, took in of)
    return sum(taken for taken, _ in of) / took_s if took_s > 0 else None


def contentions(measured: Sequence[Measured]) -> dict[str, float]:
    """Share of the time of every node's jobs in which its CPUs did what is outside of it.

    From runs without any stress: nodes may share CPUs, and one that is stressed takes more of them.
    """
    result = {}
    calm = [one for one in measured if not one.disturbed.nodes]
    for node in sorted({node for one in calm for node in one.outside}):
        of = [one.outside[node] for one in calm if node in one.outside]
        if (taken := _cores(of)) is not None:
            result[node] = min(taken, CONTENTION.high)
    return result


def wakes(measured: Sequence[Measured], problem: Problem) -> dict[str, float]:
    """How often in a second threads of a node wake, where the kernel looks at ticks otherwise."""
    result = {}
    for name, node in problem.fabric.nodes.items():
        told = [one.run.meta.get("wakes_hz") or {} for one in measured]
        known = [float(of[name]) for of in told if name in of]
        if known and node.quota is not None and node.quota.tick_ms > 0:
            result[name] = min(sum(known) / len(known) / TOGETHER, BACKGROUND_HZ.high)
    return result


def interferences(
    measured: Sequence[Measured], found: Mapping[SiteName, Site], usual: Usual
) -> dict[str, float]:
    """How many times as much core time stages took on nodes that were stressed all the time."""
    sums: dict[str, list[float]] = {}
    for one in measured:
        for site, visit in one.visits.items():
            node = site[1]
            if node in one.disturbed.stressed and site in found:
                total = sums.setdefault(node, [0.0, 0.0, 0.0])
                total[0] += float(visit.stage_ms.sum()) / usual.factor(one.work_ms, *site)
                total[1] += len(visit.stage_ms) * found[site].stage_ms
                total[2] += len(visit.stage_ms)
    return {
        node: max(took / alone, 1.0)
        for node, (took, alone, jobs) in sums.items()
        if jobs >= LEAST_JOBS
    }


def _cores_ms(
    key: tuple[str, str, bool],
    one: Measured,
    found: Mapping[SiteName, Site],
    problem: Problem,
) -> float:
    """Core time, ms, of a job as a simulator will charge it."""
    execution = problem.pipeline.tasks[key[0]].on[key[1]]
    if execution.accelerator is not None:
        return 0.0
    site = found.get(key[:2])
    if site is None:
        return one.spent_ms[key]
    return one.spent_ms[key] + execution.threads * (site.before_ms + site.after_ms)
