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
from dwell.cellfile import from_document
from dwell.control import Controller, plain_rule
from dwell.errors import PolicyError
from dwell.model import Caps, Objective, Problem, Targets, Weights
from dwell.model.fabric import accelerator_tiers
from dwell.policies import ATP, DTP, Cusum, LatencyFirst, Static
from dwell.sim.engine import simulate_realisation
from tests.cells.generated import random_problem

CELL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
EXAMPLES = int(os.environ.get("DWELL_EXAMPLES", "30"))


#: 5 ms less of a target of 100 ms are 0.05 of J: in floats sometimes a little more or less.
EXACT: dict[str, Callable[[dict[str, Any]], Any]] = {
    "dtp": lambda given: DTP(**given, min_dwell=0, min_improvement=0.05),
    "cusum": lambda given: Cusum(**given, threshold=0.0, slack=0.05),
    "a sum": lambda given: Cusum(**given, threshold=0.05, slack=0.0, memory=1e-12),
    "a move": lambda given: Cusum(**given, threshold=0.0, slack=0.0),
    "atp": lambda given: ATP(**given, latency_ms=0.0, min_dwell=0, every_ms=1.0),
}


def of_two_latencies(here_ms: float, there_ms: float, switching: float) -> Problem:
    """Return a cell of one stage, with its time on the robot and on the edge."""
    return from_document(
        {
            "dwell": 1,
            "period_ms": 200,
            "window_cycles": 2,
            "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
            "tasks": {"a": {"on": {"R": {"exec_ms": here_ms}, "E": {"exec_ms": there_ms}}}},
            "candidates": {"LOC": {"a": "R"}, "SO": {"a": "E"}},
            "objective": {
                "weights": {
                    "latency": 1, "violations": 1, "robot": 0, "edge": 0, "switching": switching,
                },
                "targets": {"latency_ms": 100},
            },
        }
    )  # fmt: skip


@pytest.mark.parametrize("rule", EXACT)
def test_a_gain_equal_to_what_it_must_exceed_moves_nothing(rule: str) -> None:
    for here_ms in range(10, 100, 5):
        # For ATP and `a move` the price of the move is equal to the gain.
        problem = of_two_latencies(here_ms, here_ms - 5, 0.05 if rule in ("atp", "a move") else 0.0)
        given = {"candidates": problem.candidates, "objective": problem.objective}
        assert plain_rule(Controller(problem, EXACT[rule](given), "profile")) is not None
        real = dwell.draw(problem, seed=1, windows=5)
        for by_window in (False, True):
            policy = EXACT[rule](given)
            run = simulate_realisation(
                problem, real, policy=policy, estimator="profile", by_window=by_window
            )
            assert run.decisions["migrated"].sum() == 0, (here_ms, by_window)


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
    if seed % 2:
        every = rng.randint(1, problem.window_cycles)
        problem = replace(problem, controller=replace(problem.controller, decide_cycles=every))
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
