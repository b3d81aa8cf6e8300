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
from dwell.sim.fleet import draw_cell, phased
from dwell.sim.waiting import Waiting, waiting_of


class StaticFleet:
    """Plays a fleet in several sizes under one seed; what cells have in common is drawn once.

    It gives what `simulate_fleet` does under static policies.

    Parameters
    ----------
    placements : mapping of str to str
        Candidate of every cell, by the name of its file.
    seed, windows : int
    """

    def __init__(self, placements: Mapping[str, str], *, seed: int, windows: int) -> None:
        self.placements, self.seed, self.windows = placements, seed, windows
        self._drawn: dict[tuple[object, ...], tuple[float, Realisation]] = {}

    def __repr__(self) -> str:
        return f"<StaticFleet under {dict(self.placements)}: seed {self.seed}>"

    def violation_rates(self, fleet: Fleet) -> NDArray[np.float64]:
        """Return V_D of every cell after the warm-up, as its controller would see it."""
        cells = self._play(fleet)
        warmup = [cell.problem.warmup_windows for cell in fleet.cells]
        rates = [
            float(cell.tables.seen[0, first : self.windows]["missed"].mean())
            for cell, first in zip(cells, warmup, strict=True)
        ]
        sizes = [cell.problem.window_cycles for cell in fleet.cells]
        return np.array(rates) / sizes

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
        for i, (cell, problem) in enumerate(zip(fleet.cells, problems, strict=True)):
            key = (problem.name, cell.copy, cell.entry.scenario, i == 0)
            phase_ms = problem.pipeline.first_release_ms
            known = self._drawn.get(key)
            if known is None or (known[1].trace_starts and known[0] != phase_ms):
                real = draw_cell(fleet, cell, problem, self.seed, self.windows, is_first=i == 0)
                known = phase_ms, real
                self._drawn[key] = known
            drawn_at_ms, real = known
            reals.append(real if drawn_at_ms == phase_ms else _released_at(problem, real))
        return problems, reals


def _released_at(problem: Problem, real: Realisation) -> Realisation:
    """Return a realisation without traces with another phase; jobs and messages take the same."""
    drawing = Drawing(
        problem,
        real.scenario,
        seed=real.seed or 0,
        windows=real.windows,
        streams=real.streams,
    )
    node_changes, link_segments = drawing.changes
    return replace(
        real,
        release_ns=drawing.release_ns,
        node_changes=node_changes,
        link_segments=link_segments,
    )
