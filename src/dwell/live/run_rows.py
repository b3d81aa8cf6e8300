"""Rows of a live run's tables (`dwell.record.schema` says what their columns are).

Cycles and windows count from 0 without gaps, as in any run; what the stamps say stands beside it.
``jobs`` and ``processes`` are kept on request. A cycle that never reached a sink tells of none of
its jobs, unless a newer one took its place on the way; a job that was replaced has no instants but
that of its readiness.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from dwell.control import Controller
from dwell.live.cycle_ledger import LiveCycle
from dwell.live.offsets import UNBOUNDED_NS
from dwell.model.instants import NEVER_NS
from dwell.record import Columns, Feature, Row, Types, Values, column_types, row_of

if TYPE_CHECKING:
    from dwell.live.live_windows import LiveWindow


def sends_shadows(controller: Controller) -> bool:
    """Whether cycles may be sent through alternatives: to measure them, or to prove them."""
    return bool(controller.shadow_fraction or controller.problem.controller.fallbacks)


def columns_of(controller: Controller, *, jobs: bool = False) -> Columns:
    """Type of every column of the tables that a live run under this controller has.

    Parameters
    ----------
    jobs : bool
        Whether it keeps those that are kept on request.
    """
    features: list[Feature] = ["live"]
    if sends_shadows(controller):
        features.append("shadows")
    if controller.supports:
        features.append("support")
    tables = ["cycles", "windows", "decisions", *(("jobs", "processes") if jobs else ())]
    return {name: column_types(name, controller.problem, features) for name in tables}


def rows_of(types: Types, values: Iterable[Values]) -> list[Row]:
    """Return rows in the order of a table's columns."""
    return [row_of(types, of) for of in values]


def cycle_values(cycle: LiveCycle, *, missed: bool) -> Values:
    """Return a row of ``cycles``."""
    compute_ns, queue_ns, network_ns = cycle.parts_ns or (None, None, None)
    return {
        "cycle": cycle.row,
        "release_ns": cycle.at_ns,
        "placement": cycle.placement,
        "latency_ns": None if cycle.latency_ns >= NEVER_NS else cycle.latency_ns,
        "missed": missed,
        "outcome": cycle.outcome,
        "compute_ns": compute_ns,
        "queue_ns": queue_ns,
        "network_ns": network_ns,
        "run": cycle.run,
        "number": cycle.number,
        "term": cycle.term,
        "lead": cycle.window is None,
        "heard": cycle.heard,
        "actuated": cycle.actuated,
        "interval_ns": cycle.interval_ns,
        "stamper_interval_ns": cycle.stamper_interval_ns,
        "bound_ns": None if cycle.bound_ns >= UNBOUNDED_NS else cycle.bound_ns,
    }


def window_values(
    window: LiveWindow,
    nodes: Sequence[str],
    *,
    warmup: bool,
    l95_ms: float,
    missed: int,
    seen: Sequence[float | None],
    shadows: tuple[int, int] | None,
) -> Values:
    """Return a row of ``windows``.

    Parameters
    ----------
    nodes : sequence of str
        In the order of the columns of its `used`.
    l95_ms : float
        L95 of final latencies.
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
    values: dict[str, object] = {
        "window": window.number,
        "first_cycle": cycles[0].row,
        "warmup": warmup,
        "placement": cycles[0].placement,
        "mixed": any(cycle.placement != cycles[0].placement for cycle in cycles),
        "l95_ms": l95_ms,
        "violation_rate": missed / len(cycles),
        "seen_l95_ms": seen_l95_ms,
        "seen_violation_rate": seen_violation_rate,
        **{f"u_{node}": share for node, share in zip(nodes, busy, strict=True)},
        "cost": cost,
        "term": cycles[-1].term,
        "lead": window.lead,
        "heard": window.heard,
        "bound_ms": None if window.bound_ns >= UNBOUNDED_NS else window.bound_ns / 1e6,
        "unproven": window.unproven,
        "closed_unix_ns": window.closed_unix_ns,
    }
    if shadows is not None:
        values["shadow_cycles"], values["shadow_bytes"] = shadows
        values |= {f"shadow_{node}": share for node, share in zip(nodes, by_shadows, strict=True)}
    return values


def decision_values(
    controller: Controller, row: Sequence[object], why: str | None, first_window: int
) -> Values:
    """Return a row of ``decisions``.

    Parameters
    ----------
    row : sequence
        Of its log.
    why : str, optional
        Why it was not followed; None where it was.
    first_window : int
        Number of the controller's first window.
    """
    values = dict(zip(controller.decision_columns, map(_known, row), strict=True))
    values["window"] = first_window + _count(values["window"])
    if why is not None and values["migrated"]:
        why = f"{values['placement']}: {why}"
        values |= {"placement": values["incumbent"], "migrated": False}
    return {**values, "refused": why}


def _count(value: object) -> int:
    if not isinstance(value, int):
        raise TypeError(f"{value!r} is no number of a window")
    return value


def _known(value: object) -> object:
    """Return None for what is not a number."""
    return None if isinstance(value, float) and math.isnan(value) else value
