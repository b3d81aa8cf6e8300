"""The longest path against all paths, and the rank of L95."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from random import Random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.estimators.paths import (
    longest_path,
    steps_of,
)
from dwell.model import Constant, Execution, Flow, Pipeline, Task

CYCLES = 3


def random_pipeline(rng: Random) -> Pipeline:
    """Any DAG of up to seven tasks, declared in any order; sources have offsets."""
    names = [f"T{i}" for i in range(rng.randint(1, 7))]
    order = rng.sample(names, len(names))
    share = rng.random()
    flows = [Flow(a, b) for a, b in itertools.combinations(order, 2) if rng.random() < share]
    rng.shuffle(flows)
    targets = {flow.target for flow in flows}
    tasks = {
        name: Task(
            name,
            {"R": Execution(Constant(1.0))},
            offset_ms=0.0 if name in targets else float(rng.randint(0, 9)),
        )
        for name in names
    }
    return Pipeline(tasks, tuple(flows), period_ms=100.0, deadline_ms=100.0)


def every_path(pipeline: Pipeline) -> Iterator[tuple[str, list[Flow]]]:
    """Yield every way from a source to a sink: the source, and the flows along it."""

    def onward(task: str, walked: list[Flow]) -> Iterator[list[Flow]]:
        outputs = [flow for flow in pipeline.flows if flow.source == task]
        if not outputs:
            yield walked
        for flow in outputs:
            yield from onward(flow.target, [*walked, flow])

    for name in pipeline.tasks:
        if not any(flow.target == name for flow in pipeline.flows):
            for walked in onward(name, []):
                yield name, walked


@given(st.integers(0, 10**9))
def test_the_longest_path_is_the_longest_of_all(seed: int) -> None:
    rng = Random(seed)
    pipeline = random_pipeline(rng)

    def drawn() -> list[int]:
        return [rng.randint(0, 20) for _ in range(CYCLES)]

    jobs = {name: drawn() for name in pipeline.tasks}
    messages = {flow: rng.choice([drawn(), [0] * CYCLES]) for flow in pipeline.flows}
    latency = longest_path(
        steps_of(pipeline),
        [np.array(jobs[name], float) for name in pipeline.tasks],
        # On one node a message may also be given as the number 0.
        [np.array(m, float) if any(m) else 0.0 for m in messages.values()],
    )
    for cycle in range(CYCLES):
        lengths = [
            pipeline.tasks[source].offset_ms
            + jobs[source][cycle]
            + sum(messages[flow][cycle] + jobs[flow.target][cycle] for flow in walked)
            for source, walked in every_path(pipeline)
        ]
        assert latency[cycle] == max(lengths)


def test_a_part_that_is_lost_loses_the_cycle() -> None:
    tasks = {n: Task(n, {"R": Execution(Constant(1.0))}) for n in ("A", "B", "C")}
    flows = (Flow("A", "C"), Flow("B", "C"))
    pipeline = Pipeline(tasks, flows, period_ms=100.0, deadline_ms=100.0)
    ones = np.ones(2)
    latency = longest_path(steps_of(pipeline), [ones, ones, ones], [np.array([1.0, np.inf]), 0.0])
    assert latency.tolist() == [3.0, math.inf]


def test_nothing_that_is_given_is_changed() -> None:
    tasks = {n: Task(n, {"R": Execution(Constant(1.0))}) for n in ("A", "B", "C", "D")}
    flows = (Flow("A", "D"), Flow("B", "D"), Flow("C", "D"))
    pipeline = Pipeline(tasks, flows, period_ms=100.0, deadline_ms=100.0)
    jobs = [np.array([float(i)]) for i in range(4)]
    sent = [np.array([float(10 - i)]) for i in range(3)]
    longest_path(steps_of(pipeline), jobs, sent)
    assert [float(x[0]) for x in jobs] == [0.0, 1.0, 2.0, 3.0]
    assert [float(x[0]) for x in sent] == [10.0, 9.0, 8.0]
