"""Fleets of which no cell moves: one call of the kernel, whatever their size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.advance import play
from dwell.kernels.arrays import CellArrays, lay_out
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model import Problem
from dwell.model.fleet import Fleet
from dwell.sim.fleet import cycles_within, draw_cell, phased
from dwell.sim.waiting import Waiting, waiting_of


class StaticFleet:
    """Plays a fleet in several sizes under one seed; what cells have in common is drawn once.

    It gives what `simulate_fleet` does under static policies.

    Parameters
    ----------
    placements : mapping of str to str
        Candidate of every cell, by the name of its file.
    seed : int
    duration_ns : int
        Length of the run.
    """

    def __init__(self, placements: Mapping[str, str], *, seed: int, duration_ns: int) -> None:
        self.placements, self.seed, self.duration_ns = placements, seed, duration_ns
        self._drawn: dict[tuple[object, ...], tuple[float, Realisation]] = {}

    def __repr__(self) -> str:
        return f"<StaticFleet under {dict(self.placements)}: seed {self.seed}>"

    def violation_rates(self, fleet: Fleet) -> NDArray[np.float64]:
        """Return V_D of every cell after the warm-up, as its controller would see it."""
        problems = [*phased(fleet, self.seed)]
        rates = [
            float(cell.tables.seen[0, problem.warmup_windows : closed]["missed"].mean())
            for cell, problem in zip(self._play(fleet), problems, strict=True)
            for closed in [cell.tables.cells[0]["window"]]
        ]
        return np.array(rates) / [problem.window_cycles for problem in problems]

    def waiting(self, fleet: Fleet) -> Waiting:
        """Return where the cycles that missed have waited, of all cells."""
        problems, reals = self._realisations(fleet)
        cells = self._play(fleet, jobs=True)
        whole = Waiting()
        for problem, real, arrays in zip(problems, reals, cells, strict=True):
            whole += waiting_of(problem, real, arrays)
        return whole

    def _play(self, fleet: Fleet, *, jobs: bool = False) -> list[CellArrays]:
        problems, reals = self._realisations(fleet)
        pairs = [*zip(problems, reals, strict=True)]
        whole = lay_out(pairs, shared=fleet.shared, log_jobs=jobs)
        for row, problem in enumerate(problems):
            candidates = list(problem.candidates)
            whole.tables.stamps[row] = candidates.index(self.placements[problem.name])
        play(whole)
        return [CellArrays(whole, i) for i in range(len(problems))]

    def _realisations(self, fleet: Fleet) -> tuple[list[Problem], list[Realisation]]:
        problems = [*phased(fleet, self.seed)]
        reals = []
        for cell, problem in zip(fleet.cells, problems, strict=True):
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
            reals.append(real.until(cycles_within(problem, self.duration_ns)))
        return problems, reals


def _released_at(fleet: Fleet, problem: Problem, real: Realisation) -> Realisation:
    """Return a realisation without traces with another phase; jobs and messages take the same."""
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
