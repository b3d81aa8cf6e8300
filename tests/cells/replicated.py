"""Problems whose candidates include replicas, made at random from problems without."""

from __future__ import annotations

from dataclasses import replace
from random import Random

from dwell.model import Placement, Problem, Replicas


def with_replicas(problem: Problem, rng: Random, *, whole_ms: bool = False) -> Problem:
    """Add a candidate S, and replicas of the first candidate and S, if some task can move."""
    pipeline = problem.pipeline
    name, here = next(iter(problem.candidates.items()))
    source = next(task for task in pipeline.tasks if not pipeline.inputs(task))
    fixed = {source, *(task for task in pipeline.tasks if not pipeline.outputs(task))}
    there = dict(here.first)
    for task, on in ((task, pipeline.tasks[task].on) for task in pipeline.tasks):
        others = [node for node in on if node != here[task]]
        if task not in fixed and others and rng.random() < 0.8:
            there[task] = rng.choice(others)
    if there == here:
        return problem
    members = {name: here, "S": Placement(there)}
    after_ms = rng.choice([0.0, rng.uniform(0, pipeline.deadline_ms)])
    if whole_ms:
        after_ms = float(min(round(after_ms), int(pipeline.deadline_ms)))
    swapped = dict(reversed(members.items()))
    return replace(
        problem,
        candidates={
            **problem.candidates,
            "S": members["S"],
            "BOTH": Replicas(members, after_ms),
            "SWAP": Replicas(swapped, rng.choice([0.0, after_ms])),
        },
    )
