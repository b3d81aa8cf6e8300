"""Speeds: the CPU speeds of a testbed's nodes in a run, and cells on slower CPUs.

The speed of a shared machine varies: the CPU time of the same work changes by a fifth within an
hour. The probes of a run repeat a fixed piece of work, independent of the cell
(`dwell_lab.testbed.probe`). A calibrated cell contains the CPU speeds of its calibration, and the
sensitivity of each stage to them. The prediction for a run uses the CPU speeds of that run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

import numpy as np

from dwell.model import FrozenDict, Problem, Trace
from dwell.model.process import TraceTable

if TYPE_CHECKING:
    from dwell.model import Execution, Process
    from dwell.record import Run


@dataclass(frozen=True, slots=True)
class Usual:
    """CPU speeds during the calibration of a cell, and the sensitivity of its stages to them.

    Parameters
    ----------
    work_ms : mapping of str to float
        CPU time of a probe's piece of work, by node.
    sensitivity : mapping of (str, str) to float
        Exponents by task and node: if the piece of work takes x times as long, the stage takes
        x**sensitivity times as long. The default is 1.
    """

    work_ms: Mapping[str, float] = FrozenDict()
    sensitivity: Mapping[tuple[str, str], float] = FrozenDict()

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Usual:
        """Read a calibration's report: ``work_ms`` by node, ``sensitivity`` by ``task@node``."""
        return cls(
            {str(node): float(ms) for node, ms in told.get("work_ms", {}).items()},
            {
                (task, node): float(value)
                for name, value in told.get("sensitivity", {}).items()
                for task, _, node in [str(name).partition("@")]
            },
        )

    def factors(self, took_ms: Mapping[str, float]) -> dict[str, float]:
        """Return the time of a probe's work relative to the calibration, by node."""
        return {
            node: took_ms[node] / usual_ms
            for node, usual_ms in self.work_ms.items()
            if node in took_ms
        }

    def factor(self, took_ms: Mapping[str, float], task: str, node: str) -> float:
        """Return the time of a stage relative to the calibration."""
        factor = self.factors(took_ms).get(node, 1.0)
        return float(factor ** self.sensitivity.get((task, node), 1.0))


def work_ms(run: Run) -> dict[str, float]:
    """Return the median CPU time of a probe's work over the counted windows, by node.

    Empty if the metadata of the run lack ``testbed`` or ``pressure``.
    """
    windows = window_work_ms(run)
    return {node: median(of.values()) for node, of in windows.items() if of}


def window_work_ms(run: Run) -> dict[str, dict[int, float]]:
    """Return the CPU time of a probe's work, by node and window, for the windows that count."""
    pressure, testbed = run.meta.get("pressure"), run.meta.get("testbed")
    if not isinstance(pressure, Mapping) or not isinstance(testbed, Mapping):
        return {}
    excluded = set(pressure.get("excluded", ()))
    warmup = run.problem.warmup_windows
    rows = {
        int(row["window"]): row["work_ms"]
        for row in pressure.get("windows", ())
        if row.get("work_ms") and row["window"] >= warmup and row["window"] not in excluded
    }
    works: dict[str, dict[int, float]] = {}
    for node, about in testbed.get("nodes", {}).items():
        cpus = [str(cpu) for cpu in about["cpus"]]
        works[node] = {
            window: fmean(row[cpu] for cpu in cpus if cpu in row)
            for window, row in rows.items()
            if not row.keys().isdisjoint(cpus)
        }
    return works


def at_speed_of(run: Run, problem: Problem, usual: Usual) -> Problem:
    """Return a cell on CPUs with the speeds of a run; `usual` has the calibration's speeds."""
    return slowed(problem, usual.factors(work_ms(run)), usual.sensitivity)


def slowed(
    problem: Problem,
    factors: Mapping[str, float],
    sensitivity: Mapping[tuple[str, str], float] = FrozenDict(),
) -> Problem:
    """Return a cell on CPUs that are slower by some factors.

    Parameters
    ----------
    factors : mapping of str to float
        Factors by node. They apply to measured values (replayed execution times, backgrounds);
        other values stay the same.
    sensitivity : mapping of (str, str) to float
        Exponents by task and node; see `Usual`.
    """
    if not factors:
        return problem
    tables = _tables(problem, factors, sensitivity)

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


def _tables(
    problem: Problem,
    factors: Mapping[str, float],
    sensitivity: Mapping[tuple[str, str], float],
) -> dict[int, TraceTable]:
    """Return the tables of replayed execution times with longer times, by ``id`` of the table."""
    longer: dict[int, tuple[TraceTable, dict[str, float]]] = {}
    for task in problem.pipeline.tasks.values():
        for node, of in task.on.items():
            # A slower CPU does not slow the accelerator.
            if isinstance(of.exec_ms, Trace) and node in factors and of.accelerator is None:
                table = of.exec_ms.table
                factor = factors[node] ** sensitivity.get((task.name, node), 1.0)
                longer.setdefault(id(table), (table, {}))[1][of.exec_ms.column] = factor
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
