"""Task costs: the time of every task on every node, including its share of messaging.

A job costs its node more CPU time than its stage: the worker reads and writes messages, and both
ends of the pipeline hand over a stamp or a command. The simulator has no model of messages within a
node, so the execution times include these costs:

- A worker's CPU time is idle · wall + Σ (stage + overhead) over its jobs. The fit of idle and
  overhead uses runs with jobs and runs without. For a worker that always has jobs, idle is the mean
  of the other workers.
- The part of the overhead that delays messages (`dwell_lab.testbed.message_costs`) delays the
  cycle.
- A job also includes the time between its last input and its start. A sink's job also includes the
  time until the hand-over of the command. Both exclude delays by the quota.
- Some runs count the CPU time of a node between a release and the start of its source, or between
  two jobs of a cycle on the node. The job includes this time, because it waits for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dwell.model import Flow, Problem
from dwell.model.number_arrays import Floats
from dwell_lab.testbed.measured import LEAST_JOBS, Measured, SiteName
from dwell_lab.testbed.message_costs import OnTheWay, share
from dwell_lab.testbed.paired import Part
from dwell_lab.testbed.speeds import Usual

#: Bounds on the factor by which messaging is longer when a stage is longer than its mean. In the
#: windows of the example's runs both factors are equal; a job without work still has its messages.
SLOWER = 0.5, 2.0
#: Indices of the sides in a hop's times and, after source and target, in its name.
SENDER, RECEIVER = range(2)


@dataclass(frozen=True, slots=True)
class TaskCost:
    """Cost of a task on a node, over all runs.

    Parameters
    ----------
    samples : dict of str to Part
        Node time of undisturbed jobs, including their share of messaging, by run.
    stage_ms, messaging_ms : float
        Means of the stage alone, and of the worker's messaging that delays the cycle.
    before_ms, after_ms : float
        Mean times before the stage (input or release, messaging) and after it (messaging, end of
        the cycle).
    """

    samples: dict[str, Part]
    stage_ms: float
    messaging_ms: float
    before_ms: float
    after_ms: float

    @property
    def samples_ms(self) -> Floats:
        """Samples of all runs, concatenated."""
        return np.concatenate([part.times_ms for part in self.samples.values()])


def task_costs(
    measured: Sequence[Measured],
    messaging_ms: Mapping[SiteName, float],
    known: OnTheWay,
    problem: Problem,
    usual: Usual,
) -> dict[SiteName, TaskCost]:
    """Return the costs of every task on every node with enough undisturbed jobs.

    Parameters
    ----------
    messaging_ms : mapping of (str, str) to float
        CPU time of a worker per job beyond its stage (`messaging`).
    known : OnTheWay
        The part of this time that delays messages.
    usual : Usual
        Mean CPU speeds of all runs; the samples are scaled to them.
    """
    costs: dict[SiteName, TaskCost] = {}
    for site in sorted({site for one in measured for site in one.visits}):
        of = [one for one in measured if site in one.visits and site[1] not in one.disturbed.nodes]
        if sum(len(one.visits[site].stage_ms) for one in of) < LEAST_JOBS:
            continue
        # Scale the times to the runs' mean CPU speed.
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
        costs[site] = TaskCost(samples, stage_ms, read_ms + write_ms, before_ms, after_ms)
    return costs


def _with_messaging(stages_ms: Floats, mean_ms: float, around_ms: float) -> Floats:
    """Add the time around a stage to its times, in proportion to them within `SLOWER`."""
    if mean_ms <= 0:
        return stages_ms + around_ms
    return stages_ms + around_ms * np.clip(stages_ms / mean_ms, *SLOWER)


def _on_the_way_ms(
    site: SiteName, messaging_ms: float, known: OnTheWay, problem: Problem
) -> tuple[float, float]:
    """Return a worker's messaging time that delays inputs, and outputs; all of it if unknown."""
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
    """Return the CPU time of every worker per job beyond its stage, in ms, by task and node."""
    of: dict[SiteName, list[tuple[float, float]]] = {}
    for one in measured:
        for (node, process), rate in one.rates.items():
            task, _, rest = process.partition("@")
            worker = task in problem.pipeline.tasks and rest == node
            if not worker or node in one.disturbed.nodes:
                continue
            jobs = one.starts.get((task, node, False), 0.0)
            # Cores used beyond the stage, and jobs per millisecond.
            besides = rate - jobs * one.spent_ms.get((task, node, False), 0.0) / 1e3
            of.setdefault((task, node), []).append((jobs / 1e3, besides))
    idle: list[float] = []
    always: dict[SiteName, tuple[Floats, Floats]] = {}
    overhead_ms: dict[SiteName, float] = {}
    for site, points in of.items():
        jobs, besides = np.array(points).T
        if jobs.max() == 0.0:
            idle.append(max(float(besides.mean()), 0.0))
        elif np.ptp(jobs) > 0.5 * jobs.max():
            slope, start = np.polyfit(jobs, besides, 1)
            idle.append(max(float(start), 0.0))
            overhead_ms[site] = max(float(slope), 0.0)
        else:
            always[site] = jobs, besides
    usual = float(np.mean(idle)) if idle else 0.0
    for site, (started, spent) in always.items():
        overhead_ms[site] = max(float((spent - usual).mean() / started.mean()), 0.0)
    return overhead_ms
