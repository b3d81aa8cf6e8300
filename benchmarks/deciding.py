"""Deciding in the simulator: a run less the kernel alone on the same stamps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, shared_core, took
from dwell import Realisation
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.model import Problem, QoS
from dwell.policies import MinimalPolicy

SCENARIO = "baseline"


class Patient:
    """A user's policy: to the fastest candidate after three windows with too many misses."""

    def __init__(self, misses: float = 0.05, windows: int = 3) -> None:
        self.misses, self.windows, self.bad = misses, windows, 0

    def start(self, problem: Problem) -> None:
        """Forget everything: a run of `problem` begins."""
        self.bad, self.incumbent = 0, problem.initial

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Choose the placement for the next window."""
        self.bad = self.bad + 1 if observed.violation_rate > self.misses else 0
        if self.bad >= self.windows:
            self.incumbent = min(estimates, key=lambda name: estimates[name].l95_ms)
            self.bad = 0
        return self.incumbent


POLICIES: dict[str, tuple[MinimalPolicy | str, Goal]] = {
    "DTP": ("dtp+profile", Goal(high=3)),
    "CUSUM": ("cusum+profile", Goal(high=3)),
    "ATP": ("atp+profile", Goal(high=3)),
    "latency-first": ("latency-first+profile", Goal(high=3)),
    "a policy of a user's": (Patient(), Goal(high=25)),
}


def measure(quick: bool) -> Section:
    """Microseconds a window."""
    windows, rounds = (1_000, 3) if quick else (3_000, 7)
    problem = dwell.load(CELL)
    real = dwell.draw(problem, scenario=SCENARIO, seed=1, windows=windows)
    variants: dict[tuple[str, str], Callable[[], Took]] = {}
    moves = []
    for name, (policy, _) in POLICIES.items():
        run = dwell.simulate_realisation(problem, real, policy=policy)
        placements = run.cycles["placement"].to_physical().to_numpy()
        moves.append(f"{name} {int(run.decisions['migrated'].sum())}")
        variants[name, "run"] = partial(_run, problem, real, policy)
        variants[name, "kernel"] = partial(_play, problem, real, placements)
    runs = in_turns(variants, rounds)
    figures = [
        Figure(
            name,
            [
                1e6 * (run.cpu_s - alone.cpu_s) / windows
                for run, alone in zip(runs[name, "run"], runs[name, "kernel"], strict=True)
            ],
            "µs",
            goal,
        )
        for name, (_, goal) in POLICIES.items()
    ]
    notes = [f"moves, which are Python's: {', '.join(moves)}"]
    notes += shared_core(run for some in runs.values() for run in some)
    return Section(f"Deciding in {windows} windows of the simulator", figures, notes)


def _run(problem: Problem, real: Realisation, policy: MinimalPolicy | str) -> Took:
    return took(lambda: dwell.simulate_realisation(problem, real, policy=policy))


def _play(problem: Problem, real: Realisation, stamps: NDArray[np.integer]) -> Took:
    def work() -> None:
        arrays = lay_out([(problem, real)])
        arrays.tables.stamps[0, : len(stamps)] = stamps
        play(arrays)

    return took(work)
