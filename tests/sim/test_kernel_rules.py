"""What the kernel decides at closes is, to the last bit, what the policies' classes decide."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

import dwell
from dwell.control import Controller, plain_rule
from dwell.errors import PolicyError
from dwell.model import Caps, Objective, Problem, Targets, Weights
from dwell.model.fabric import accelerator_tiers
from dwell.policies import ATP, DTP, Cusum, LatencyFirst, Static
from dwell.sim.engine import simulate_realisation
from tests.cells.generated import random_problem

CELL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
EXAMPLES = int(os.environ.get("DWELL_EXAMPLES", "60"))


def objective_of(rng: Random, problem: Problem) -> Objective:
    """Weights, targets and caps that decide now this way, now that; some nodes are in the cloud."""
    apart = rng.random() < 0.5
    tiers: dict[str, Any] = {
        node: rng.choice(["robot", "edge", "cloud"]) for node in problem.fabric.nodes
    }
    weights = Weights(
        latency=1.0,
        violations=rng.choice([0.0, 0.3, 1.0]),
        robot=rng.choice([0.0, 0.3, 1.0]),
        edge=rng.choice([0.0, 0.3, 1.0]),
        switching=rng.choice([0.0, 0.05, 0.5]),
        cloud=rng.choice([0.2, 1.0]) if apart else None,
    )
    targets = Targets(
        rng.choice([20.0, problem.pipeline.deadline_ms]),
        robot=rng.choice([0.2, 0.7]),
        edge=rng.choice([0.2, 0.7]),
        cloud=0.5 if apart else None,
    )
    caps = rng.choice(
        [
            Caps(),
            Caps(latency_ms=rng.uniform(0.2, 2.0) * problem.pipeline.period_ms),
            Caps(utilisation=rng.uniform(0.05, 1.0)),
            Caps(rng.uniform(0.2, 2.0) * problem.pipeline.period_ms, rng.uniform(0.05, 1.0)),
        ]
    )
    accelerators = accelerator_tiers(problem.fabric.nodes, tiers) if rng.random() < 0.5 else {}
    return Objective(weights, targets, caps, tiers, accelerators)


def policy_of(rng: Random, problem: Problem) -> Any:
    """One of our policies with parameters at random."""
    common: dict[str, Any] = {"candidates": problem.candidates, "initial": problem.initial}
    priced = {**common, "objective": problem.objective}
    window_ms = problem.window_cycles * problem.pipeline.period_ms
    kinds: list[Callable[[], Any]] = [
        lambda: DTP(
            **priced,
            min_dwell=rng.randint(0, 4),
            min_improvement=rng.choice([0.0, 0.05, 0.3]),
            escape=rng.random() < 0.5,
        ),
        lambda: Cusum(
            **priced,
            threshold=rng.choice([0.0, 0.1, 0.5]),
            slack=rng.choice([0.0, 0.05]),
            memory=rng.uniform(0.2, 1.0),
        ),
        lambda: LatencyFirst(**(priced if rng.random() < 0.5 else common)),
        lambda: Static(**(priced if rng.random() < 0.5 else common)),
        lambda: ATP(
            **priced,
            latency_ms=rng.choice([None, 0.0, 30.0]),
            robot=rng.choice([None, 0.0, 0.3]),
            edge=rng.choice([None, 0.0, 0.3]),
            min_dwell=rng.randint(0, 3),
            every_ms=rng.choice([1.0, 2.6, 4.0]) * window_ms,
        ),
    ]
    policy = None
    while policy is None:
        try:
            policy = rng.choice(kinds)()
        except PolicyError:
            continue  # no two candidates make a pair for ATP
    return policy


@pytest.mark.parametrize("seed", range(EXAMPLES))
def test_the_kernel_decides_as_the_classes_do(seed: int) -> None:
    rng = Random(seed)
    problem = random_problem(rng, orders=rng.random() < 0.9, whole_ms=rng.random() < 0.3)
    problem = replace(problem, objective=objective_of(rng, problem))
    policy = policy_of(rng, problem)
    assert plain_rule(Controller(problem, policy)) is not None
    real = dwell.draw(problem, scenario="disturbed", seed=seed, windows=rng.randint(5, 30))
    runs = [
        simulate_realisation(problem, real, policy=policy, estimator="profile", by_window=by_window)
        for by_window in (False, True)
    ]
    for name in ("cycles", "windows", "decisions"):
        found, expected = (getattr(run, name) for run in runs)
        assert found.schema == expected.schema
        for column in expected.columns:
            # Floats, too: equal and not close.
            assert found[column].equals(expected[column], check_dtypes=True), (name, column)
