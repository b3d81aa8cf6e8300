"""PagedCell: interface of a live or recorded cell to the page.

A page shows one or more cells on one time line. Page and server exchange instants as places on the
time line: seconds since the first release, or numbers of cycles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

from dwell.display import placement_hues
from dwell.model import Link, Placement, Problem, Trace
from dwell.model.bounds import counted
from dwell.model.placement import nodes_of
from dwell.study.metric import METRICS

RATE = METRICS["violation_rate"]
#: Unit of places on the time line: seconds or cycles.
Unit: TypeAlias = Literal["s", "cycle"]
#: Plain values, ready for JSON.
Plain: TypeAlias = dict[str, Any]

#: Health and headline of a recorded run before the end of its first window.
UNMEASURED, NO_WINDOW = "unmeasured", "no window has closed yet"
#: Largest number of cycles in one answer with jobs.
MOST_WITH_JOBS = 200


class PagedCell(Protocol):
    """Interface of a cell to the page; methods may be called from any thread."""

    live: bool

    def described(self) -> Plain:
        """Return the constant data of the cell, and the begin and end of its time line."""

    def view(self, begin: float, end: float, bins: int) -> Plain:
        """Return the data of the charts between two places, in at most `bins` bins."""

    def state(self, at: float) -> Plain:
        """Return the state of the cell at a place; of a live cell, the current state."""

    def jobs(self, begin: float, end: float) -> Plain:
        """Return the known jobs of the cycles between two places."""

    def refreshed(self) -> bool:
        """Read new data; return whether there are any since the last call."""


def cell_document(problem: Problem) -> Plain:
    """Return the constant data of a cell: its computers, links, stages and candidates."""
    fabric, pipeline = problem.fabric, problem.pipeline
    hues = placement_hues(problem.candidates)
    return {
        "name": problem.name,
        "period_ms": pipeline.period_ms,
        "deadline_ms": pipeline.deadline_ms,
        "window_cycles": problem.window_cycles,
        "dwell_cycles": problem.dwell_cycles,
        "weighs_age": problem.objective.weighs_age,
        "weighs_price": problem.objective.weighs_price,
        "nodes": [
            {"name": node.name, "tier": node.tier, "cores": node.cores}
            for node in fabric.nodes.values()
        ],
        "links": [
            {"source": link.source, "target": link.target, "text": _link(link)}
            for link in fabric.links.values()
        ],
        "tasks": [
            {"name": name, "on": list(pipeline.tasks[name].on)} for name in pipeline.topological()
        ],
        "flows": [[flow.source, flow.target] for flow in pipeline.flows],
        "candidates": [
            {"name": name, "hue": hues[name], "nodes": _nodes(placement)}
            for name, placement in problem.candidates.items()
        ],
        "resources": [
            {"name": one.name, "node": one.node, "kind": one.kind or "CPU"}
            for one in fabric.resources.values()
        ],
    }


def _nodes(placement: Placement) -> dict[str, list[str]]:
    """Return the nodes of each task: of one copy, or of both."""
    return {task: list(nodes_of(nodes)) for task, nodes in placement.items()}


class TimedCycle(NamedTuple):
    """A cycle whose jobs are shown; without a latency it is lost or incomplete."""

    number: int
    release_ns: int
    latency_ms: float | None
    missed: bool


def jobs_document(
    cycles: Sequence[TimedCycle], jobs: Iterable[Mapping[str, Any]], *, known: bool = True
) -> Plain:
    """Return cycles and their jobs; times are in ms since the earliest of these releases."""
    origin_ns = min((cycle.release_ns for cycle in cycles), default=0)

    def since(at_ns: int | None) -> float | None:
        return None if at_ns is None else (at_ns - origin_ns) / 1e6

    return {
        "origin_s": origin_ns / 1e9,
        "jobs": [
            {
                **{name: str(job[name]) for name in ("task", "node", "outcome")},
                **{f"{name}_ms": since(job[f"{name}_ns"]) for name in ("ready", "start", "end")},
                "cycle": job["cycle"],
                "shadow": bool(job.get("shadow")),
                "second": bool(job.get("second")),
            }
            for job in jobs
        ],
        "cycles": [
            {
                "cycle": cycle.number,
                "release_ms": since(cycle.release_ns),
                "latency_ms": cycle.latency_ms,
                "missed": cycle.missed,
            }
            for cycle in cycles
        ],
        "known": known,
    }


def _link(link: Link) -> str:
    """Return the label of a link: its delay and, if limited, its rate."""
    delay = "as recorded" if isinstance(link.delay_ms, Trace) else None
    parts = [delay or f"{link.delay_ms.expectation:.3g} ms"]
    if not math.isinf(link.rate_mbps):
        parts.append(f"{link.rate_mbps:.4g} Mbit/s")
    return ", ".join(parts)


def health_by(problem: Problem, rates: list[float]) -> Mapping[str, str | None]:
    """Return health and headline of a cell from V_D of its last windows alone."""
    if not rates:
        return {"health": UNMEASURED, "headline": NO_WINDOW}
    if not problem.live.degraded_by(rates):
        return {"health": "ok", "headline": None}
    rate = sum(rates) / len(rates)
    return {
        "health": "degraded",
        "headline": f"{RATE.name} is {RATE.text(rate)} in the last {counted(len(rates), 'window')}",
    }
