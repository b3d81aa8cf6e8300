"""Speeds: how fast the CPUs of a testbed's nodes were in a run, and a cell on slower ones.

A machine that others share is now faster and now slower: what the same work takes of a CPU's time
changes by a fifth within the hour. The probes of a run do a fixed piece of work all the time
(`dwell.testbed.probe`), and know nothing of the cell. A calibrated cell says how fast the CPUs were
that it was measured on; a run that is compared with it is predicted on CPUs as fast as its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from dwell.model import Problem, Trace
from dwell.model.bounds import CONTENTION
from dwell.model.process import TraceTable

if TYPE_CHECKING:
    from dwell.model import Execution, Process

__all__ = ["at_speed_of", "slowed", "work_ms"]


def work_ms(meta: Mapping[str, Any]) -> dict[str, float]:
    """CPU time of a probe's piece of work on every node's CPUs, the median of windows that count.

    Parameters
    ----------
    meta : mapping
        Of a run. Without ``testbed``, or without what its probes did, nothing is known.
    """
    pressure, testbed = meta.get("pressure"), meta.get("testbed")
    if not isinstance(pressure, Mapping) or not isinstance(testbed, Mapping):
        return {}
    excluded = set(pressure.get("excluded", ()))
    warmup = int(meta.get("problem", {}).get("warmup_windows", 0))
    rows = [
        row["work_ms"]
        for row in pressure.get("windows", ())
        if row.get("work_ms") and row["window"] >= warmup and row["window"] not in excluded
    ]
    found = {}
    for node, about in testbed.get("nodes", {}).items():
        took = [row[str(cpu)] for row in rows for cpu in about["cpus"] if str(cpu) in row]
        if took:
            found[node] = median(took)
    return found


def at_speed_of(
    meta: Mapping[str, Any], problem: Problem, usual_ms: Mapping[str, float]
) -> Problem:
    """Return a cell on CPUs as fast as they were in a run.

    Parameters
    ----------
    meta : mapping
        Of the run.
    problem : Problem
    usual_ms : mapping of str to float
        CPU time of a probe's piece of work, by node, where the cell was measured.
    """
    took = work_ms(meta)
    return slowed(problem, {node: took[node] / usual_ms[node] for node in usual_ms if node in took})


def slowed(problem: Problem, factors: Mapping[str, float]) -> Problem:
    """Return a cell on CPUs on which everything takes so many times as long.

    Parameters
    ----------
    problem : Problem
    factors : mapping of str to float
        By node. What was measured takes longer (execution times that are replayed, backgrounds,
        what others take); what was not stays as it is.
    """
    if not factors:
        return problem
    tables = _tables(problem, factors)

    def moved(process: Process) -> Process:
        if isinstance(process, Trace) and id(process.table) in tables:
            return replace(process, table=tables[id(process.table)])
        return process

    def execution(of: Execution) -> Execution:
        return replace(of, exec_ms=moved(of.exec_ms))

    pipeline = problem.pipeline
    tasks = {
        name: replace(task, on={node: execution(of) for node, of in task.on.items()})
        for name, task in pipeline.tasks.items()
    }
    nodes = {}
    for name, node in problem.fabric.nodes.items():
        factor = min(factors.get(name, 1.0), 0.9 * node.capacity / max(node.background, 1e-9))
        beside = node.background_beside
        nodes[name] = replace(
            node,
            background=node.background * factor,
            background_beside=None if beside is None else beside * factor,
            contention=min(node.contention * factor, CONTENTION.high),
        )
    links = {
        name: replace(link, delay_ms=moved(link.delay_ms))
        for name, link in problem.fabric.links.items()
    }
    return replace(
        problem,
        pipeline=replace(pipeline, tasks=tasks),
        fabric=replace(problem.fabric, nodes=nodes, links=links),
    )


def _tables(problem: Problem, factors: Mapping[str, float]) -> dict[int, TraceTable]:
    """Tables that nodes' execution times are replayed from, with longer ones, by their identity."""
    longer: dict[int, tuple[TraceTable, dict[str, float]]] = {}
    for task in problem.pipeline.tasks.values():
        for node, of in task.on.items():
            # An accelerator is not slower where CPUs are.
            if isinstance(of.exec_ms, Trace) and node in factors and of.accelerator is None:
                table = of.exec_ms.table
                longer.setdefault(id(table), (table, {}))[1][of.exec_ms.column] = factors[node]
    return {
        key: replace(
            table,
            columns={
                name: np.asarray(values * columns.get(name, 1.0))
                for name, values in table.columns.items()
            },
        )
        for key, (table, columns) in longer.items()
    }
