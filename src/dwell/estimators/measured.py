"""What a window measured of each part: a task on a node, or a flow on a link."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.spans import Spans, measure
from dwell.model.pipeline import Pipeline
from dwell.model.placement import Placement
from dwell.model.problem import Problem

__all__ = ["Message", "Part", "Site", "Stretch", "measured_parts", "parts_of", "stretches"]

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

#: Periods after which a job or message that has not ended counts as lost.
PATIENCE = 2.0


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


class Stretch(NamedTuple):
    """Cycles of a window that went through one candidate, themselves or as shadows.

    Parameters
    ----------
    placement : Placement
    rows : bool array, shape (W,)
    spans : Spans
    tasks : frozenset of str
        The tasks that they went through there: all of them, or what a shadow does not share.
    """

    placement: Placement
    rows: Bools
    spans: Spans
    tasks: frozenset[str]


def parts_of(pipeline: Pipeline, placement: Placement) -> Iterator[Part]:
    """Every part that a cycle goes through under a placement."""
    for name in pipeline.tasks:
        yield Site(name, placement[name])
    for flow in pipeline.flows:
        source, target = placement[flow.source], placement[flow.target]
        if source != target:
            yield Message(flow.source, flow.target, f"{source}->{target}")


def stretches(problem: Problem, evidence: Evidence) -> Iterator[Stretch]:
    """Take a window apart by the candidates that its cycles and their shadows went through."""
    pipeline, placements = problem.pipeline, tuple(problem.candidates.values())
    own, shadow = measure(evidence, pipeline, PATIENCE * pipeline.period_ms)
    everything = frozenset(pipeline.tasks)
    for active in np.unique(evidence.placement):
        rows = evidence.placement == active
        yield Stretch(placements[active], rows, own, everything)
        if shadow is None:
            continue
        for other in np.unique(evidence.shadow_placement[rows]):
            if other >= 0:
                apart = pipeline.diverging(placements[active], placements[other])
                mine = rows & (evidence.shadow_placement == other)
                yield Stretch(placements[other], mine, shadow, apart)


def measured_parts(problem: Problem, evidence: Evidence) -> dict[Part, Floats]:
    """Durations of every part that the window has any of, milliseconds, infinite where lost."""
    pipeline = problem.pipeline
    found: dict[Part, list[Floats]] = {}
    for placement, rows, spans, tasks in stretches(problem, evidence):
        for column, name in enumerate(pipeline.tasks):
            if name in tasks:
                values = spans.job_ms[rows, column]
                found.setdefault(Site(name, placement[name]), []).append(values)
        for column, flow in enumerate(pipeline.flows):
            source, target = placement[flow.source], placement[flow.target]
            if source != target and flow.target in tasks:
                message = Message(flow.source, flow.target, f"{source}->{target}")
                found.setdefault(message, []).append(spans.message_ms[rows, column])
    known: dict[Part, Floats] = {}
    for part, pieces in found.items():
        values = np.concatenate(pieces)
        values = values[~np.isnan(values)]
        if len(values):
            known[part] = values
    return known
