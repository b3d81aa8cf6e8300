"""Times that a window measured of each part: a task on a node, or a flow on a link."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.spans import patience_ns
from dwell.kernels.meter import CyclesLayout, PartTimes
from dwell.model.pipeline import Pipeline
from dwell.model.placement import Placement
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = slice | NDArray[np.int64]

EVERY = slice(None)


class Site(NamedTuple):
    """A task on one of its nodes."""

    task: str
    node: str


class Message(NamedTuple):
    """A flow on a link."""

    source: str
    target: str
    link: str


Part: TypeAlias = Site | Message


def message_of(source: str, target: str, placement: Placement) -> Message | None:
    """Return the message of a flow under a placement; None on one node."""
    here, there = placement[source], placement[target]
    return Message(source, target, f"{here}->{there}") if here != there else None


def parts_of(pipeline: Pipeline, placement: Placement) -> Iterator[Part]:
    """Every part that a cycle goes through under a placement."""
    for name in pipeline.tasks:
        yield Site(name, placement[name])
    for flow in pipeline.flows:
        message = message_of(flow.source, flow.target, placement)
        if message is not None:
            yield message


class Meter:
    """Takes windows apart into the times of the parts that their jobs and messages went through."""

    def __init__(self, problem: Problem) -> None:
        self._pipeline = problem.pipeline
        self._patience_ns = patience_ns(problem)
        names = list(problem.pipeline.tasks)
        self._sources = np.array([names.index(f.source) for f in problem.pipeline.flows], np.int64)
        self._placements = tuple(problem.candidates.values())
        every = (parts_of(problem.pipeline, placed) for placed in self._placements)
        self._parts = tuple(dict.fromkeys(part for parts in every for part in parts))
        self._times = PartTimes(len(self._parts))
        self._layouts: dict[int, CyclesLayout] = {}

    def times(self, evidence: Evidence) -> dict[Part, Floats]:
        """Times of every part that the window has any of, milliseconds, infinite where lost.

        They are overwritten by those of the next window.
        """
        limit_ns = evidence.close_ns - self._patience_ns
        cycles, shadows = evidence.cycles, evidence.shadows
        own = evidence.placement, cycles.ready_ns, cycles.end_ns, cycles.arrived_ns
        sent = None
        if shadows is not None:
            through = evidence.shadow_placement
            sent = through, shadows.ready_ns, shadows.end_ns, shadows.arrived_ns
        self._times.begin(own, sent, limit_ns)
        for active, _ in groups(evidence.placement):
            self._times.add(active, self._layout(active))
        return {self._parts[part]: found for part, found in self._times.by_part().items()}

    def _layout(self, active: int) -> CyclesLayout:
        """Return what cycles under a candidate, and their shadows, have for themselves."""
        if active not in self._layouts:
            pipeline, here = self._pipeline, self._placements[active]
            ways = [(here, frozenset(pipeline.tasks))]
            ways += [(there, pipeline.diverging(here, there)) for there in self._placements]
            shared = [[flow.source not in own for flow in pipeline.flows] for _, own in ways]
            self._layouts[active] = CyclesLayout(
                self._sources,
                np.array([self._columns(*way) for way in ways], np.int64),
                np.array(shared, np.bool_).reshape(len(ways), -1),
            )
        return self._layouts[active]

    def _columns(self, placement: Placement, tasks: Collection[str]) -> list[int]:
        """Number of the part of each task, then of each flow, that some tasks go through."""
        parts: list[Part | None] = [
            Site(name, placement[name]) if name in tasks else None for name in self._pipeline.tasks
        ]
        parts += [
            message_of(flow.source, flow.target, placement) if flow.target in tasks else None
            for flow in self._pipeline.flows
        ]
        return [-1 if part is None else self._parts.index(part) for part in parts]


def groups(codes: NDArray[np.integer]) -> Iterator[tuple[int, Rows]]:
    """Yield every code with the rows that have it; all rows as a slice where there is but one."""
    first = int(codes[0])
    if (codes == first).all():
        yield first, EVERY
        return
    for code in sorted(set(codes.tolist())):
        yield code, np.flatnonzero(codes == code)
