"""Fleets with fixed placements, simulated by one call of the kernel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.kernels.advance import play
from dwell.kernels.arrays import Arrays, CellArrays, lay_out
from dwell.kernels.over_age import due_misses
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model import Problem
from dwell.model.fleet import Fleet, FleetCell
from dwell.sim.fleet import at_phase, cycles_within, draw_cell, phases_ms
from dwell.sim.waiting import Waiting, waiting_of


class StaticRun(NamedTuple):
    """Results of a fleet after the warm-up.

    Parameters
    ----------
    missed : list of bool array, shape (due cycles,)
        Whether each cycle missed, by cell, without idle cycles.
    used : mapping of str to float
        Utilisation of the shared resources.
    """

    missed: list[NDArray[np.bool_]]
    used: Mapping[str, float]


class StaticCell(NamedTuple):
    """A cell that stays at one candidate.

    Parameters
    ----------
    problem : Problem
    drawn, real : Realisation
        Complete windows, and the cycles that are released before the end of the run.
    stamp : int
        Index of the candidate.
    """

    problem: Problem
    drawn: Realisation
    real: Realisation
    stamp: int


class StaticFleet:
    """Simulates a fleet in several sizes under one seed; samples each cell once for all sizes.

    The results equal the results of `simulate_fleet` under static policies.
    """

    def __init__(self, *, seed: int, duration_ns: int) -> None:
        self.seed, self.duration_ns = seed, duration_ns
        self._known: dict[tuple[object, ...], StaticCell] = {}

    def __repr__(self) -> str:
        return f"<StaticFleet: seed {self.seed}>"

    def play(self, fleet: Fleet) -> StaticRun:
        """Simulate a fleet; raise SimulationError if a cell may move."""
        return next(self.play_sizes([fleet]))

    def play_sizes(self, fleets: Sequence[Fleet]) -> Iterator[StaticRun]:
        """Simulate a fleet in several sizes, and yield the results in this order.

        If the cells of a size are equal cells of the last size, they are laid out only once.
        """
        sizes = [self._cells(fleet) for fleet in fleets]
        largest = sizes[-1]
        whole = _lay_out(fleets[-1], largest)
        row_of = {id(cell): row for row, cell in enumerate(largest)}
        for fleet, cells in zip(fleets[:-1], sizes, strict=False):
            rows = [row_of.get(id(cell), -1) for cell in cells]
            # The first cell defines the shared nodes.
            if rows[0] == 0 and rows == sorted(rows):
                part = whole.copy()
                part.leave_out(set(row_of.values()).difference(rows))
                yield _result(fleet, cells, part, rows)
            else:
                yield _result(fleet, cells, _lay_out(fleet, cells), range(len(cells)))
        yield _result(fleets[-1], largest, whole, range(len(largest)))

    def waiting(self, fleet: Fleet) -> Waiting:
        """Return the waiting times of the missed cycles of all cells."""
        cells, waited = self._cells(fleet), Waiting()
        whole = _lay_out(fleet, cells, jobs=True)
        play(whole)
        for i, cell in enumerate(cells):
            waited += waiting_of(cell.problem, cell.real, CellArrays(whole, i))
        return waited

    def _cells(self, fleet: Fleet) -> list[StaticCell]:
        """Return the cells of a fleet; the same objects if they are equal in another size."""
        cells = []
        for cell, phase_ms in zip(fleet.cells, phases_ms(fleet, self.seed).values(), strict=True):
            placed = fleet.candidate_of(cell.entry)
            if placed is None:
                raise SimulationError(f"{cell.name} may move")
            key = cell.problem.name, cell.copy, cell.entry.scenario, placed
            known = self._known.get(key)
            if known is None or known.problem.pipeline.first_release_ms != phase_ms:
                known = self._known[key] = self._cell(fleet, cell, placed, phase_ms, known)
            cells.append(known)
        return cells

    def _cell(
        self, fleet: Fleet, cell: FleetCell, placed: str, phase_ms: float, known: StaticCell | None
    ) -> StaticCell:
        """Return a cell at a phase, with the jobs and messages of `known`, if any."""
        problem = at_phase(cell.problem, phase_ms, fleet.warmup_ns)
        if known is None or known.drawn.trace_starts:
            drawn = draw_cell(fleet, cell, problem, self.seed, self.duration_ns)
        else:
            drawn = _released_at(fleet, problem, known.drawn)
        real = drawn.until(cycles_within(problem, self.duration_ns))
        return StaticCell(problem, drawn, real, list(problem.candidates).index(placed))


def _lay_out(fleet: Fleet, cells: Sequence[StaticCell], *, jobs: bool = False) -> Arrays:
    pairs = [(cell.problem, cell.real) for cell in cells]
    arrays = lay_out(pairs, shared=fleet.shared, log_jobs=jobs)
    arrays.tables.stamps[:] = np.array([cell.stamp for cell in cells])[:, None]
    return arrays


def _result(
    fleet: Fleet, cells: Sequence[StaticCell], arrays: Arrays, rows: Sequence[int]
) -> StaticRun:
    """Simulate the cells, which are in some rows of the tables."""
    play(arrays)
    missed: list[NDArray[np.bool_]] = []
    used: dict[str, float] = {}
    for cell, row in zip(cells, rows, strict=True):
        problem, tables = cell.problem, arrays.tables
        width, closed = problem.window_cycles, int(tables.cells["window"][row])
        first, last = problem.warmup_windows, closed
        cycles = slice(first * width, last * width)
        of_cell = problem.pipeline, cell.real.release_ns, CellArrays(arrays, row)
        missed.append(due_misses(*of_cell, cycles))
        if not used:
            shares = tables.shares[row, first:last, 0].mean(axis=0).tolist()
            resources = problem.fabric.resources.values()
            used = {
                one.name: share
                for one, share in zip(resources, shares, strict=False)
                if one.node in fleet.shared
            }
    return StaticRun(missed, used)


def _released_at(fleet: Fleet, problem: Problem, real: Realisation) -> Realisation:
    """Return a realisation with another phase and the same jobs and messages; allows no traces."""
    shared = {"shared": fleet.shared, "disturbances": fleet.disturbances}
    drawing = Drawing.again(problem, real, **shared)
    node_changes, link_segments = drawing.changes
    return replace(
        real,
        release_ns=drawing.release_ns,
        node_changes=node_changes,
        link_segments=link_segments,
    )
