"""Latency of cycles from the times of their parts: the longest path through the DAG."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dwell.model.number_arrays import Floats
from dwell.model.pipeline import Flow, Pipeline


class Input(NamedTuple):
    """A flow into a task.

    Parameters
    ----------
    column : int
        Place of the flow in the pipeline.
    source : int
        Place of its source among the pipeline's tasks.
    """

    flow: Flow
    column: int
    source: int


class Step(NamedTuple):
    """A task with what its start depends on, looked up once for a pipeline.

    Parameters
    ----------
    column : int
        Place of the task in the pipeline.
    offset_ms : float
        Start of a source after the release.
    sink : bool
        Whether it has no outputs.
    """

    task: str
    column: int
    offset_ms: float
    inputs: tuple[Input, ...]
    sink: bool


def steps_of(pipeline: Pipeline) -> tuple[Step, ...]:
    """Return the tasks of a pipeline so that every flow points forward."""
    place = {name: column for column, name in enumerate(pipeline.tasks)}
    columns = {flow: column for column, flow in enumerate(pipeline.flows)}
    return tuple(
        Step(
            name,
            place[name],
            float(pipeline.tasks[name].offset_ms),
            tuple(Input(f, columns[f], place[f.source]) for f in pipeline.inputs(name)),
            not pipeline.outputs(name),
        )
        for name in pipeline.topological()
    )


def longest_path(
    steps: Sequence[Step], executed: Sequence[Floats], sent: Sequence[Floats | float]
) -> Floats:
    """Latency of each cycle, in the unit of its parts (paper, eq. 3, for any DAG).

    Parameters
    ----------
    steps : sequence of Step
        Steps of the pipeline (see `steps_of`).
    executed : sequence of float64 array, shape (n,)
        Time of every task's job in each cycle, in the pipeline's order.
    sent : sequence of float64 array of shape (n,), or float
        Time of every flow's message in each cycle, in the pipeline's order; 0.0 on one node.

    Returns
    -------
    float64 array, shape (n,)
    """
    finish: dict[int, Floats] = {}
    for step in steps:
        ready: Floats | float = step.offset_ms
        for number, entry in enumerate(step.inputs):
            arrived, message = finish[entry.source], sent[entry.column]
            # Times are not negative: adding 0.0 changes no bit.
            if not isinstance(message, float) or message:
                arrived = arrived + message
            ready = np.maximum(ready, arrived) if number else arrived
        executes = executed[step.column]
        if step.inputs or step.offset_ms:
            executes = ready + executes
        finish[step.column] = executes
    sinks = [finish[step.column] for step in steps if step.sink]
    latency: Floats = np.maximum.reduce(sinks) if len(sinks) > 1 else sinks[0]
    return latency
