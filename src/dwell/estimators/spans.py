"""How long the jobs and messages of a window took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence, Instants
from dwell.model.pipeline import Pipeline

__all__ = ["Spans", "measure"]

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]

NS_PER_MS = 1e6


@dataclass(frozen=True, slots=True)
class Spans:
    """Durations in milliseconds: NaN where something had not begun, or had begun a moment ago.

    Parameters
    ----------
    job_ms : float64 array, shape (W, tasks)
        From readiness to completion, queueing and contention included; infinite where it was lost.
    message_ms : float64 array, shape (W, flows)
        From the completion of the source to the hand-over; infinite where it was lost.
    """

    job_ms: Floats
    message_ms: Floats


def measure(
    evidence: Evidence, pipeline: Pipeline, patience_ms: float
) -> tuple[Spans, Spans | None]:
    """Durations in a window, of its cycles and of their shadows.

    Parameters
    ----------
    evidence : Evidence
    pipeline : Pipeline
    patience_ms : float
        What began longer ago than this when the window closed, and has not ended, counts as lost.
    """
    names = list(pipeline.tasks)
    sources = [names.index(flow.source) for flow in pipeline.flows]
    cycles, shadows = evidence.cycles, evidence.shadows
    limit_ns = evidence.close_ns - round(patience_ms * NS_PER_MS)
    own = _spans(cycles, cycles.end_ns[:, sources], limit_ns)
    if shadows is None:
        return own, None
    # A task that the shadow shares never became ready there: its message began with the cycle's.
    shared = shadows.ready_ns[:, sources] < 0
    sent_ns = np.where(shared, cycles.end_ns[:, sources], shadows.end_ns[:, sources])
    return own, _spans(shadows, sent_ns, limit_ns)


def _spans(instants: Instants, sent_ns: Ints, limit_ns: int) -> Spans:
    return Spans(
        _between(instants.ready_ns, instants.end_ns, limit_ns),
        _between(sent_ns, instants.arrived_ns, limit_ns),
    )


def _between(begin_ns: Ints, end_ns: Ints, limit_ns: int) -> Floats:
    span: Floats = np.where(
        end_ns >= 0, (end_ns - begin_ns) / NS_PER_MS, np.where(begin_ns < limit_ns, np.inf, np.nan)
    )
    span[begin_ns < 0] = np.nan
    return span
