"""Fleets with fixed placements, simulated by one call of the kernel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.kernels.advance import play
from dwell.kernels.arrays import CellArrays, lay_out
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model import Problem
from dwell.model.fleet import Fleet
from dwell.sim.fleet import cycles_within, draw_cell, phased
from dwell.sim.waiting import Waiting, waiting_of


class StaticRun(NamedTuple):
    """Results of a fleet after the warm-up.

    Parameters
    ----------
    missed : list of bool array, shape (cycles,)
        Whether each cycle missed, by cell.
    used : mapping of str to float
        Utilisation of the shared resources.
    """

    missed: list[NDArray[np.bool_]]
    used: Mapping[str, float]


class StaticFleet:
    """Simulates a fleet in several sizes under one seed; samples each cell once for all sizes.

    The results equal those of `simulate_fleet` under static policies.
    """

    def __init__(self, *, seed: int, duration_ns: int) -> None:
        self.seed, self.duration_ns = seed, duration_ns
        self._drawn: dict[tuple[object, ...], tuple[float, Realisation]] = {}

    def __repr__(self) -> str:
        return f"<StaticFleet: seed {self.seed}>"

    def play(self, fleet: Fleet) -> StaticRun:
        """Simulate a fleet; raise SimulationError if a cell may move."""
        missed: list[NDArray[np.bool_]] = []
        used: dict[str, float] = {}
        for problem, _, cell in self._play(fleet):
            width, closed = problem.window_cycles, int(cell.tables.cells[0]["window"])
            first, last = problem.warmup_windows, closed
            latency_ns = cell.tables.latency_ns[0, first * width : last * width]
            missed.append(latency_ns > problem.pipeline.deadline_ns)
            if not used:
                shares = cell.tables.shares[0, first:last, 0].mean(axis=0).tolist()
                resources = problem.fabric.resources.values()
                used = {
                    one.name: share
                    for one, share in zip(resources, shares, strict=False)
                    if one.node in fleet.shared
                }
        return StaticRun(missed, used)

    def waiting(self, fleet: Fleet) -> Waiting:
        """Return the waiting times of the missed cycles of all cells."""
        whole = Waiting()
        for problem, real, arrays in self._play(fleet, jobs=True):
            whole += waiting_of(problem, real, arrays)
        return whole

    def _play(
        self, fleet: Fleet, *, jobs: bool = False
    ) -> list[tuple[Problem, Realisation, CellArrays]]:
        pairs = self._realisations(fleet)
        whole = lay_out(pairs, shared=fleet.shared, log_jobs=jobs)
        for row, (cell, (problem, _)) in enumerate(zip(fleet.cells, pairs, strict=True)):
            placed = fleet.candidate_of(cell.entry)
            if placed is None:
                raise SimulationError(f"{cell.name} may move")
            whole.tables.stamps[row] = list(problem.candidates).index(placed)
        play(whole)
        return [(*pair, CellArrays(whole, i)) for i, pair in enumerate(pairs)]

    def _realisations(self, fleet: Fleet) -> list[tuple[Problem, Realisation]]:
        pairs = []
        for cell, problem in zip(fleet.cells, phased(fleet, self.seed), strict=True):
            key = (problem.name, cell.copy, cell.entry.scenario)
            phase_ms = problem.pipeline.first_release_ms
            known = self._drawn.get(key)
            if known is None or (known[1].trace_starts and known[0] != phase_ms):
                real = draw_cell(fleet, cell, problem, self.seed, self.duration_ns)
                known = phase_ms, real
                self._drawn[key] = known
            drawn_at_ms, real = known
            if drawn_at_ms != phase_ms:
                real = _released_at(fleet, problem, real)
            pairs.append((problem, real.until(cycles_within(problem, self.duration_ns))))
        return pairs


def _released_at(fleet: Fleet, problem: Problem, real: Realisation) -> Realisation:
    """Return a realisation with another phase and the same jobs and messages; allows no traces."""
    drawing = Drawing(
        problem,
        real.scenario,
        seed=real.seed or 0,
        windows=real.windows,
        streams=real.streams,
        shared=fleet.shared,
        disturbances=fleet.disturbances,
    )
    node_changes, link_segments = drawing.changes
    return replace(
        real,
        release_ns=drawing.release_ns,
        node_changes=node_changes,
        link_segments=link_segments,
    )
