"""Binary heaps over parallel arrays: events by (time, key), running jobs, waiting jobs.

The arrays belong to the caller; a heap is a part of them from `base` with `n` entries.
"""

from __future__ import annotations

from dwell.kernels.compiled import index, kernel, phase
from dwell.kernels.layout import N_EVENTS, Floats, Ints


@phase
def push_event(clock: Ints, event_t: Ints, event_key: Ints, t: int, key: int) -> None:
    """Add an event; the caller has made sure of room."""
    i = clock[N_EVENTS]
    clock[N_EVENTS] = i + 1
    while i > 0:
        parent = (i - 1) >> 1
        pt = event_t[index(parent)]
        if pt < t or (pt == t and event_key[index(parent)] < key):
            break
        event_t[index(i)] = pt
        event_key[index(i)] = event_key[index(parent)]
        i = parent
    event_t[index(i)] = t
    event_key[index(i)] = key


@kernel
def post_event(clock: Ints, event_t: Ints, event_key: Ints, t: int, key: int) -> None:
    """Add an event from Python; there must be room (see `advance`)."""
    push_event(clock, event_t, event_key, t, key)


@phase
def pop_event(clock: Ints, event_t: Ints, event_key: Ints) -> None:
    """Remove the first event."""
    n = clock[N_EVENTS] - 1
    clock[N_EVENTS] = n
    t = event_t[index(n)]
    key = event_key[index(n)]
    i = 0
    child = 1
    while child < n:
        right = child + 1
        ct = event_t[index(child)]
        ck = event_key[index(child)]
        if right < n:
            rt = event_t[index(right)]
            rk = event_key[index(right)]
            if rt < ct or (rt == ct and rk < ck):
                child, ct, ck = right, rt, rk
        if t < ct or (t == ct and key <= ck):
            break
        event_t[index(i)] = ct
        event_key[index(i)] = ck
        i = child
        child = 2 * i + 1
    event_t[index(i)] = t
    event_key[index(i)] = key


@phase
def push_running(run_v: Floats, run_key: Ints, base: int, n: int, v: float, key: int) -> None:
    """Add a job with virtual finish `v` to a heap of n running jobs."""
    i = n
    while i > 0:
        parent = (i - 1) >> 1
        pv = run_v[index(base + parent)]
        if pv < v or (pv == v and run_key[index(base + parent)] < key):
            break
        run_v[index(base + i)] = pv
        run_key[index(base + i)] = run_key[index(base + parent)]
        i = parent
    run_v[index(base + i)] = v
    run_key[index(base + i)] = key


@phase
def pop_running(run_v: Floats, run_key: Ints, base: int, n: int, at: int) -> None:
    """Remove entry `at` (0 is the first to finish) from a heap of n running jobs."""
    if at == n - 1:
        return
    v = run_v[index(base + n - 1)]
    key = run_key[index(base + n - 1)]
    i = at
    # Towards the root, needed only where the entry comes from the middle.
    while i > 0:
        parent = (i - 1) >> 1
        pv = run_v[index(base + parent)]
        if pv < v or (pv == v and run_key[index(base + parent)] < key):
            break
        run_v[index(base + i)] = pv
        run_key[index(base + i)] = run_key[index(base + parent)]
        i = parent
    child = 2 * i + 1
    while child < n - 1:
        right = child + 1
        if right < n - 1:
            rv = run_v[index(base + right)]
            cv = run_v[index(base + child)]
            if rv < cv or (
                rv == cv and run_key[index(base + right)] < run_key[index(base + child)]
            ):
                child = right
        cv = run_v[index(base + child)]
        if v < cv or (v == cv and key <= run_key[index(base + child)]):
            break
        run_v[index(base + i)] = cv
        run_key[index(base + i)] = run_key[index(base + child)]
        i = child
        child = 2 * i + 1
    run_v[index(base + i)] = v
    run_key[index(base + i)] = key


@phase
def _before(rank_a: int, ready_a: int, key_a: int, rank_b: int, ready_b: int, key_b: int) -> bool:
    if rank_a != rank_b:
        return rank_a < rank_b
    if ready_a != ready_b:
        return ready_a < ready_b
    return key_a < key_b


@phase
def push_waiting(
    wait_rank: Ints,
    wait_ready: Ints,
    wait_key: Ints,
    wait_left: Floats,
    base: int,
    n: int,
    rank: int,
    ready: int,
    key: int,
    left: float,
) -> None:
    """Add a job with `left` nanoseconds of work to a heap of n jobs that wait for cores."""
    i = n
    while i > 0:
        p = base + ((i - 1) >> 1)
        if _before(wait_rank[p], wait_ready[p], wait_key[p], rank, ready, key):
            break
        wait_rank[base + i] = wait_rank[p]
        wait_ready[base + i] = wait_ready[p]
        wait_key[base + i] = wait_key[p]
        wait_left[base + i] = wait_left[p]
        i = p - base
    wait_rank[base + i] = rank
    wait_ready[base + i] = ready
    wait_key[base + i] = key
    wait_left[base + i] = left


@phase
def pop_waiting(
    wait_rank: Ints, wait_ready: Ints, wait_key: Ints, wait_left: Floats, base: int, n: int
) -> None:
    """Remove the first of n jobs that wait for cores."""
    last = base + n - 1
    rank, ready, key, left = wait_rank[last], wait_ready[last], wait_key[last], wait_left[last]
    i = base
    child = 1
    while child < n - 1:
        c = base + child
        r = c + 1
        if child + 1 < n - 1 and _before(
            wait_rank[r], wait_ready[r], wait_key[r], wait_rank[c], wait_ready[c], wait_key[c]
        ):
            c = r
        if _before(rank, ready, key, wait_rank[c], wait_ready[c], wait_key[c]):
            break
        wait_rank[i] = wait_rank[c]
        wait_ready[i] = wait_ready[c]
        wait_key[i] = wait_key[c]
        wait_left[i] = wait_left[c]
        i = c
        child = 2 * (c - base) + 1
    wait_rank[i], wait_ready[i], wait_key[i], wait_left[i] = rank, ready, key, left
