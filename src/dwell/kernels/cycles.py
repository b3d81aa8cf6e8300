"""The life of a cycle: release, inputs, workers, completion, loss."""

from __future__ import annotations

from dwell.kernels.compiled import index, phase
from dwell.kernels.heaps import push_event
from dwell.kernels.layout import (
    CANDIDATE,
    CANDIDATE_0,
    CELL_SHIFT,
    COMPUTE,
    CYCLE,
    CYCLE_SHIFT,
    DEPTH,
    DIRTY,
    DISCARDED,
    DONE,
    DOWN,
    DROPPED,
    FAIR,
    FIRST,
    FLOW_0,
    HEAD,
    IDLE,
    IN_FLIGHT,
    IS_CPU,
    KIND_SHIFT,
    LIVE,
    LOG_END,
    LOG_READY,
    LOG_START,
    LOST,
    LOST_ON_LINK,
    MISSING,
    N_CANDIDATES,
    N_CYCLES,
    N_DIRTY,
    N_IN,
    N_READY,
    N_SINKS,
    N_TASKS,
    NETWORK,
    NEXT,
    NODE,
    NODE_DOWN,
    OFFSET_NS,
    PAIR,
    PAIR_0,
    PARENT,
    READY,
    READY_AT,
    RELEASE,
    REPLACED,
    SCHEDULER,
    SERVER,
    SHADOW,
    SHADOWED,
    SHARED,
    SINKS_LEFT,
    SITE,
    SOURCE,
    START,
    STARTED,
    TAIL,
    TAKEN,
    TARGET,
    TASK_0,
    THREADS,
    UNKNOWN,
    WAITING,
    Tables,
)
from dwell.kernels.links import lose, slot_row
from dwell.kernels.nodes import dispatch, job_row, leave, schedule


@phase
def job_key(cell: int, cycle: int, local: int) -> int:
    """Pack the name of a job; `local` counts the tasks of its cell."""
    return (cell << CELL_SHIFT) | (cycle << CYCLE_SHIFT) | local


@phase
def _log(s: Tables, cell: int, cycle: int, row: int, local: int, outcome: int, end: int) -> None:
    if s.log.shape[0] == 0:
        return
    tasks = s.site_of.shape[1]
    entry = (cell * s.latency_ns.shape[1] + cycle) * tasks + local
    s.log[entry, LOG_READY] = s.jobs[row, READY]
    s.log[entry, LOG_START] = s.jobs[row, STARTED]
    s.log[entry, LOG_END] = end
    s.log_outcome[entry] = outcome


@phase
def drop_job(
    s: Tables, cell: int, cycle: int, local: int, row: int, outcome: int, now: int
) -> None:
    """Lose a ready job, and with it its cycle."""
    _log(s, cell, cycle, row, local, outcome, now)
    s.slots[slot_row(s.ring, cell, cycle), LIVE] -= 1
    lose(s, cell, cycle, outcome)


@phase
def _append(s: Tables, cell: int, cycle: int, local: int, row: int, site: int) -> None:
    s.jobs[row, NEXT] = -1
    if s.sites[site, WAITING] == 0:
        s.sites[site, HEAD] = cycle
    else:
        s.jobs[job_row(s.ring, s.stride, cell, s.sites[site, TAIL], local), NEXT] = cycle
    s.sites[site, TAIL] = cycle
    s.sites[site, WAITING] += 1


@phase
def _pop_input(s: Tables, cell: int, local: int, site: int) -> int:
    """Remove the oldest waiting job of a site and return its cycle."""
    cycle = s.sites[site, HEAD]
    s.sites[site, HEAD] = s.jobs[job_row(s.ring, s.stride, cell, cycle, local), NEXT]
    s.sites[site, WAITING] -= 1
    return int(cycle)


@phase
def note_ready(s: Tables, cell: int, cycle: int, local: int) -> None:
    """Remember that all inputs of a job are there; the event's end deals with it."""
    s.ready[s.clock[N_READY]] = job_key(cell, cycle, local)
    s.clock[N_READY] += 1


@phase
def become_ready(s: Tables, cell: int, cycle: int, local: int, now: int) -> bool:
    """Let a ready job wait at its site, or lose it; True if an idle worker takes it at once."""
    row = job_row(s.ring, s.stride, cell, cycle, local)
    s.jobs[row, READY] = now
    _log(s, cell, cycle, row, local, IN_FLIGHT, UNKNOWN)
    site = index(s.jobs[row, SITE])
    if s.servers[index(s.sites[site, SERVER]), DOWN] != 0:
        drop_job(s, cell, cycle, local, row, NODE_DOWN, now)
        return False
    if s.sites[site, IDLE] > 0 and s.sites[site, READY_AT] == 0:
        s.sites[site, IDLE] -= 1
        return True
    depth = s.sites[site, DEPTH]
    if depth > 0 and s.sites[site, WAITING] >= depth:
        oldest = s.sites[site, HEAD]
        if cycle < oldest:
            drop_job(s, cell, cycle, local, row, REPLACED, now)
            return False
        _pop_input(s, cell, local, site)
        old_row = job_row(s.ring, s.stride, cell, oldest, local)
        drop_job(s, cell, oldest, local, old_row, REPLACED, now)
    _append(s, cell, cycle, local, row, site)
    return False


@phase
def free_worker(s: Tables, cell: int, local: int, site: int) -> None:
    """Let a worker that has become free take what waits, or be idle."""
    if s.sites[site, WAITING] == 0:
        s.sites[site, IDLE] += 1
        return
    cycle = _pop_input(s, cell, local, site)
    s.ready[s.clock[N_READY]] = job_key(cell, cycle, local) | TAKEN
    s.clock[N_READY] += 1


@phase
def drop_waiting(s: Tables, cell: int, local: int, site: int, now: int) -> None:
    """Lose everything that waits at a site, because its node went down."""
    while s.sites[site, WAITING] > 0:
        cycle = _pop_input(s, cell, local, site)
        row = job_row(s.ring, s.stride, cell, cycle, local)
        drop_job(s, cell, cycle, local, row, NODE_DOWN, now)


@phase
def arrive(s: Tables, cell: int, cycle: int, flow: int, now: int) -> None:
    """Handle a message that reaches its node, or that is lost on its link."""
    if flow & LOST_ON_LINK:
        s.slots[slot_row(s.ring, cell, cycle), LIVE] -= 1
        lose(s, cell, cycle, DROPPED)
        return
    row = job_row(s.ring, s.stride, cell, cycle, s.flows[_flow_row(s, cell, flow), TARGET])
    if s.servers[index(s.sites[index(s.jobs[row, SITE]), SERVER]), DOWN] != 0:
        s.slots[slot_row(s.ring, cell, cycle), LIVE] -= 1
        lose(s, cell, cycle, NODE_DOWN)
        return
    hand_over(s, cell, cycle, flow, now)


@phase
def finish(s: Tables, cell: int, cycle: int, row: int, now: int) -> None:
    """A sink has completed; the last one completes the cycle."""
    slot = slot_row(s.ring, cell, cycle)
    s.slots[slot, LIVE] -= 1
    s.slots[slot, SINKS_LEFT] -= 1
    if s.slots[slot, SINKS_LEFT] == 0:
        s.outcome[cell, cycle] = DONE
        s.latency_ns[cell, cycle] = now - s.release_ns[cell, cycle]
        s.compute_ns[cell, cycle] = s.jobs[row, COMPUTE]
        s.network_ns[cell, cycle] = s.jobs[row, NETWORK]


@phase
def complete(
    s: Tables, server: int, site: int, cell: int, cycle: int, local: int, row: int, now: int
) -> None:
    """The job of a server that finishes first has finished; its outputs are the caller's."""
    leave(s, server, site, now)
    if s.servers[server, IS_CPU] != 0:
        work = s.sites[site, THREADS] * float(s.exec_ns[site, cycle])
        s.own[cell, index(s.sites[site, NODE])] += work
    s.jobs[row, COMPUTE] += now - s.jobs[row, STARTED]
    _log(s, cell, cycle, row, local, DONE, now)


@phase
def _flow_row(s: Tables, cell: int, flow: int) -> int:
    return index(s.cells[cell, FLOW_0] + flow)


@phase
def _discarded(s: Tables, cell: int, cycle: int, local: int) -> bool:
    """Whether a task is one that the shadow of a cycle stops before."""
    if s.cells[cell, PARENT] < 0:
        return False
    pair = index(s.slots[slot_row(s.ring, cell, cycle), PAIR])
    return bool(s.shadow_parts[pair, local] == DISCARDED)


@phase
def hand_over(s: Tables, cell: int, cycle: int, flow: int, now: int) -> None:
    """Count an input in; the last one makes the job ready and names its critical path."""
    ends = _flow_row(s, cell, flow)
    local = s.flows[ends, TARGET]
    row = job_row(s.ring, s.stride, cell, cycle, local)
    if s.log_arrived.shape[0] > 0:
        s.log_arrived[cell * s.latency_ns.shape[1] + cycle, flow] = now
    missing = s.jobs[row, MISSING] - 1
    s.jobs[row, MISSING] = missing
    if missing == 0 and not _discarded(s, cell, cycle, local):
        sender = job_row(s.ring, s.stride, cell, cycle, s.flows[ends, SOURCE])
        s.jobs[row, COMPUTE] = s.jobs[sender, COMPUTE]
        s.jobs[row, NETWORK] = now - s.jobs[sender, NETWORK]
        note_ready(s, cell, cycle, local)
    else:
        s.slots[slot_row(s.ring, cell, cycle), LIVE] -= 1


@phase
def hop_of(s: Tables, cell: int, cycle: int, flow: int) -> int:
    """Hop that a flow takes in a cycle, -1 on the same node."""
    return int(s.route[index(s.slots[slot_row(s.ring, cell, cycle), CANDIDATE]), index(flow)])


@phase
def release(s: Tables, cell: int, cycle: int, now: int) -> None:
    """Release a cycle, and its shadow if it has one; the next release is announced.

    Of the shadow only sources that it does not share start, as those do that start later.
    """
    shadow = s.cells[cell, SHADOW]
    active = s.stamps[cell, cycle]
    for i in range(2 if shadow >= 0 and s.stamps[shadow, cycle] >= 0 else 1):
        to = cell if i == 0 else shadow
        candidate = s.cells[to, CANDIDATE_0] + s.stamps[to, cycle]
        pair = s.cells[to, PAIR_0] + active * s.cells[to, N_CANDIDATES] + s.stamps[to, cycle]
        sources = 0
        for local in range(s.cells[to, N_TASKS]):
            task = index(s.cells[to, TASK_0] + local)
            row = job_row(s.ring, s.stride, to, cycle, local)
            s.jobs[row, MISSING] = s.tasks[task, N_IN]
            s.jobs[row, STARTED] = -1
            s.jobs[row, SITE] = s.site_of[index(candidate), local]
            s.jobs[row, COMPUTE] = 0
            s.jobs[row, NETWORK] = 0
            if s.tasks[task, N_IN] > 0 or (i > 0 and s.shadow_parts[pair, local] != SHADOWED):
                continue
            sources += 1
            offset = s.tasks[task, OFFSET_NS]
            if i == 0 and offset == 0:
                note_ready(s, to, cycle, local)
            else:
                key = (START << KIND_SHIFT) | job_key(to, cycle, local)
                push_event(s.clock, s.event_t, s.event_key, now + offset, key)
        slot = slot_row(s.ring, to, cycle)
        s.slots[slot, CYCLE] = cycle
        s.slots[slot, CANDIDATE] = candidate
        s.slots[slot, PAIR] = pair
        s.slots[slot, LIVE] = sources
        s.slots[slot, LOST] = 0
        s.slots[slot, SINKS_LEFT] = s.cells[to, N_SINKS]
    following = cycle + 1
    if following < s.cells[cell, N_CYCLES]:
        key = (RELEASE << KIND_SHIFT) | job_key(cell, following, FIRST)
        t = s.release_ns[cell, following]
        push_event(s.clock, s.event_t, s.event_key, t, key)


@phase
def shared_by(s: Tables, cell: int, cycle: int, local: int) -> int:
    """Shadow that shares a task with a cycle, -1 for none."""
    shadow = s.cells[cell, SHADOW]
    if shadow < 0 or s.stamps[shadow, cycle] < 0:
        return -1
    pair = index(s.slots[slot_row(s.ring, shadow, cycle), PAIR])
    return int(shadow) if s.shadow_parts[pair, local] == SHARED else -1


@phase
def flush(s: Tables, now: int) -> None:
    """Give out cores, and announce completions, on every server the event touched."""
    for i in range(s.clock[N_DIRTY]):
        server = index(s.dirty[i])
        s.servers[server, DIRTY] = 0
        if s.servers[server, SCHEDULER] != FAIR:
            dispatch(s, server, now)
        schedule(s, server, now)
    s.clock[N_DIRTY] = 0
