"""Heaps of kernels: entries come out in their order, whatever came between."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.kernels.compiled import kernel
from dwell.kernels.heaps import (
    pop_event,
    pop_running,
    pop_waiting,
    push_event,
    push_running,
    push_waiting,
)
from dwell.kernels.layout import N_EVENTS

ROOM = 64
TAKE = -1
#: Few values, so that many are equal and keys have to tell them apart.
VALUE = st.integers(0, 5)
Ints = NDArray[np.int64]


@kernel
def play_events(
    steps: Ints, clock: Ints, times: Ints, keys: Ints, out_t: Ints, out_key: Ints
) -> int:
    """Add every step, take the first event where it is `TAKE`; returns how many were taken."""
    taken = 0
    for key in range(steps.size):
        if steps[key] != TAKE:
            push_event(clock, times, keys, steps[key], key)
        elif clock[N_EVENTS] > 0:
            out_t[taken], out_key[taken] = times[0], keys[0]
            pop_event(clock, times, keys)
            taken += 1
    return taken


@kernel
def play_running(
    steps: Ints, places: Ints, base: int, v: NDArray[np.float64], keys: Ints, heads: Ints
) -> int:
    """Add every step, take the entry at a place where it is `TAKE`; keeps who is first."""
    n = 0
    for key in range(steps.size):
        if steps[key] != TAKE:
            push_running(v, keys, base, n, float(steps[key]), key)
            n += 1
        elif n > 0:
            at = places[key] % n
            heads[key] = keys[base + at]
            pop_running(v, keys, base, n, at)
            n -= 1
    return n


@kernel
def play_waiting(
    ranks: Ints,
    readies: Ints,
    base: int,
    rank: Ints,
    ready: Ints,
    key: Ints,
    left: NDArray[np.float64],
    order: Ints,
    work: NDArray[np.float64],
) -> None:
    """Add all jobs, then take all."""
    count = ranks.size
    for n in range(count):
        push_waiting(rank, ready, key, left, base, n, ranks[n], readies[n], n, 10.0 * n)
    for n in range(count):
        order[n], work[n] = key[base], left[base]
        pop_waiting(rank, ready, key, left, base, count - n)


STEPS = st.lists(st.one_of(st.just(TAKE), VALUE), max_size=ROOM)


@given(STEPS)
def test_events_come_by_time_then_key(steps: list[int]) -> None:
    clock = np.zeros(N_EVENTS + 1, np.int64)
    times, keys, out_t, out_key = (np.zeros(ROOM, np.int64) for _ in range(4))
    count = play_events(np.array(steps, np.int64), clock, times, keys, out_t, out_key)
    kept: list[tuple[int, int]] = []
    expected = []
    for key, step in enumerate(steps):
        if step != TAKE:
            kept.append((step, key))
        elif kept:
            expected.append(min(kept))
            kept.remove(min(kept))
    assert list(zip(out_t[:count], out_key[:count], strict=True)) == expected
    assert clock[N_EVENTS] == len(kept)
    assert not kept or (times[0], keys[0]) == min(kept)


@given(STEPS, st.lists(st.integers(0, ROOM), min_size=ROOM, max_size=ROOM), st.integers(0, 3))
def test_running_jobs_may_leave_from_the_middle(
    steps: list[int], places: list[int], base: int
) -> None:
    finish, keys = np.zeros(ROOM + base), np.zeros(ROOM + base, np.int64)
    gone = np.full(ROOM, -1, np.int64)
    n = play_running(
        np.array(steps, np.int64), np.array(places, np.int64), base, finish, keys, gone
    )
    added = {key: step for key, step in enumerate(steps) if step != TAKE}
    left = {(float(step), key) for key, step in added.items() if key not in set(gone.tolist())}
    inside = [(float(finish[base + i]), int(keys[base + i])) for i in range(n)]
    assert set(inside) == left
    assert len(inside) == len(left)
    # Every entry is after the one over it, so that the first is the first to finish.
    assert all(inside[(i - 1) // 2] < inside[i] for i in range(1, n))


@given(st.lists(st.tuples(VALUE, VALUE), min_size=1, max_size=ROOM), st.integers(0, 3))
def test_waiting_jobs_come_by_rank_then_readiness_with_their_work(
    jobs: list[tuple[int, int]], base: int
) -> None:
    size = len(jobs)
    ranks, readies = (np.array(column, np.int64) for column in zip(*jobs, strict=True))
    rank, ready, key = (np.zeros(ROOM + base, np.int64) for _ in range(3))
    left, order, work = np.zeros(ROOM + base), np.zeros(size, np.int64), np.zeros(size)
    play_waiting(ranks, readies, base, rank, ready, key, left, order, work)
    assert order.tolist() == [n for _, _, n in sorted((*job, n) for n, job in enumerate(jobs))]
    assert work.tolist() == [10.0 * n for n in order]
