"""Jobs of a run as trace events for chrome://tracing and Perfetto.

Nodes are processes and tasks are threads. A job is a slice from its start to its end. Its wait for
a worker is a separate asynchronous slice, because waiting jobs of a task overlap. Cycles are
asynchronous slices of a separate process, and migrations are instants of that process.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

from dwell.record.moves import moves
from dwell.report.run_header import RunHeader

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

NS_PER_US = 1e3
# Process number of the cycles; the numbers of the nodes follow.
CELL = 0
# Thread numbers reserved for the workers of each task.
LANES = 1000

#: An event in the Chrome JSON trace event format; times are microseconds.
TraceEvent: TypeAlias = "dict[str, Any]"


def trace_events(run: Run) -> dict[str, Any]:
    """Return the jobs, cycles and migrations of a run as trace events.

    Parameters
    ----------
    run : Run
        A run that kept its jobs.

    Returns
    -------
    dict
        A trace in the Chrome JSON trace event format; write it with ``json.dump``.

    Raises
    ------
    RunError
        If the run kept no jobs, or its record is incomplete.
    """
    header = RunHeader.of(run)
    jobs = run.jobs
    return {
        "traceEvents": [
            *_names(header, jobs),
            *_job_events(header, jobs),
            *_cycle_events(run.cycles, jobs),
            *_migration_events(run),
        ],
        "displayTimeUnit": "ms",
        "otherData": {
            "cell": header.problem.name,
            "scenario": header.scenario,
            "policy": header.policy,
            "seed": header.seed,
        },
    }


def _names(header: RunHeader, jobs: pl.DataFrame) -> Iterator[TraceEvent]:
    """Name the processes, and the first thread of every task."""
    yield _name("process_name", CELL, 0, f"cell {header.problem.name}")
    for node, pid in _processes(header).items():
        yield _name("process_name", pid, 0, f"node {node}")
    for node, task in jobs.select("node", "task").unique(maintain_order=True).rows():
        yield _name("thread_name", _processes(header)[node], _threads(jobs)[task], task)


def _job_events(header: RunHeader, jobs: pl.DataFrame) -> Iterator[TraceEvent]:
    """Yield the jobs as slices, and their waits as asynchronous slices."""
    threads = _threads(jobs)
    known = [jobs[column].max() for column in ("ready_ns", "start_ns", "end_ns")]
    # A job without an end is shown until the last time of any job.
    last_ns = max((value for value in known if isinstance(value, int)), default=0)
    for (node, task), mine in jobs.group_by("node", "task", maintain_order=True):
        pid, thread = _processes(header)[str(node)], threads[str(task)]
        free: list[tuple[int, int]] = []
        for job in mine.sort("start_ns", nulls_last=True).iter_rows(named=True):
            ready_ns, start_ns = job["ready_ns"], job["start_ns"]
            end_ns = last_ns if job["end_ns"] is None else job["end_ns"]
            begun_ns = end_ns if start_ns is None else start_ns
            about = {"cycle": job["cycle"], "outcome": str(job["outcome"])}
            if begun_ns > ready_ns:
                name, key = f"{task} waits", f"{pid}/{task}/{job['cycle']}"
                yield from _span(name, "waiting", pid, key, (ready_ns, begun_ns), about)
            if start_ns is not None:
                # Workers of a task run jobs in parallel; slices of a thread must not overlap.
                lane = heapq.heappop(free)[1] if free and free[0][0] <= start_ns else len(free)
                heapq.heappush(free, (end_ns, lane))
                yield {
                    "name": str(task),
                    "cat": "job",
                    "ph": "X",
                    "pid": pid,
                    "tid": thread + lane,
                    "ts": start_ns / NS_PER_US,
                    "dur": (end_ns - start_ns) / NS_PER_US,
                    "args": about,
                }


def _cycle_events(cycles: pl.DataFrame, jobs: pl.DataFrame) -> Iterator[TraceEvent]:
    """Yield the cycles, from release to completion, or to the last event of their jobs."""
    import polars as pl

    seen = jobs.group_by("cycle").agg(
        last_ns=pl.max_horizontal(pl.col("ready_ns").max(), pl.col("end_ns").max())
    )
    played = cycles.join(seen, on="cycle", how="inner", maintain_order="left")
    for cycle in played.iter_rows(named=True):
        release_ns, latency_ns = cycle["release_ns"], cycle["latency_ns"]
        end_ns = cycle["last_ns"] if latency_ns is None else release_ns + latency_ns
        about = {
            "placement": str(cycle["placement"]),
            "outcome": str(cycle["outcome"]),
            "missed": cycle["missed"],
        }
        name, key = f"cycle {cycle['cycle']}", f"cycle/{cycle['cycle']}"
        yield from _span(name, "cycle", CELL, key, (release_ns, end_ns), about)


def _migration_events(run: Run) -> Iterator[TraceEvent]:
    """Yield the decisions that migrate, each at the release of its `Move.cycle`."""
    released_ns = dict(run.cycles.select("cycle", "release_ns").iter_rows())
    for move in moves(run):
        if move.cycle not in released_ns:
            continue
        yield {
            "name": f"{move.source} → {move.target}",
            "cat": "decision",
            "ph": "i",
            "s": "g",
            "pid": CELL,
            "tid": 0,
            "ts": released_ns[move.cycle] / NS_PER_US,
            "args": {"window": run.decisions["window"][move.row], "reason": move.reason},
        }


def _processes(header: RunHeader) -> dict[str, int]:
    return {node: pid for pid, node in enumerate(header.problem.fabric.nodes, start=CELL + 1)}


def _threads(jobs: pl.DataFrame) -> dict[str, int]:
    """Return the first thread of each task; further workers have the numbers after it."""
    tasks = jobs["task"].unique(maintain_order=True).to_list()
    return {task: LANES * i + 1 for i, task in enumerate(tasks)}


def _name(what: str, pid: int, tid: int, name: str) -> TraceEvent:
    return {"name": what, "ph": "M", "pid": pid, "tid": tid, "args": {"name": name}}


def _span(
    name: str, category: str, pid: int, key: str, ns: tuple[int, int], about: TraceEvent
) -> Iterator[TraceEvent]:
    """Yield the begin and end events of an asynchronous slice."""
    begin = {
        "name": name,
        "cat": category,
        "ph": "b",
        "id": key,
        "pid": pid,
        "tid": 0,
        "ts": ns[0] / NS_PER_US,
        "args": about,
    }
    yield begin
    yield {**begin, "ph": "e", "ts": ns[1] / NS_PER_US, "args": {}}
