"""Columns and rows of a live run's tables: those of a simulated one, and some beside them.

Cycles and windows count from 0 without gaps, as in any run; what the stamps say stands beside it.

==================  ================================================================================
column of cycles    what it is
==================  ================================================================================
run, number, term   as stamped
lead                whether it belongs to no window
heard               false where it is known by its neighbours only
actuated            whether all its commands were applied
interval_ns         from its stamp to its last completion, as both arrived at the controller: one
                    clock alone, but with what the two messages' ways differ by
stamper_interval_ns from its release to the arrival of its last completion at the stamper, less half
                    the best round trip to the sink's node: the stamper's clock alone, with what the
                    completion was late; null where it came over the detour
bound_ns            of the error of its latency, by the clocks; null where they were not compared
==================  ================================================================================

==================  ================================================================================
column of           what it is
decisions
==================  ================================================================================
refused             what was decided and not done, and why: migrated is false, placement the old
                    one, and reason the policy's; null where what was decided was done
==================  ================================================================================

==================  ================================================================================
column of windows   what it is
==================  ================================================================================
term                of its last cycle
lead                cycles before it that belong to no window
heard               cycles of which anything was heard
bound_ms            largest of its cycles'
unproven            whether that is more than 20 % of D
closed_unix_ns      time of day of its close
==================  ================================================================================

On request there are two more tables. ``jobs`` has a row of every job that is known of: a cycle that
never reached a sink tells of none, unless a newer one took its place on the way. Its columns are a
simulated run's, and ``cpu_ns``, the CPU time from its start until the stage's ``process()`` has
returned, reading the inputs included. Of nodes with a quota, where something counts it, also that
of all other processes of the node meanwhile (``others_ns``), of everybody else on its CPUs
(``outside_ns``), and of the node between a release, or the end of the job before on the same node,
and its start (``handover_ns``), and between the end of a sink's and the hand-over of its command
(``ending_ns``). A job that was replaced has no instants but that of its readiness. ``processes``
has what every process of the cell took of its node's CPU in every window, from the release of its
first cycle to its close.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

from dwell.control import NEVER_NS, Controller
from dwell.live.cycles import LiveCycle
from dwell.live.offsets import UNBOUNDED_NS
from dwell.model import REASONS, Problem
from dwell.record import OUTCOMES, Columns

if TYPE_CHECKING:
    from dwell.live.windows import LiveWindow

__all__ = [
    "Row",
    "columns_of",
    "cycle_row",
    "decision_rows",
    "job_columns",
    "sends_shadows",
    "window_row",
]

Row: TypeAlias = tuple[object, ...]


def sends_shadows(controller: Controller) -> bool:
    """Whether cycles may be sent through alternatives: to measure them, or to prove them."""
    return bool(controller.shadow_fraction or controller.problem.controller.fallbacks)


def columns_of(controller: Controller) -> Columns:
    """Type of every column of the tables that a live run under this controller has."""
    problem = controller.problem
    placements = list(problem.candidates)
    nodes = list(problem.fabric.nodes)
    shadows = sends_shadows(controller)
    decisions: dict[str, str | list[str]] = dict.fromkeys(controller.decision_columns, "Float64")
    decisions.update({f"eligible_{name}": "Boolean" for name in placements})
    decisions.update(
        window="Int64",
        incumbent=placements,
        placement=placements,
        migrated="Boolean",
        reason=list(REASONS),
        dwell="Int64",
        refused="String",
    )
    return {
        "cycles": {
            "cycle": "Int64",
            "release_ns": "Int64",
            "placement": placements,
            "latency_ns": "Int64",
            "missed": "Boolean",
            "outcome": list(OUTCOMES),
            "compute_ns": "Int64",
            "queue_ns": "Int64",
            "network_ns": "Int64",
            "run": "Int64",
            "number": "Int64",
            "term": "Int64",
            "lead": "Boolean",
            "heard": "Boolean",
            "actuated": "Boolean",
            "interval_ns": "Int64",
            "stamper_interval_ns": "Int64",
            "bound_ns": "Int64",
        },
        "windows": {
            "window": "Int64",
            "first_cycle": "Int64",
            "warmup": "Boolean",
            "placement": placements,
            "mixed": "Boolean",
            "l95_ms": "Float64",
            "violation_rate": "Float64",
            "seen_l95_ms": "Float64",
            "seen_violation_rate": "Float64",
            **{f"u_{node}": "Float64" for node in nodes},
            "cost": "Float64",
            **({"shadow_cycles": "Int64", "shadow_bytes": "Int64"} if shadows else {}),
            **({f"shadow_{node}": "Float64" for node in nodes} if shadows else {}),
            "term": "Int64",
            "lead": "Int64",
            "heard": "Int64",
            "bound_ms": "Float64",
            "unproven": "Boolean",
            "closed_unix_ns": "Int64",
        },
        "decisions": decisions,
    }


def job_columns(problem: Problem) -> Columns:
    """Type of every column of the tables that are kept on request."""
    nodes = list(problem.fabric.nodes)
    return {
        "jobs": {
            "cycle": "Int64",
            "task": list(problem.pipeline.tasks),
            "node": nodes,
            "ready_ns": "Int64",
            "start_ns": "Int64",
            "end_ns": "Int64",
            "outcome": list(OUTCOMES),
            "shadow": "Boolean",
            "cpu_ns": "Int64",
            "others_ns": "Int64",
            "outside_ns": "Int64",
            "handover_ns": "Int64",
            "ending_ns": "Int64",
        },
        "processes": {
            "window": "Int64",
            "process": "String",
            "node": nodes,
            "cpu_ns": "Int64",
        },
    }


def cycle_row(cycle: LiveCycle, *, missed: bool) -> Row:
    """Row of ``cycles``."""
    return (
        cycle.row,
        cycle.at_ns,
        cycle.placement,
        None if cycle.latency_ns >= NEVER_NS else cycle.latency_ns,
        missed,
        cycle.outcome,
        *(cycle.parts_ns or (None, None, None)),
        cycle.run,
        cycle.number,
        cycle.term,
        cycle.window is None,
        cycle.heard,
        cycle.actuated,
        cycle.interval_ns,
        cycle.stamper_interval_ns,
        None if cycle.bound_ns >= UNBOUNDED_NS else cycle.bound_ns,
    )


def window_row(
    window: LiveWindow,
    *,
    warmup: bool,
    l95_ms: float,
    missed: int,
    seen: Sequence[float | None],
    shadows: tuple[int, int] | None,
) -> Row:
    """Row of ``windows``.

    Parameters
    ----------
    window : LiveWindow
    warmup : bool
    l95_ms : float
        Of final latencies.
    missed : int
        Cycles.
    seen : sequence of 3 float or None
        L95 (ms), violation rate and cost as the controller saw them.
    shadows : tuple of int, optional
        Cycles that were sent twice, and their bytes, where cycles may be.
    """
    cycles = window.cycles
    busy, _, by_shadows = window.used.tolist()
    seen_l95_ms, seen_violation_rate, cost = (_known(value) for value in seen)
    return (
        window.number,
        cycles[0].row,
        warmup,
        cycles[0].placement,
        any(cycle.placement != cycles[0].placement for cycle in cycles),
        l95_ms,
        missed / len(cycles),
        seen_l95_ms,
        seen_violation_rate,
        *busy,
        cost,
        *((*shadows, *by_shadows) if shadows is not None else ()),
        cycles[-1].term,
        window.lead,
        window.heard,
        None if window.bound_ns >= UNBOUNDED_NS else window.bound_ns / 1e6,
        window.unproven,
        window.closed_unix_ns,
    )


def decision_rows(
    decisions: Iterable[tuple[Sequence[object], str | None]], first_window: int
) -> list[Row]:
    """Rows of ``decisions``.

    Parameters
    ----------
    decisions : iterable of (sequence, str or None)
        Row of a controller's log, and why it was not followed; None where it was.
    first_window : int
        Number of the controller's first window.
    """
    return [_decision_row(row, why, first_window) for row, why in decisions]


def _decision_row(row: Sequence[object], why: str | None, first_window: int) -> Row:
    window, incumbent, placement, migrated, reason, *rest = row
    if why is not None and migrated:
        why = f"{placement}: {why}"
        placement, migrated = incumbent, False
    fixed = first_window + _count(window), incumbent, placement, migrated, reason
    return (*fixed, *map(_known, rest), why)


def _count(value: object) -> int:
    if not isinstance(value, int):
        raise TypeError(f"{value!r} is no number of a window")
    return value


def _known(value: object) -> object:
    """Return None for what is not a number."""
    return None if isinstance(value, float) and math.isnan(value) else value
