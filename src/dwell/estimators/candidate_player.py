"""Candidate player: simulates candidates of one or several cells on common samples.

All candidates of a cell have the same realisation, so only the places of their tasks differ. Cells
that share nodes are simulated together. Each cell may have measured conditions.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from dwell.estimators.present import MOST_THREADS, Present, in_order
from dwell.estimators.present_tables import PresentTables
from dwell.estimators.sent_shadows import SentShadows
from dwell.kernels.advance import play
from dwell.kernels.arrays import Arrays, lay_out
from dwell.kernels.codes import LAST_NS
from dwell.kernels.realisation import NodeChange, NodeChanges, Realisation
from dwell.model.bounds import counted
from dwell.model.fabric import Node
from dwell.model.number_arrays import Floats, Ints
from dwell.model.problem import Problem


class PlayedWindows(NamedTuple):
    """Simulated windows of a cell that stays on a candidate."""

    #: L95 as a controller measures it.
    l95_ms: Floats
    #: L95 without the bound ``problem.censor_ms``.
    uncut_ms: Floats
    #: Mean age of the newest command; 0 unless J weighs it.
    age_ms: Floats
    #: Price of transmitted bytes; 0 without prices.
    price_per_hour: Floats
    #: Number of cycles that missed the deadline.
    missed: Ints
    #: Number of cycles in which a sink is due.
    counted: Ints
    #: Shares of each resource, shape (windows, `PARTS`, resources).
    shares: Floats

    @property
    def violation_rate(self) -> Floats:
        """Share of the counted cycles that missed."""
        return self.missed / self.counted


class CandidatePlayer:
    """Simulates candidates of cells, always on the same samples.

    Each node in `shared` is one computer for all cells. `shadows` are the shadow jobs of a single
    cell. If `measures`, the cells may get measured conditions (see `begin`). `log_jobs` and
    `decides` are as in `lay_out`.
    """

    def __init__(
        self,
        cells: Sequence[tuple[Problem, Realisation]],
        shared: Collection[str] = (),
        shadows: SentShadows | None = None,
        *,
        measures: bool = False,
        log_jobs: bool = False,
        decides: bool = False,
    ) -> None:
        self.cells, self.measures = tuple(cells), measures
        self._shared, self._shadows = shared, shadows
        self._options = {"log_jobs": log_jobs, "decides": decides}
        self._numbers = [{name: i for i, name in enumerate(of.candidates)} for of, _ in cells]
        self._presents: list[PresentTables] = []
        self._first: Arrays | None = None

    def __repr__(self) -> str:
        return f"<CandidatePlayer: {counted(len(self.cells), 'cell')}>"

    @property
    def first(self) -> Arrays:
        """The tables before the first event; they are laid out at the first use."""
        if self._first is None:
            self._first = self._laid_out()
        return self._first

    def _laid_out(self) -> Arrays:
        sent = [self._shadows.realisation] if self._shadows is not None else []
        problems = [problem for problem, _ in self.cells]
        # The realisation of each cell, then of its shadows.
        declared = [[real, *sent] for _, real in self.cells]
        played = declared
        if self.measures:
            both = zip(problems, declared, strict=True)
            played = [[_to_measure(problem, one) for one in reals] for problem, reals in both]
        first = lay_out(
            [(problem, real) for problem, (real, *_) in zip(problems, played, strict=True)],
            shared=self._shared,
            shadows=[shadow for _, *shadows in played for shadow in shadows],
            **self._options,
        ).copy()
        if self.measures:
            cells = enumerate(zip(problems, declared, played, strict=True))
            self._presents = [
                PresentTables(problem, first, index, self._shared, [*zip(*reals, strict=True)])
                for index, (problem, *reals) in cells
            ]
        return first

    def begin(self, presents: Mapping[int, Present]) -> Arrays:
        """Set the measured conditions of some cells, and return the first tables.

        The first cell sets the conditions of shared nodes.
        """
        first = self.first
        for index, present in presents.items():
            self._presents[index].begin(present)
        first.replace(changes=in_order([tables.changes for tables in self._presents]))
        return first

    def grow(self, present: Present, since: int, offset: int) -> None:
        """Use newer values of a single cell from a cycle on (see `PresentTables.grow`)."""
        self._presents[0].grow(present, since, offset)

    def tables(self, placed: Mapping[int, str]) -> Arrays:
        """Return first tables in which some cells run candidates, without the other cells."""
        numbers = {i: self._numbers[i][name] for i, name in placed.items()}
        if self._shadows is not None:
            return self.first.on({**numbers, 1: self._shadows.stamps(numbers[0])})
        return self.first.on(numbers)

    def play(self, placed: Mapping[int, str]) -> Arrays:
        """Simulate some cells on candidates, and return the tables at the end."""
        arrays = self.tables(placed)
        play(arrays)
        return arrays

    def windows(
        self, arrays: Arrays, index: int = 0, first: int = 0, last: int | None = None
    ) -> PlayedWindows:
        """Return some windows of a cell, from `first` until before `last`."""
        part, tables, stretch = arrays.parts[index], arrays.tables, slice(first, last)
        seen = tables.seen[part.row, stretch]
        columns = [seen[name] for name in PlayedWindows._fields[:-1]]
        shares = tables.shares[part.row, stretch, :, : part.resources]
        return PlayedWindows._make([*columns, shares])


def _to_measure(problem: Problem, real: Realisation) -> Realisation:
    """Return a realisation whose demands and changes of nodes can be replaced."""
    begins = [NodeChange(0, name, 0, False) for name in problem.fabric.nodes]
    # Nodes with a quota in ticks need room for the most threads; this change never happens.
    ends = [
        NodeChange(LAST_NS, name, _most_threads(node), False)
        for name, node in problem.fabric.nodes.items()
        if node.quota is not None and node.quota.tick_ms > 0
    ]
    changes = NodeChanges.of([*begins, *real.node_changes, *ends])
    exec_ns, delay_ns = real.exec_ns.copy(), real.delay_ns.copy()
    return replace(real, node_changes=changes, exec_ns=exec_ns, delay_ns=delay_ns)


def _most_threads(node: Node) -> int:
    return MOST_THREADS + (node.bursts.threads if node.bursts is not None else 0)


def with_windows_up_to(cycles: int, problem: Problem) -> Problem:
    """Return a problem whose windows have at most some cycles, or one run of each sink."""
    most = max(cycles, problem.pipeline.sink_cycles)
    if problem.window_cycles <= most:
        return problem
    every = min(problem.decide_cycles, most)
    controller = replace(problem.controller, decide_cycles=every)
    return replace(problem, window_cycles=most, controller=controller)
