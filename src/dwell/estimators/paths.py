"""Latency of cycles from the times of their parts: the longest path through the DAG."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.model.number_arrays import Floats
from dwell.model.pipeline import Flow, Pipeline


class Input(NamedTuple):
    """A flow into a task that waits for it."""

    flow: Flow
    #: Index of the flow in the pipeline.
    column: int
    #: Index of its source task in the pipeline.
    source: int


class Step(NamedTuple):
    """A task with its waited inputs, looked up once per pipeline."""

    task: str
    #: Index of the task in the pipeline.
    column: int
    #: Start of a source after the release.
    offset_ms: float
    inputs: tuple[Input, ...]
    #: Whether the task has no outputs.
    sink: bool


def steps_of(pipeline: Pipeline) -> tuple[Step, ...]:
    """Return the tasks of a pipeline in topological order."""
    place = {name: column for column, name in enumerate(pipeline.tasks)}
    columns = {flow: column for column, flow in enumerate(pipeline.flows)}
    return tuple(
        Step(
            name,
            place[name],
            float(pipeline.tasks[name].offset_ms),
            tuple(Input(f, columns[f], place[f.source]) for f in pipeline.waited(name)),
            not pipeline.outputs(name),
        )
        for name in pipeline.topological()
    )


def longest_path(
    steps: Sequence[Step],
    executed: Sequence[Floats],
    sent: Sequence[Floats | float],
    is_due: NDArray[np.bool_] | None = None,
) -> Floats:
    """Return the latency of each cycle, shape (n,), in the unit of its parts.

    The equation is eq. 3 of the paper, for any DAG. `executed` has the times of each task's jobs
    and `sent` the times of each flow's messages, in the pipeline's order and with shape (n,). The
    time of a message within a node is 0.0. `is_due` tells whether each task is due in each cycle,
    shape (n, tasks); only sinks that are due count [default: all].
    """
    finish: dict[int, Floats] = {}
    for step in steps:
        ready: Floats | float = step.offset_ms
        for number, entry in enumerate(step.inputs):
            arrived, message = finish[entry.source], sent[entry.column]
            # Skip 0.0: the sum would be the same.
            if not isinstance(message, float) or message:
                arrived = arrived + message
            ready = np.maximum(ready, arrived) if number else arrived
        executes = executed[step.column]
        if step.inputs or step.offset_ms:
            executes = ready + executes
        finish[step.column] = executes
    columns = [step.column for step in steps if step.sink]
    sinks = [finish[column] for column in columns]
    if is_due is not None:
        sinks = [np.where(is_due[:, column], finish[column], 0.0) for column in columns]
    latency: Floats = np.maximum.reduce(sinks) if len(sinks) > 1 else sinks[0]
    return latency
