"""Task costs: time that every task takes of every node, its share of messaging included.

A job costs its node more CPU than its stage takes: its worker reads and writes messages, and at
both ends of the pipeline a stamp and a command are handed over. A simulator that knows nothing of
messages on one node, and of what they cost, is told so by way of the execution times:

- a worker's CPU time is idle · wall + Σ (stage + overhead) over its jobs. Runs in which it has jobs
  and runs in which it has none tell the two apart; a worker that always has jobs idles like others;
- of the overhead, what delays messages (`dwell_lab.testbed.message_costs`) delays the cycle;
- a job takes, besides, what passes between its last input and its start, and a sink's what passes
  between its end and the command's hand-over, as where the quota does not interfere;
- where something counts what a node takes between a release and its source's start, or between two
  jobs of a cycle that both run on it, the job takes that: whoever takes it, the job waits for it.
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

#: How many times as long as usual messaging takes where a stage takes longer: in the runs of the
#: example as many as that, window by window; a job that finds nothing to do has its messages still.
SLOWER = 0.5, 2.0
#: Sides of a hop, in its times and, behind source and target, in its name.
SENDER, RECEIVER = range(2)


@dataclass(frozen=True, slots=True)
class TaskCost:
    """Cost of a task on a node, over all runs.

    Parameters
    ----------
    samples : dict of str to Part
        Time that an undisturbed job takes of the node, its share of messaging included, by run.
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
        """Samples of all runs, one after the other."""
        return np.concatenate([part.times_ms for part in self.samples.values()])


def task_costs(
    measured: Sequence[Measured],
    messaging_ms: Mapping[SiteName, float],
    known: OnTheWay,
    problem: Problem,
    usual: Usual,
) -> dict[SiteName, TaskCost]:
    """Execution times of every task on every node that was visited undisturbed.

    Parameters
    ----------
    messaging_ms : mapping of (str, str) to float
        CPU time that a worker takes for a job besides its stage (`messaging`).
    known : OnTheWay
        Part of that which lies on the way of messages.
    usual : Usual
        How fast the CPUs were in all runs together: samples are of CPUs as fast as that.
    """
    costs: dict[SiteName, TaskCost] = {}
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
        costs[site] = TaskCost(samples, stage_ms, read_ms + write_ms, before_ms, after_ms)
    return costs


def _with_messaging(stages_ms: Floats, mean_ms: float, around_ms: float) -> Floats:
    """Add the time around a stage, which is longer where the stage is."""
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
    of: dict[SiteName, list[tuple[float, float]]] = {}
    for one in measured:
        for (node, process), rate in one.rates.items():
            task, _, rest = process.partition("@")
            worker = task in problem.pipeline.tasks and rest == node
            if not worker or node in one.disturbed.nodes:
                continue
            jobs = one.starts.get((task, node, False), 0.0)
            # Cores besides those of the stage, and jobs a millisecond.
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
