"""Predicting: simulates what a measured run should have shown, in whatever process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from dwell.model import Problem
from dwell.study.qos_sample import Piece, piece_of
from dwell.study.validated_jobs import finished_jobs

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Asked", "Simulated", "Simulator", "Unit"]


@dataclass(frozen=True, slots=True)
class Asked:
    """What is to be simulated for a measured run (see `dwell.sim.simulate`).

    Parameters
    ----------
    excluded : frozenset of int
        Windows that are left out, as they are of the measured run.
    """

    problem: Problem
    scenario: str
    policy: str
    estimator: str
    windows: int
    guard: bool
    jobs: bool
    excluded: frozenset[int]


class Unit(NamedTuple):
    """One simulation: the group, the run in it, and how many of that run went before."""

    group: int
    run: int
    step: int


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """What counts of a simulation, and its jobs where they were asked for."""

    piece: Piece
    jobs: pl.DataFrame | None


@dataclass(frozen=True, slots=True)
class Simulator:
    """Simulates runs of groups, each `seeds` times.

    Parameters
    ----------
    groups : tuple of tuple of Asked
    """

    groups: tuple[tuple[Asked, ...], ...]
    seeds: int

    @property
    def units(self) -> list[Unit]:
        """All simulations."""
        return [
            Unit(group, run, step)
            for group, mine in enumerate(self.groups)
            for run in range(len(mine))
            for step in range(self.seeds)
        ]

    def __call__(self, unit: Unit) -> Simulated:
        """Simulate once."""
        from dwell.sim import simulate

        one = self.groups[unit.group][unit.run]
        # The first of a run keeps its jobs: they are many.
        jobs = one.jobs and unit.step == 0
        run = simulate(
            one.problem,
            scenario=one.scenario,
            policy=one.policy,
            estimator=one.estimator,
            # No two simulations of a group are the same, so that they are independent.
            seed=unit.run * self.seeds + unit.step + 1,
            windows=one.windows,
            jobs=jobs,
            guard=one.guard,
        )
        # Where orders take time a simulation may be some windows shorter than what it is of.
        piece = piece_of(run, one.problem, one.excluded)
        return Simulated(piece, finished_jobs(run, one.problem.window_cycles) if jobs else None)
