"""Metrics of a window at its end: L95, violation rate, utilisation.

The functions take one window or many rows, with the same arithmetic. The live runtime, studies and
the simulator's kernel (``metrics.h``) therefore compute the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from dwell.cost import hamming, price, tier_nodes
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import (
    order_statistic,
    order_statistic_of_smallest,
    rank_of,
)
from dwell.model.problem import Problem

#: Age of a cycle without an actuation.
NO_AGE = -1


def missed_cycles(
    latency_ns: Ints, age_ns: Ints, deadline_ns: int, over_age: NDArray[np.bool_] | None = None
) -> Ints | int:
    """Count the cycles that are later than D, unfinished at the end of their window, or over age.

    Parameters
    ----------
    latency_ns : int64 array, shape (..., W)
        Final latency as far as known; `NEVER_NS` if the cycle has not completed.
    age_ns : int64 array, shape (..., W)
        Time from each cycle's release to the end of its window.
    deadline_ns : int
        D.
    over_age : bool array, shape (..., W), optional
        Whether the data of each cycle's actuation were too old.

    Returns
    -------
    int, or int64 array of shape (...)
    """
    late = latency_ns > np.minimum(age_ns, deadline_ns)
    if over_age is not None:
        late = late | over_age
    # For one window, counting without an axis is several times faster.
    if late.ndim == 1:
        return int(np.count_nonzero(late))
    missed: Ints = np.asarray(np.count_nonzero(late, axis=-1))
    return missed


def overtaken_cycles(release_ns: Ints, latency_ns: Ints) -> NDArray[np.bool_]:
    """Return which cycles completed after a later cycle had.

    Parameters
    ----------
    release_ns, latency_ns : int64 array, shape (n,)
        Consecutive cycles of a run; `NEVER_NS` if a cycle has not completed.
    """
    done = latency_ns < NEVER_NS
    at_ns = np.where(done, release_ns + latency_ns, NEVER_NS)
    later_ns = np.minimum.accumulate(at_ns[::-1])[::-1]
    overtaken: NDArray[np.bool_] = done & (later_ns < at_ns)
    return overtaken


def seen_l95_ms(latency_ns: Ints, age_ns: Ints, censor_ms: float) -> tuple[Floats, Floats]:
    """Return L95 known at the end of the window: an unfinished cycle counts with its age.

    Parameters
    ----------
    latency_ns, age_ns : int64 array, shape (..., W)
        As in `missed_cycles`.
    censor_ms : float
        `Problem.censor_ms`.

    Returns
    -------
    l95_ms, uncut_ms : float64 array, shape (...)
        L95 for J, at most `censor_ms`, and L95 for caps. The latter is infinite if more cycles are
        unfinished than L95 leaves out and L95 is the age of an unfinished cycle.
    """
    seen = np.minimum(latency_ns, age_ns)
    count = seen.shape[-1]
    rank, l95 = rank_of(95, count), order_statistic(seen, 95)
    # Censoring is monotone, so censoring the order statistic is censoring every latency.
    uncut_ms = l95 / 1e6
    l95_ms = np.minimum(uncut_ms, censor_ms)
    unfinished = latency_ns > age_ns
    lost = np.count_nonzero(unfinished, axis=-1) > count - rank
    if np.any(lost):
        # Among equal values, unfinished cycles rank last.
        at = l95[..., None]
        before = (seen < at) | ((seen == at) & ~unfinished)
        lost = lost & (np.count_nonzero(before, axis=-1) < rank)
        uncut_ms = np.where(lost, np.inf, uncut_ms)
    return l95_ms, uncut_ms


def final_l95_ms(latency_ns: Ints, counts: Ints | None = None) -> Floats:
    """Return L95 (ms) of final latencies, shape (..., W); infinite if too many never completed.

    `counts` has the number of cycles of each window that are not idle, shape (windows,).
    """
    if counts is None:
        l95 = order_statistic(latency_ns, 95)
    else:
        l95 = order_statistic_of_smallest(latency_ns, 95, counts)
    ms: Floats = np.where(l95 >= NEVER_NS, np.inf, l95 / 1e6)
    return ms


def age_l95_ms(ages_ns: Ints) -> Floats:
    """Return L95 of the ages in each window, ms; infinite for a window without actuations."""
    is_known = ages_ns != NO_AGE
    count = is_known.sum(axis=1)
    return order_statistic_of_smallest(np.where(is_known, ages_ns / 1e6, np.inf), 95, count)


def age_missed(ages_ns: Ints, max_age_ns: int) -> Floats:
    """Return the share of each window's actuations with a larger age; 1 without actuations."""
    is_known = ages_ns != NO_AGE
    count = is_known.sum(axis=1)
    over: NDArray[np.bool_] = is_known & (ages_ns > max_age_ns)
    share: Floats = np.where(count > 0, over.sum(axis=1) / np.maximum(count, 1), 1.0)
    return share


def mean_age_ms(
    commands: Iterable[tuple[int, int]], open_ns: int, close_ns: int, censor_ms: float
) -> float:
    """Return the mean over time of the age of the newest command in effect.

    The arithmetic is the kernel's. Before the first command the age counts from instant 0.

    Parameters
    ----------
    commands : iterable of (int, int)
        Instant of each command, and the release from which its age counts, from the newest cycle
        to the oldest.
    open_ns, close_ns : int
        Begin and end of the time.
    censor_ms : float
        `Problem.censor_ms`; an age counts for no more.
    """
    most_ns = censor_ms * 1e6

    def area(from_ns: float, until_ns: float) -> float:
        turn = min(max(most_ns, from_ns), until_ns)
        return (from_ns + turn) / 2 * (turn - from_ns) + most_ns * (until_ns - turn)

    total, until_ns = 0.0, close_ns
    for at_ns, born_ns in (*commands, (open_ns, 0)):
        if until_ns <= open_ns:
            break
        if at_ns < until_ns:
            from_ns = max(at_ns, open_ns)
            total += area(float(from_ns - born_ns), float(until_ns - born_ns))
            until_ns = from_ns
    return total / float(close_ns - open_ns) / 1e6


def reactions(at_ns: Ints, newest: Ints, every: int, since: int) -> tuple[Ints, Ints]:
    """Return releases of a chain's first task, and places of the actuations that end their wait.

    A release waits for the first actuation that descends from a later cycle of the task.

    Parameters
    ----------
    at_ns, newest : int64 array, shape (n,)
        Instant of each actuation, and the newest cycle that it descends from, -1 for none. They
        are in the order of their cycles; `NEVER_NS` where there is no actuation.
    every : int
        Cycles from one release of the task to its next.
    since : int
        First release that waits.

    Returns
    -------
    cycles, places : int64 array
        Ascending cycles of the releases; places in `at_ns`.
    """
    order = np.argsort(at_ns, kind="stable")
    order = order[at_ns[order] < NEVER_NS]
    known = np.maximum.accumulate(newest[order])
    cycles = np.arange(since, known.max(initial=since), every)
    return cycles, order[np.searchsorted(known, cycles, side="right")]


def utilisation(core_ns: Floats, capacity: Floats, span_ns: Ints | int) -> Floats:
    """Return the busy share of each resource; for a node, the share of its cores.

    Parameters
    ----------
    core_ns : float64 array, shape (..., resources)
        Busy core-nanoseconds in the window; for an accelerator, place-nanoseconds.
    capacity : float64 array, shape (resources,)
        Cores, or places.
    span_ns : int, or int64 array of shape (..., 1)
        Length of the window.
    """
    return np.minimum(core_ns / (capacity * span_ns), 1.0)


def moved_shares(problem: Problem) -> Floats:
    """Return S of every move, shape (candidates, candidates), from row to column."""
    placements = list(problem.candidates.values())
    return np.array([[hamming(there, here) for there in placements] for here in placements])


def busiest(used: Mapping[str, Floats], problem: Problem) -> tuple[Floats, Floats, Floats]:
    """Return the largest utilisation in the robot, edge and cloud tier, in every window.

    A tier without nodes has 0.

    Parameters
    ----------
    used : mapping of str to float64 array, shape (windows,)
        Utilisation of every resource; NaN if not measured.
    """
    none = np.zeros(len(next(iter(used.values()))))
    robot, edge, cloud = (
        np.fmax.reduce([used[name] for name in names]) if names else none
        for names in tier_nodes(problem.objective)
    )
    return robot, edge, cloud


def seen_costs(
    problem: Problem,
    l95_ms: Floats,
    violation_rate: Floats,
    used: Mapping[str, Floats],
    switching: Floats,
    age_ms: Floats | float = 0.0,
    price_per_hour: Floats | float = 0.0,
) -> Floats:
    """Return J of windows.

    Parameters
    ----------
    l95_ms, violation_rate, switching, age_ms, price_per_hour : float64 array, shape (windows,)
        `switching` is the sum of S over the moves that took effect in each window.
    used : mapping of str to float64 array, shape (windows,)
        Busy share of each resource.
    """
    used_by_tier, objective = busiest(used, problem), problem.objective
    weighed = age_ms, price_per_hour
    return price(l95_ms, violation_rate, *used_by_tier, switching, objective, *weighed)
