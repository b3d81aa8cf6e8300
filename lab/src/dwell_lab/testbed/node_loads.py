"""Node loads: the background load of nodes, and the slowdown of jobs on stressed nodes.

The background contains all CPU time of a node outside the costs of tasks: agents, stampers, sinks,
the controller, workers without jobs, and messaging that does not delay the cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dwell.model import Problem
from dwell.model.bounds import BACKGROUND_HZ
from dwell_lab.testbed.measured import LEAST_JOBS, Measured, SiteName
from dwell_lab.testbed.speeds import Usual
from dwell_lab.testbed.task_costs import TaskCost

#: Mean size of a group of simultaneous wakes: a message wakes a thread that waits for sockets, a
#: reader and a worker. In a scheduler trace of the example, the times between an instant and the
#: next wake or sleep match independent wakes at 0.40 (E) to 0.52 (R1) of the measured rate.
TOGETHER = 2.2


def backgrounds(
    measured: Sequence[Measured], costs: Mapping[SiteName, TaskCost], problem: Problem
) -> dict[str, float]:
    """Return the background of every node in cores, from runs without disturbance of the node.

    For a node with a quota the total is from its control group. Otherwise other processes may use
    the same CPUs, so the total contains only the cell's processes.
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
            jobs = sum(rate * _cores_ms(key, one, costs, problem) / 1e3 for key, rate in sites_)
            left.append((used - jobs, one.windows))
        if left:
            values, weights = zip(*left, strict=True)
            mean = float(np.average(values, weights=weights))
            result[node] = min(max(mean, 0.0), 0.9 * of.capacity)
    return result


def beside_jobs(measured: Sequence[Measured], behind: Mapping[str, float]) -> dict[str, float]:
    """Return the cores of every node's background during its jobs, if they are measured."""
    result = {}
    for node, cores in behind.items():
        of = [
            one.beside[node] for one in measured if node in one.beside.keys() - one.disturbed.nodes
        ]
        if (taken := _cores(of)) is not None:
            result[node] = min(taken, cores)
    return result


def _cores(of: Sequence[tuple[float, float]]) -> float | None:
    """Return the CPU time during jobs divided by their duration; None if no job ran."""
    took_s = sum(took for _, took in of)
    return sum(taken for taken, _ in of) / took_s if took_s > 0 else None


def wakes(measured: Sequence[Measured], problem: Problem) -> dict[str, float]:
    """Return the groups of wakes per second, for nodes whose quota is checked at ticks."""
    result = {}
    for name, node in problem.fabric.nodes.items():
        counted = [one.run.meta.get("wakes_hz") or {} for one in measured]
        known = [float(of[name]) for of in counted if name in of]
        if known and node.quota is not None and node.quota.tick_ms > 0:
            result[name] = min(sum(known) / len(known) / TOGETHER, BACKGROUND_HZ.high)
    return result


def interferences(
    measured: Sequence[Measured], costs: Mapping[SiteName, TaskCost], usual: Usual
) -> dict[str, float]:
    """Return the factor on core time of stages, for nodes that were stressed all the time."""
    sums: dict[str, list[float]] = {}
    for one in measured:
        for site, visit in one.visits.items():
            node = site[1]
            if node in one.disturbed.stressed and site in costs:
                total = sums.setdefault(node, [0.0, 0.0, 0.0])
                total[0] += float(visit.stage_ms.sum()) / usual.factor(one.work_ms, *site)
                total[1] += len(visit.stage_ms) * costs[site].stage_ms
                total[2] += len(visit.stage_ms)
    return {
        node: max(took / alone, 1.0)
        for node, (took, alone, jobs) in sums.items()
        if jobs >= LEAST_JOBS
    }


def _cores_ms(
    key: tuple[str, str, bool],
    one: Measured,
    costs: Mapping[SiteName, TaskCost],
    problem: Problem,
) -> float:
    """Return the core time of a job in the simulator, ms."""
    execution = problem.pipeline.tasks[key[0]].on[key[1]]
    if execution.accelerator is not None:
        return 0.0
    site = costs.get(key[:2])
    if site is None:
        return one.spent_ms[key]
    return one.spent_ms[key] + execution.threads * (site.before_ms + site.after_ms)
