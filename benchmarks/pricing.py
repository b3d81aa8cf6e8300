"""Pricing a close: what an estimator that learns takes to learn from a window and to price."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from random import Random

import numpy as np

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from dwell.estimators import Corrected, Evidence
from dwell.model import (
    Execution,
    Fabric,
    Flow,
    Link,
    LogNormal,
    Node,
    NodeDisturbance,
    Objective,
    Pipeline,
    Placement,
    Problem,
    QoS,
    Targets,
    Task,
    Weights,
)

#: Tasks and candidates of the large cell, and where its tasks may run.
TASKS, CANDIDATES, PLACES = 30, 20, ("R", "E")


class Timed(Corrected):
    """`Corrected` that notes what each window took, seconds; copies of it are itself."""

    def __deepcopy__(self, memo: object) -> Timed:
        return self

    def start(self, problem: Problem) -> None:
        """Forget everything, but not what windows took."""
        super().start(problem)
        self.taken_s: list[float] = []

    def learn(self, evidence: Evidence) -> None:
        """Learn from a window."""
        begun = time.process_time()
        super().learn(evidence)
        self.taken_s.append(time.process_time() - begun)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Price the candidates."""
        begun = time.process_time()
        estimates = super().estimate(observed=observed, incumbent=incumbent, own=own)
        self.taken_s[-1] += time.process_time() - begun
        return estimates

    @property
    def cycles(self) -> int:
        """Cycles that have been played."""
        return self._player.cycles


def measure(quick: bool) -> Section:
    """Microseconds a close, undisturbed and from the third window on beside foreign threads."""
    windows, rounds = (60, 2) if quick else (300, 5)
    canonical = dwell.load(CELL)
    step = NodeDisturbance("R1", at_s=windows * 1.1, for_s=windows * 1.1, stress_threads=4)
    small = replace(canonical, scenarios={**canonical.scenarios, "step": (step,)})
    figures, notes = [], []
    cells = {
        "3 candidates of 4 tasks": (small, Goal(high=300)),
        f"{CANDIDATES} candidates of {TASKS} tasks": (_large(windows), Goal(high=5_000)),
    }
    for name, (problem, goal) in cells.items():
        taken, played = [], 0
        for seed in range(rounds):
            estimator = Timed(problem)
            dwell.simulate(
                problem,
                scenario="step",
                policy="dtp",
                estimator=estimator,
                seed=seed,
                windows=windows,
            )
            taken.append(np.array(estimator.taken_s) * 1e6)
            played += estimator.cycles
        figures.append(Figure(name, [float(one.mean()) for one in taken], "µs", goal))
        longest = [float(np.quantile(one, 0.99)) for one in taken]
        figures.append(Figure(f"{name}, 99th percentile", longest, "µs", None))
        each = played / (rounds * windows * len(problem.candidates))
        notes.append(f"{name}: {each:.0f} cycles played a candidate and window in the mean")
    return Section(f"Pricing a close, {windows} windows, a third of them disturbed", figures, notes)


def _large(windows: int) -> Problem:
    """A chain of tasks on two nodes, placed at random."""
    rng = Random(1)
    names = [f"T{i}" for i in range(TASKS)]
    on = {place: Execution(LogNormal(1.0, 0.2)) for place in PLACES}
    placed = {
        f"C{i}": Placement({name: rng.choice(PLACES) for name in names}) for i in range(CANDIDATES)
    }
    step = NodeDisturbance("R", at_s=windows * 3.3, for_s=windows * 3.3, stress_threads=4)
    return Problem(
        name="large",
        pipeline=Pipeline(
            tasks={name: Task(name, on=on) for name in names},
            flows=tuple(Flow(one, other, 1000) for one, other in pairwise(names)),
            period_ms=100.0,
            deadline_ms=100.0,
        ),
        fabric=Fabric(
            nodes={"R": Node("R", "robot", cores=4), "E": Node("E", "edge", cores=8)},
            links={
                link.name: link
                for link in (
                    Link("R", "E", LogNormal(0.5, 0.3)),
                    Link("E", "R", LogNormal(0.5, 0.3)),
                )
            },
        ),
        candidates=placed,
        objective=Objective(
            weights=Weights(),
            targets=Targets(latency_ms=100.0),
            tiers={"R": "robot", "E": "edge"},
        ),
        scenarios={"step": (step,)},
        window_cycles=100,
    )
