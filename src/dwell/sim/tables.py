"""Tables of a Run, made from the arrays of the kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dwell.control import (
    NO_AGE,
    Controller,
    age_l95_ms,
    age_missed,
    final_l95_ms,
    moved_shares,
    overtaken_cycles,
    seen_costs,
)
from dwell.kernels.arrays import CellArrays
from dwell.kernels.codes import CycleOutcome
from dwell.kernels.over_age import over_age
from dwell.kernels.realisation import Realisation
from dwell.kernels.rows import Rows
from dwell.model import REASONS, Problem
from dwell.model.instants import HORIZON_NS, NEVER_NS
from dwell.model.number_arrays import Floats, Ints
from dwell.model.table_columns import Feature
from dwell.model.window_close import window_close_ns
from dwell.record import OUTCOMES, Names, TableArrays, frame_of
from dwell.sim.chain_ages import chain_ages_ns, reaction_l95_ms

if TYPE_CHECKING:
    import polars as pl

T = TypeVar("T", bound=np.generic)

#: Columns of windows that some cells have: the kernel's metric, and the feature.
TERMS: dict[str, tuple[str, Feature]] = {
    "seen_age_ms": ("age_ms", "age"),
    "seen_price_per_hour": ("price_per_hour", "price"),
}


@dataclass(eq=False)
class PlayedRealisation:
    """A completely simulated realisation.

    Parameters
    ----------
    problem, realisation, controller, arrays
        As after the simulation.
    host_down : function of int
        Whether the controller's node is down at an instant (ns).
    """

    problem: Problem
    realisation: Realisation
    controller: Controller
    arrays: CellArrays
    host_down: Callable[[int], bool]

    @cached_property
    def looked(self) -> Rows:
        """Range and metrics of the cycles that each decision evaluated."""
        if not self.problem.decides_within_windows:
            return self.seen
        tables = self.arrays.tables
        return tables.looked[0, : tables.cells[0]["look"]]

    @cached_property
    def seen(self) -> Rows:
        """Metrics of every window as known at its close."""
        tables = self.arrays.tables
        return tables.seen[0, : tables.cells[0]["window"]]

    @cached_property
    def first(self) -> Ints:
        """First cycle of every window, shape (windows,)."""
        return np.ascontiguousarray(self.seen["first_cycle"])

    @property
    def shares(self) -> Floats:
        """Busy, own, shadow and other cells' shares, shape (windows, 4, resources)."""
        return self.arrays.tables.shares[0, : len(self.seen)]

    @property
    def by_kernel(self) -> bool:
        """Whether the kernel decided instead of the controller."""
        return len(self.arrays.tables.rule) > 0

    @property
    def features(self) -> tuple[Feature, ...]:
        """Optional features of the run, except the features of its estimator."""
        has: dict[Feature, bool] = {
            "shadows": len(self.arrays.tables.cells) > 1,
            "age": self.problem.objective.weighs_age,
            "price": self.problem.fabric.has_prices,
            "replicas": bool(self.problem.replicas),
            "chain": self.problem.objective.latency is not None,
        }
        return tuple(feature for feature, there in has.items() if there)

    def by_window(self, cycles: NDArray[T]) -> NDArray[T]:
        """Return values of cycles by window, shape (windows, W); a view if `whole`."""
        if self.whole:
            return cycles[: self.counted].reshape(-1, self.problem.window_cycles)
        rows: NDArray[T] = sliding_window_view(cycles, self.problem.window_cycles)[self.first]
        return rows

    @property
    def whole(self) -> bool:
        """Whether every cycle up to the end of the last window is in a window."""
        return self.counted == len(self.first) * self.problem.window_cycles

    @property
    def counted(self) -> int:
        """Number of cycles up to the end of the last window."""
        return int(self.first[-1]) + self.problem.window_cycles if len(self.first) else 0

    @property
    def released(self) -> int:
        """Number of cycles released before the run ended.

        Fewer cycles are released than sampled if orders take time: cycles between a close and the
        first cycle of the new placement belong to no window, and the last window may be incomplete.
        """
        return int(self.arrays.tables.cells[0]["released"])

    @cached_property
    def lead(self) -> NDArray[np.bool_]:
        """Whether each cycle belongs to no window."""
        lead = np.ones(self.released, np.bool_)
        lead[self.first[:, None] + np.arange(self.problem.window_cycles)] = False
        return lead

    @property
    def close_ns(self) -> Ints:
        """Instant at which each window closes, shape (windows,)."""
        release_ns, beyond = self.realisation.release_ns, self.first + self.problem.window_cycles
        return window_close_ns(self.problem, release_ns[beyond - 1], release_ns[beyond])

    def share_of(self, cycles: NDArray[np.bool_]) -> Floats:
        """Return the share of each window's cycles that are true, without idle cycles."""
        share: Floats = self.by_window(cycles).sum(axis=1) / self.seen["counted"]
        return share

    @cached_property
    def overtaken(self) -> NDArray[np.bool_]:
        """Whether a later cycle had completed at the completion of each cycle."""
        latency_ns = self.arrays.tables.latency_ns[0, : self.released]
        return overtaken_cycles(self.realisation.release_ns[: self.released], latency_ns)

    @cached_property
    def missed(self) -> NDArray[np.bool_]:
        """Whether each cycle missed: late, unfinished when its window closed, or its data old."""
        tables, cycles = self.arrays.tables, slice(self.released)
        pipeline, release_ns = self.problem.pipeline, self.realisation.release_ns
        latency_ns, close_ns = tables.latency_ns[0, cycles], self._close_ns_of_cycles
        missed: NDArray[np.bool_] = latency_ns > pipeline.deadline_ns
        missed |= latency_ns > close_ns - release_ns[cycles]
        missed |= over_age(pipeline, release_ns, self.arrays, cycles, close_ns)
        missed &= tables.outcome[0, cycles] != CycleOutcome.IDLE
        if not self.realisation.is_cut(self.problem):
            # The windows of the last cycles never closed.
            missed[self.counted :] = False
        return missed

    @property
    def _close_ns_of_cycles(self) -> Ints:
        """Instant at which the window of each cycle closes; a late instant without a window."""
        close_ns = np.full(self.released, NEVER_NS - 1)
        windows = self.first[:, None] + np.arange(self.problem.window_cycles)
        close_ns[windows] = self.close_ns[:, None]
        return close_ns


def make_tables(
    played: PlayedRealisation, *, jobs: bool = False
) -> tuple[dict[str, Callable[[], pl.DataFrame]], dict[str, Callable[[], TableArrays]]]:
    """Return functions that make the tables: as frames, and (except ``jobs``) as arrays.

    The frames include the table of jobs if `jobs` is true.
    """
    problem, controller = played.problem, played.controller
    arrays: dict[str, Callable[[], TableArrays]] = {
        "cycles": cache(lambda: _cycles(played)),
        "windows": cache(lambda: _windows(played, _seen(played))),
        "decisions": cache(
            lambda: _decided_by_kernel(played) if played.by_kernel else _decisions(controller)
        ),
    }
    features = dict.fromkeys(("cycles", "windows"), played.features)
    features["decisions"] = controller.features

    def frame(name: str) -> pl.DataFrame:
        return frame_of(name, problem, arrays[name]().columns(), features.get(name, ()))

    frames: dict[str, Callable[[], pl.DataFrame]] = {name: partial(frame, name) for name in arrays}
    if jobs:
        frames["jobs"] = lambda: _jobs(played)
    return frames, arrays


def _cycles(played: PlayedRealisation) -> TableArrays:
    tables = played.arrays.tables
    count = played.released
    latency, compute, network = (
        table[0, :count] for table in (tables.latency_ns, tables.compute_ns, tables.network_ns)
    )

    @cache
    def lost() -> NDArray[np.bool_] | None:
        lost = latency >= NEVER_NS
        return lost if lost.any() else None

    def finished(part: Ints) -> Ints:
        return part if (gone := lost()) is None else np.where(gone, NEVER_NS, part)

    return TableArrays(
        {
            "cycle": lambda: np.arange(count),
            "release_ns": played.realisation.release_ns[:count],
            "placement": Names(tables.stamps[0, :count], tuple(played.problem.candidates)),
            "latency_ns": latency,
            "missed": lambda: played.missed,
            "outcome": Names(tables.outcome[0, :count], OUTCOMES),
            "compute_ns": lambda: finished(compute),
            "queue_ns": lambda: finished(latency - compute - network),
            "network_ns": lambda: finished(network),
            "lead": lambda: played.lead,
            **_chain_columns(played),
        }
    )


def _chain_columns(played: PlayedRealisation) -> dict[str, Callable[[], Ints]]:
    """Return the latency and data age of each actuation of the chain in place of the latency."""
    problem, count = played.problem, played.released
    if problem.objective.latency is None:
        return {}
    number = list(problem.pipeline.chains).index(problem.objective.latency)
    release_ns = played.realisation.release_ns[:count]
    at_ns = played.arrays.tables.actuated_ns[0, number, :count]

    def ages_ns() -> Ints:
        ages = chain_ages_ns(played.realisation, played.arrays, number)[:count]
        return np.where(ages == NO_AGE, NEVER_NS, ages)

    return {
        "chain_latency_ns": lambda: np.where(at_ns < NEVER_NS, at_ns - release_ns, NEVER_NS),
        "chain_age_ns": ages_ns,
    }


def _windows(played: PlayedRealisation, seen: dict[str, Floats]) -> TableArrays:
    problem, stamps = played.problem, played.arrays.tables.stamps[0]
    count = len(played.first)

    def mixed() -> NDArray[np.bool_]:
        placed = played.by_window(stamps)
        different: NDArray[np.bool_] = (placed != placed[:, :1]).any(axis=1)
        return different

    return TableArrays(
        {
            "window": np.arange(count),
            "first_cycle": played.first,
            "warmup": np.arange(count) < problem.warmup_windows,
            "placement": Names(stamps[played.first], tuple(problem.candidates)),
            "mixed": mixed,
            "l95_ms": lambda: final_l95_ms(
                played.by_window(played.arrays.tables.latency_ns[0]), played.seen["counted"]
            ),
            "violation_rate": lambda: played.share_of(played.missed),
            "seen_l95_ms": seen["l95_ms"],
            "seen_violation_rate": seen["violation_rate"],
            **{name: values for name, values in seen.items() if name.startswith("u_")},
            **{name: values for name, values in seen.items() if name in TERMS},
            "cost": seen["cost"],
            **_age_columns(played),
            "overtaken": lambda: played.by_window(played.overtaken).sum(axis=1),
            **_replica_columns(played),
            **_shadow_columns(played),
        }
    )


def _age_columns(played: PlayedRealisation) -> dict[str, Callable[[], NDArray[np.generic]]]:
    """Return the L95 of each chain's data age, the share over its bound, and L95 of reactions."""
    pipeline, width = played.problem.pipeline, played.problem.window_cycles
    columns: dict[str, Callable[[], NDArray[np.generic]]] = {}
    for number, (name, chain) in enumerate(pipeline.chains.items()):
        ages_ns = cache(partial(_ages_ns, played, number))
        columns[f"age_l95_{name}"] = partial(_on_ages, ages_ns, age_l95_ms)
        over = partial(age_missed, max_age_ns=chain.max_age_ns)
        columns[f"age_missed_{name}"] = partial(_on_ages, ages_ns, over)
        of_chain = number, pipeline.rates[chain.source], played.first, width
        columns[f"reaction_l95_{name}"] = partial(
            reaction_l95_ms, played.realisation, played.arrays, *of_chain
        )
    return columns


def _on_ages(ages_ns: Callable[[], Ints], metric: Callable[[Ints], Floats]) -> Floats:
    return metric(ages_ns())


def _ages_ns(played: PlayedRealisation, number: int) -> Ints:
    """Return the data ages of a chain by window."""
    return played.by_window(chain_ages_ns(played.realisation, played.arrays, number))


def _replica_columns(played: PlayedRealisation) -> dict[str, Callable[[], Ints]]:
    """Return the late messages of the cycles of each window."""
    if not played.problem.replicas:
        return {}
    late = played.arrays.tables.late_copies[0]
    return {"late_copies": lambda: played.by_window(late).sum(axis=1)}


def _shadow_columns(played: PlayedRealisation) -> dict[str, Callable[[], NDArray[np.generic]]]:
    """Return the cost of shadows in each window: cycles sent twice, bytes, share of resources."""
    if "shadows" not in played.features:
        return {}

    def sent_bytes() -> Ints:
        sent = played.by_window(played.arrays.tables.shadow_bytes)
        # Limit sums that 64 bits may not hold.
        held = sent.sum(axis=1, dtype=np.float64) < HORIZON_NS
        return np.where(held, sent.sum(axis=1), HORIZON_NS)

    return {
        "shadow_cycles": lambda: (played.by_window(played.arrays.tables.stamps[1]) >= 0).sum(
            axis=1
        ),
        "shadow_bytes": sent_bytes,
        **{
            f"shadow_{name}": partial(lambda i: played.shares[:, 2, i], i)
            for i, name in enumerate(played.controller.resources)
        },
    }


def _seen(played: PlayedRealisation) -> dict[str, Floats]:
    """Return the metrics of windows at their closes; NaN while the controller's node was down."""
    seen = {
        "l95_ms": played.seen["l95_ms"],
        "violation_rate": played.seen["missed"] / played.seen["counted"],
    }
    seen["cost"] = _costs(played, seen)
    for name, (metric, feature) in TERMS.items():
        if feature in played.features:
            seen[name] = np.where(np.isnan(seen["l95_ms"]), np.nan, played.seen[metric])
    used = played.shares[:, 0]
    return seen | {f"u_{name}": used[:, i] for i, name in enumerate(played.controller.resources)}


def _costs(played: PlayedRealisation, seen: dict[str, Floats]) -> Floats:
    """Return J of the windows, with the switching terms of the moves that took effect in them.

    If the controller's node was down at a close, J is NaN, and so are the metrics in `seen`.
    """
    problem, resources = played.problem, played.controller.resources
    used = {name: played.shares[:, 0, i] for i, name in enumerate(resources)}
    stamps = played.arrays.tables.stamps[0].astype(np.int64)
    moved = np.zeros(len(stamps))
    moved[1:] = moved_shares(problem)[stamps[:-1], stamps[1:]]
    switching = played.by_window(moved).sum(axis=1)
    seen_of = seen["l95_ms"], seen["violation_rate"]
    terms = played.seen["age_ms"], played.seen["price_per_hour"]
    costs = seen_costs(problem, *seen_of, used, switching, *terms)
    unseen = [played.host_down(at_ns) for at_ns in played.close_ns.tolist()]
    for values in (*seen.values(), costs):
        values[unseen] = np.nan
    return costs


def _decisions(controller: Controller) -> TableArrays:
    """Return the decisions of the controller, with candidates and reasons as `Names`."""
    columns, rows = controller.decision_columns, controller.decisions
    columns_of_rows = zip(*rows, strict=True) if rows else [()] * (len(columns) + 1)
    decided: dict[str, object] = dict(zip((*columns, "refused"), columns_of_rows, strict=True))
    if controller.coordination is None:
        # Without coordination no decision is refused.
        del decided["refused"]
    known = dict.fromkeys(("incumbent", "placement"), tuple(controller.problem.candidates))
    known["reason"] = REASONS
    names = {
        column: partial(Names.of, cast("Sequence[str]", decided[column]), those)
        for column, those in known.items()
    }
    # The type must be right without decisions, too.
    migrated = np.asarray(decided["migrated"], np.bool_)
    return TableArrays({**decided, **names, "migrated": migrated})


def _decided_by_kernel(played: PlayedRealisation) -> TableArrays:
    """Return the decisions of the kernel."""
    controller, tables = played.controller, played.arrays.tables
    names, looked = tuple(played.problem.candidates), played.looked
    count, last = len(looked), looked["first_cycle"] + looked["cycles"] - 1
    decided = tables.decided[:count]
    columns: dict[str, object] = {
        "window": np.searchsorted(played.first + played.problem.window_cycles, last, side="right"),
        "last_cycle": last,
        "cycles": looked["cycles"],
        "incumbent": Names(decided["incumbent"], names),
        "placement": Names(decided["placement"], names),
        "migrated": decided["incumbent"] != decided["placement"],
        "reason": Names(decided["reason"], REASONS),
        "dwell": decided["dwell"] * played.problem.decide_cycles // played.problem.window_cycles,
        "dwell_cycles": decided["dwell"] * played.problem.decide_cycles,
        "delta_j": decided["delta_j"],
    }
    if played.problem.decides_within_windows:
        used = tables.look_shares[0, :count, 1, 0].T
        columns |= {
            "seen_l95_ms": looked["l95_ms"],
            "seen_violation_rate": looked["missed"] / looked["counted"],
            **dict(zip((f"u_{one}" for one in controller.resources), used, strict=False)),
        }
    # The kernel's estimates have no errors.
    errors = ("est_l95_error_ms", "est_violation_error")
    columns |= {f"{error}_{name}": np.zeros(count) for error in errors for name in names}
    priced = [column for column in controller.decision_columns if column not in columns]
    columns |= {name: tables.priced[:count, i] for i, name in enumerate(priced)}
    for name in names:
        columns[f"eligible_{name}"] = tables.priced[:count, priced.index(f"eligible_{name}")] > 0
        if not controller.has_caps:
            columns[f"excess_{name}"] = np.full(count, np.nan)
    return TableArrays(columns)


def _jobs(played: PlayedRealisation) -> pl.DataFrame:
    problem, tables = played.problem, played.arrays.tables
    tasks = tuple(problem.pipeline.tasks)
    nodes = tuple(problem.fabric.nodes)
    cells = len(tables.cells)
    log, outcome, *_ = played.arrays.logs()
    # The sites of a shadow follow the sites of its cell, in the same order.
    site_node = np.array([nodes.index(node) for _, node in played.realisation.sites] * cells)
    site = tables.site_of - played.arrays.part.site_0
    node = site_node[site[np.maximum(tables.stamps[:, : log.shape[1]], 0).astype(np.int64)]]
    cycle, cell, task = np.nonzero(log["ready_ns"].transpose(1, 0, 2) >= 0)
    picked = log[cell, cycle, task]
    started, ended = picked["start_ns"] >= 0, picked["end_ns"] >= 0
    return frame_of(
        "jobs",
        problem,
        {
            "cycle": cycle,
            "task": Names(task % len(tasks), tasks),
            "node": Names(node[cell, cycle, task], nodes),
            "ready_ns": picked["ready_ns"],
            "start_ns": np.where(started, picked["start_ns"], NEVER_NS),
            "end_ns": np.where(ended, picked["end_ns"], NEVER_NS),
            "outcome": Names(np.where(ended, outcome[cell, cycle, task], 0), OUTCOMES),
            **({"shadow": cell > 0} if cells > 1 else {}),
            **({"second": task >= len(tasks)} if played.problem.replicas else {}),
        },
        played.features,
    )
