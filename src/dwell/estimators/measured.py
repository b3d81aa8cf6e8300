"""Times that a window measured of each part: a task on a node, or a flow on a link."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.spans import Spans, patience_ns, spans_of
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
        self._sources = [names.index(flow.source) for flow in problem.pipeline.flows]
        self._placements = tuple(problem.candidates.values())
        whole = frozenset(names)
        self._cycles = [_Columns(problem.pipeline, placed, whole) for placed in self._placements]
        self._shadows: dict[int, _Shadows] = {}

    def times(self, evidence: Evidence) -> dict[Part, Floats]:
        """Times of every part that the window has any of, milliseconds, infinite where lost."""
        limit_ns = evidence.close_ns - self._patience_ns
        found: dict[Part, list[Floats]] = {}
        for active, rows in groups(evidence.placement):
            cycles = evidence.cycles.at(rows)
            ended_ns = cycles.end_ns[:, self._sources]
            self._cycles[active].collect(spans_of(cycles, ended_ns, limit_ns), EVERY, found)
            if evidence.shadows is None:
                continue
            through = evidence.shadow_placement[rows]
            sent = np.flatnonzero(through >= 0)
            if len(sent) == 0:
                continue
            shadows, through = evidence.shadows.at(rows).at(sent), through[sent]
            known = self._shadows_of(active)
            # The message of a task that a shadow shares was sent when the cycle's own job ended.
            own_ns = shadows.end_ns[:, self._sources]
            sent_ns = np.where(known.shared[through], ended_ns[sent], own_ns)
            spans = spans_of(shadows, sent_ns, limit_ns)
            for other, mine in groups(through):
                known.columns[other].collect(spans, mine, found)
        return {
            part: pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
            for part, pieces in found.items()
        }

    def _shadows_of(self, active: int) -> _Shadows:
        """Return what shadows of cycles under a candidate have for themselves."""
        if active not in self._shadows:
            pipeline, here = self._pipeline, self._placements[active]
            apart = [pipeline.diverging(here, there) for there in self._placements]
            self._shadows[active] = _Shadows(
                [_Columns(pipeline, *pair) for pair in zip(self._placements, apart, strict=True)],
                np.array(
                    [[f.source not in own for f in pipeline.flows] for own in apart], np.bool_
                ),
            )
        return self._shadows[active]


class _Shadows(NamedTuple):
    """Layout of shadows of cycles under one candidate, by the candidate they go through.

    Parameters
    ----------
    shared : bool array, shape (candidates, flows)
        Whether a shadow shares the source of a flow.
    """

    columns: list[_Columns]
    shared: NDArray[np.bool_]


class _Columns:
    """Part of each column of the spans, for cycles or for shadows through a placement.

    Parameters
    ----------
    tasks : frozenset of str
        The tasks that they went through there: all, or what a shadow does not share.
    """

    def __init__(self, pipeline: Pipeline, placement: Placement, tasks: frozenset[str]) -> None:
        self.sites = [
            (Site(name, placement[name]), column)
            for column, name in enumerate(pipeline.tasks)
            if name in tasks
        ]
        messages = [message_of(f.source, f.target, placement) for f in pipeline.flows]
        self.messages = [
            (message, column)
            for column, (flow, message) in enumerate(zip(pipeline.flows, messages, strict=True))
            if message is not None and flow.target in tasks
        ]

    def collect(self, spans: Spans, rows: Rows, found: dict[Part, list[Floats]]) -> None:
        """Add the known times of every part, of some rows of the spans, to `found`."""
        _collect(self.sites, spans.job_ms[rows], found)
        _collect(self.messages, spans.message_ms[rows], found)


def _collect(
    columns: Sequence[tuple[Part, int]], span_ms: Floats, found: dict[Part, list[Floats]]
) -> None:
    unknown = np.isnan(span_ms)
    complete = not unknown.any()
    for part, column in columns:
        times = span_ms[:, column]
        if not complete:
            times = times[~unknown[:, column]]
        if len(times):
            found.setdefault(part, []).append(times)


def groups(codes: NDArray[np.integer]) -> Iterator[tuple[int, Rows]]:
    """Yield every code with the rows that have it; all rows as a slice where there is but one."""
    first = int(codes[0])
    if (codes == first).all():
        yield first, EVERY
        return
    for code in sorted(set(codes.tolist())):
        yield code, np.flatnonzero(codes == code)
