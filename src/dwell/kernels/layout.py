"""Columns of the kernels' tables and the packing of event keys.

A cell may have a *shadow*: another row of `cells` with sites and hops of its own, on the same
servers and links, whose cycles are released by those of its parent. A *pair* of candidates (active,
other) is row ``PAIR_0 + active * N_CANDIDATES + other`` of `shadow_parts`.

Entities (cells, tasks, sites, servers, hops, links) are rows of two-dimensional int64 tables; the
names below are their columns. A *site* is a task on one feasible node of one cell; a *server* is
what executes jobs: the CPU of a node, or one kind of its accelerators; a *hop* is a flow on a link.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def _number(value: int) -> int:
    """Return an integer that is no literal to Numba, which compiles functions anew for each."""
    return cast(int, np.int64(value))


# Kinds of events in the order in which equal times are handled.
COMPLETION, ARRIVAL, START, RETRY, CHANGE, RESTART, MIGRATE, CLOSE, GUARD, RELEASE = range(10)

# An event key packs (kind, cell, cycle, item), so that keys order as the tuple does. The item is
# a task or a flow of the cell, a site, or nothing, according to the kind.
ITEM_BITS, CYCLE_BITS, CELL_BITS = 14, 32, 13
CYCLE_SHIFT = ITEM_BITS
CELL_SHIFT = ITEM_BITS + CYCLE_BITS
KIND_SHIFT = ITEM_BITS + CYCLE_BITS + CELL_BITS
# Marks a job on the ready list that a worker has taken already; the kind's place is free there.
TAKEN = 1 << KIND_SHIFT
# Marks an arrival that is the loss of a message; flows stay below it.
LOST_ON_LINK = 1 << (ITEM_BITS - 1)
ITEM_MASK = (1 << ITEM_BITS) - 1
CYCLE_MASK = (1 << CYCLE_BITS) - 1
CELL_MASK = (1 << CELL_BITS) - 1

# What `advance` returns.
PAUSED, FINISHED, GROW_EVENTS, GROW_RING, STEP = range(5)


# Outcomes of cycles and jobs.
IN_FLIGHT, DONE, DROPPED, REPLACED, NODE_DOWN = (_number(code) for code in range(5))
FIRST, UNKNOWN = _number(0), _number(-1)

# Schedulers. TURNS is that of a fair node whose quota is noticed at ticks.
FAIR, FIFO, PRIORITY, TURNS = range(4)

# clock: scalars that outlive a call.
# END is the instant of the last close that any cell can have.
(
    N_EVENTS,
    N_DIRTY,
    N_READY,
    NEXT_CHANGE,
    PAUSE,
    CLOSED_CELL,
    STEP_KEY,
    STEP_NS,
    END,
    N_CLOCK,
) = range(10)

# cells
# GUARD_T is when the guard looks next, -1 for never, and GUARD_NS is g periods; WAITED is the first
# cycle that no completion has been heard of or after, MOVED the first one of the newest placement
# that is waited for; once a completion has been heard, no cycle before RESTED is.
(
    TASK_0,
    N_TASKS,
    FLOW_0,
    CANDIDATE_0,
    N_SINKS,
    N_CYCLES,
    WINDOW,
    WINDOW_FIRST,
    CLOSE_CYCLE,
    CLOSE_PENDING,
    WINDOW_CYCLES,
    N_CANDIDATES,
    PAIR_0,
    SHADOW,
    PARENT,
    MIGRATING,
    GUARD_T,
    GUARD_NS,
    WAITED,
    MOVED,
    RESTED,
    N_CELL,
) = range(22)

# Where a link has no timeout of its own, state that was lost is sent again after Linux's least
# TCP retransmission timeout.
STATE_TIMEOUT_NS = 200_000_000

# shadow_parts: what a task is to the shadow of a cycle.
SHARED, SHADOWED, DISCARDED = range(3)

# tasks
N_IN, N_OUT, OUT_0, OFFSET_NS, N_TASK = range(5)

# flows
SOURCE, TARGET, N_FLOW = range(3)

# sites
# NEED is what a job uses of its server: the cores that it holds, the threads that share them where
# the server is fair, or a place. THREADS is how many threads its work is done by.
(
    SITE_CELL,
    SITE_TASK,
    SERVER,
    NODE,
    WORKERS,
    IDLE,
    HEAD,
    TAIL,
    WAITING,
    NEED,
    THREADS,
    READY_AT,
    START_NS,
    DEPTH,
    RANK,
    BEFORE_NS,
    AFTER_NS,
    N_SITE,
) = range(18)

# A foreign thread among those that wait for their turn, where jobs have their keys.
FOREIGN = _number(-1)

# servers
# TICK_NS is the time between ticks, 0 for a quota that is noticed at once; at time 0 the last tick
# was TICK_AGO and the last begin of a period PERIOD_AGO ago. TURN says whether a thread has the
# turn, TURN_V what it had received before, and TURN_NS what since; a turn lasts LEAST_NS at least.
# DRAWN_NS is what is drawn on a pool at a time. WAKE_T is when something of the background wakes
# next, the WAKES-th time, and WAKE_GAP_NS the mean time between two. All that a quota counts is in
# time of the core: of that, what runs receives the share PACE.
(
    SCHEDULER,
    CORES,
    STRESS,
    USED,
    N_RUN,
    N_WAIT,
    DOWN,
    LAST,
    NEXT_T,
    NEXT_KEY,
    BASE,
    NODE_OF,
    DIRTY,
    IS_CPU,
    QUOTA_NS,
    STRESSED_NS,
    PERIOD_NS,
    LEFT_NS,
    PERIOD,
    THROTTLED,
    QUOTA_T,
    POOL_NS,
    SLACK_NS,
    TICK_NS,
    TICK_AGO,
    PERIOD_AGO,
    TURN,
    TURN_V,
    TURN_NS,
    LEAST_NS,
    DRAWN_NS,
    WAKE_T,
    WAKES,
    WAKE_KEY,
    N_SERVER,
) = range(35)

# What a server's quota counts while the CPU of a node, server OTHER, has foreign threads; -1: while
# none has of those for which there are rows.
(
    PACED,
    OTHER,
    PACED_QUOTA_NS,
    PACED_STRESSED_NS,
    PACED_SLACK_NS,
    PACED_LEAST_NS,
    PACED_DRAWN_NS,
    N_PACE,
) = range(8)

# servers, float64
# BUSY_NS is in core-nanoseconds, of which 64 bits may not hold those of all cores.
(
    VIRTUAL,
    SPEED,
    SPARE,
    BACKGROUND,
    BEHIND_NS,
    BUSY_NS,
    BESIDE,
    PACE,
    WAKE_GAP_NS,
    N_SERVER_F,
) = range(10)

# hops
LINK, PAYLOAD, N_HOP = range(3)

# links
FREE, LAST_ARRIVAL, IN_ORDER, RETRANSMIT_NS, SEGMENT, SEGMENT_END, N_LINK = range(7)

# link segments, int64 and float64
SEGMENT_AT, SEGMENT_DOWN, SEGMENT_LAYERS, N_SEGMENT = range(4)
SEGMENT_RATE, SEGMENT_LOSS, N_SEGMENT_F = range(3)

# node changes
CHANGE_AT, CHANGE_NODE, CHANGE_STRESS, CHANGE_DOWN, N_CHANGE = range(5)

# jobs in the ring
# MISSING counts the inputs that have not arrived.
# REST is the work of the threads that the one at work hands its job over to.
READY, STARTED, COMPUTE, NETWORK, SITE, NEXT, MISSING, REST, N_JOB = range(9)

# cycles in the ring
# LIVE counts the jobs and messages of the cycle that are still under way; PAIR is the row of
# shadow_parts, in the shadow of a cell.
CYCLE, CANDIDATE, LIVE, SINKS_LEFT, LOST, PAIR, N_SLOT = range(7)

# job log
LOG_READY, LOG_START, LOG_END, N_LOG = range(4)


class Tables(NamedTuple):
    """Every array of a simulation; the order is that of `advance`'s arguments.

    Fixed: what the problem and the realisation say. State: what changes as the clock goes on.
    Outputs: per cycle, per window, and per job where a log is kept.
    """

    # scalars: cycles of a cell that may be in flight (a power of two), jobs of a cycle, and the
    # events that one event may add
    ring: int
    stride: int
    margin: int
    # fixed
    tasks: Ints  # (tasks, N_TASK)
    flows: Ints  # (flows, N_FLOW)
    out_flows: Ints  # flows out of each task, in the order of the file
    site_of: Ints  # (candidates, tasks of a cell) -> site
    route: Ints  # (candidates, flows of a cell) -> hop, or -1 on the same node
    back_ns: Ints  # (candidates,) time from a completion until the guard hears of it
    shadow_parts: Ints  # (pairs of candidates, tasks of a cell)
    hops: Ints  # (hops, N_HOP)
    loss_keys: NDArray[np.uint64]  # (hops,)
    layer_rows: Ints  # (hops, layers) -> row of extra_ns, or -1
    segments: Ints  # (segments, N_SEGMENT)
    segments_f: Floats  # (segments, N_SEGMENT_F)
    changes: Ints  # (changes, N_CHANGE)
    paces: Ints  # (paces, N_PACE)
    paces_f: Floats  # (paces,) PACE of the server meanwhile
    release_ns: Ints  # (cells, N + 1)
    close_ns: Ints  # (cells, N), close of the window that a cycle is the last of
    exec_ns: Ints  # (sites, N)
    delay_ns: Ints  # (hops, N)
    extra_ns: Ints  # (layers, N)
    stamps: NDArray[np.int16]  # (cells, N), candidate of each cycle; -1 where a shadow has none
    # state
    clock: Ints  # (N_CLOCK,)
    cells: Ints  # (cells, N_CELL)
    sites: Ints  # (sites, N_SITE)
    servers: Ints  # (servers, N_SERVER)
    servers_f: Floats  # (servers, N_SERVER_F)
    links: Ints  # (links, N_LINK)
    run_v: Floats  # per server a heap of running jobs by virtual finish
    run_key: Ints
    wait_rank: Ints  # per server a heap of jobs that wait for cores
    wait_ready: Ints
    wait_key: Ints
    wait_left: Floats
    dirty: Ints  # servers to dispatch at the end of the event
    ready: Ints  # jobs that the event has made ready
    event_t: Ints  # heap of events
    event_key: Ints
    jobs: Ints  # (cells * ring * tasks of a cell, N_JOB)
    slots: Ints  # (cells * ring, N_SLOT)
    attempts: Ints  # (cells * ring, flows of a cell) attempts lost so far, less one
    own: Floats  # (cells, nodes) core-nanoseconds of completed own work
    # outputs
    latency_ns: Ints  # (cells, N), -1 until done
    compute_ns: Ints
    network_ns: Ints
    outcome: NDArray[np.int8]
    opened: Floats  # (cells, windows, 3, nodes) busy, own and shadow at the first release
    closed: Floats  # (cells, windows, 3, nodes) busy, own and shadow at the close
    log: Ints  # (cells * N * tasks, N_LOG), or empty
    log_outcome: NDArray[np.int8]
    log_arrived: Ints  # (cells * N, flows of a cell), or empty
