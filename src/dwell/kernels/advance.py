"""The event loop: one call plays a simulation to the next close of a window, or to its end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.compiled import fixed_columns, index, kernel, phase
from dwell.kernels.cycles import (
    arrive,
    become_ready,
    complete,
    drop_job,
    drop_waiting,
    finish,
    flush,
    free_worker,
    hand_over,
    hop_of,
    job_key,
    note_ready,
    release,
    shared_by,
)
from dwell.kernels.far_instants import later
from dwell.kernels.heaps import pop_event, push_event
from dwell.kernels.layout import (
    ARRIVAL,
    BASE,
    BEHIND_NS,
    BUSY_NS,
    CANDIDATE_0,
    CELL_MASK,
    CELL_SHIFT,
    CHANGE,
    CHANGE_AT,
    CHANGE_DOWN,
    CHANGE_NODE,
    CHANGE_STRESS,
    CLOSE,
    CLOSE_CYCLE,
    CLOSE_PENDING,
    CLOSED_CELL,
    COMPLETION,
    CYCLE,
    CYCLE_MASK,
    CYCLE_SHIFT,
    DONE,
    DOWN,
    END,
    FINISHED,
    FIRST,
    FLOW_0,
    FOREIGN,
    GROW_EVENTS,
    GROW_RING,
    GUARD,
    GUARD_NS,
    GUARD_T,
    IDLE,
    IS_CPU,
    ITEM_MASK,
    KIND_SHIFT,
    LIVE,
    MIGRATE,
    MIGRATING,
    MISSING,
    MOVED,
    N_CELL,
    N_CHANGE,
    N_CYCLES,
    N_EVENTS,
    N_FLOW,
    N_HOP,
    N_IN,
    N_JOB,
    N_LINK,
    N_OUT,
    N_PACE,
    N_READY,
    N_RUN,
    N_SEGMENT,
    N_SEGMENT_F,
    N_SERVER,
    N_SERVER_F,
    N_SITE,
    N_SLOT,
    N_TASK,
    N_TASKS,
    N_WAIT,
    NEED,
    NETWORK,
    NEXT_CHANGE,
    NEXT_KEY,
    NEXT_T,
    NODE,
    NODE_DOWN,
    NODE_OF,
    OTHER,
    OUT_0,
    PACE,
    PACED,
    PARENT,
    PAUSE,
    PAUSED,
    QUOTA_T,
    READY_AT,
    RELEASE,
    REST,
    RESTART,
    RESTED,
    RETRY,
    SCHEDULER,
    SERVER,
    SHADOW,
    SITE,
    SITE_CELL,
    SITE_TASK,
    START,
    START_NS,
    STEP,
    STEP_KEY,
    STEP_NS,
    STRESS,
    TAKEN,
    TARGET,
    TASK_0,
    TURNS,
    UNKNOWN,
    USED,
    VIRTUAL,
    WAITED,
    WAITING,
    WINDOW,
    WINDOW_CYCLES,
    WINDOW_FIRST,
    WORKERS,
    Floats,
    Ints,
    Tables,
)
from dwell.kernels.links import lose, send, slot_row
from dwell.kernels.nodes import (
    admit,
    draw_quota,
    job_row,
    key_row,
    leave,
    mark,
    next_thread,
    renew_before_stress,
    repace,
    restress,
    set_speed,
    tick,
    time_alone,
)

# More inputs than any task has: a join that can never be complete.
NEVER = 1 << 30


@phase
def _progress(s: Tables, server: int, at: int) -> tuple[int, float]:
    """Key of a job on a server, and the core-nanoseconds that it has received so far.

    Those that run are counted first, then those that wait for cores and may have been preempted.
    """
    running = s.servers[server, N_RUN]
    if at < running:
        row = index(s.servers[server, BASE] + at)
        key, left = s.run_key[row], s.run_v[row] - s.servers_f[server, VIRTUAL]
    else:
        row = index(s.servers[server, BASE] + at - running)
        key, left = s.wait_key[row], s.wait_left[row]
        if key == FOREIGN:
            return FOREIGN, 0.0
    cycle = (key >> CYCLE_SHIFT) & CYCLE_MASK
    job = key_row(s.ring, s.stride, key)
    site = index(s.jobs[job, SITE])
    left = max(left, 0.0) + s.jobs[job, REST]
    return key, s.sites[site, NEED] * (time_alone(s, site, s.exec_ns[site, cycle]) - left)


@phase
def _snapshot(s: Tables, out: Floats, cell: int, row: int, now: int) -> None:
    """Write every node's core-nanoseconds up to now: busy, the cell's own, its shadow's."""
    for number in range(s.servers.shape[0]):
        server = index(number)
        if s.servers[server, IS_CPU] == 0:
            continue
        tick(s, server, now)
        node = s.servers[server, NODE_OF]
        shadow = s.cells[cell, SHADOW]
        own = s.own[cell, node]
        extra = s.own[shadow, node] if shadow >= 0 else 0.0
        for i in range(s.servers[server, N_RUN] + s.servers[server, N_WAIT]):
            key, received = _progress(s, server, i)
            if key == FOREIGN:
                continue
            whose = (key >> CELL_SHIFT) & CELL_MASK
            if whose == cell:
                own += received
            elif whose == shadow:
                extra += received
        busy = s.servers_f[server, BUSY_NS] * s.servers_f[server, PACE]
        out[cell, row, 0, node] = busy + s.servers_f[server, BEHIND_NS]
        out[cell, row, 1, node] = own
        out[cell, row, 2, node] = extra


@phase
def _announce(s: Tables) -> int:
    """Announce every cell's next close; return how many cells wait for one, or migrate."""
    n = 0
    for cell in range(s.cells.shape[0]):
        n += s.cells[cell, MIGRATING]
        boundary = s.cells[cell, CLOSE_CYCLE]
        if s.cells[cell, CLOSE_PENDING] == 0 and boundary <= s.cells[cell, N_CYCLES]:
            s.cells[cell, CLOSE_PENDING] = 1
            t = s.close_ns[cell, boundary - 1]
            key = (CLOSE << KIND_SHIFT) | (cell << CELL_SHIFT) | (boundary << CYCLE_SHIFT)
            push_event(s.clock, s.event_t, s.event_key, t, key)
        n += s.cells[cell, CLOSE_PENDING]
    return int(n)


@phase
def _close(s: Tables, cell: int, now: int) -> None:
    """Close a window; the next one follows without a gap unless the caller says otherwise."""
    _snapshot(s, s.closed, cell, s.cells[cell, WINDOW], now)
    s.clock[CLOSED_CELL] = cell
    s.cells[cell, CLOSE_PENDING] = 0
    s.cells[cell, WINDOW] += 1
    s.cells[cell, WINDOW_FIRST] = s.cells[cell, CLOSE_CYCLE]
    s.cells[cell, CLOSE_CYCLE] += s.cells[cell, WINDOW_CYCLES]


@phase
def _silent(s: Tables, cell: int, now: int) -> bool:
    """Whether the guard fires; if not, it looks again when it would if nothing completed.

    Nothing has to be done at completions: the guard fires no earlier than g periods after the
    release of the cycle that it has waited for, and what has completed by then can be seen then.
    """
    if s.cells[cell, GUARD_T] != now:
        # It has been told to look at another time instead.
        return False
    s.cells[cell, GUARD_T] = -1
    cycles = s.cells[cell, N_CYCLES]
    waited = s.cells[cell, WAITED]
    cycle = waited
    while cycle < cycles and s.release_ns[cell, cycle] < now:
        if s.outcome[cell, cycle] == DONE:
            back = s.back_ns[index(s.cells[cell, CANDIDATE_0] + s.stamps[cell, cycle])]
            done = s.release_ns[cell, cycle] + s.latency_ns[cell, cycle]
            if later(done, back) <= now:
                waited = max(cycle + 1, s.cells[cell, RESTED])
        cycle += 1
    moved = s.cells[cell, MOVED]
    if waited < moved and s.release_ns[cell, moved] < now:
        waited = moved
    s.cells[cell, WAITED] = waited
    if waited >= cycles:
        return False
    due = later(s.release_ns[cell, waited], s.cells[cell, GUARD_NS])
    if due <= now:
        return True
    s.cells[cell, GUARD_T] = due
    push_event(s.clock, s.event_t, s.event_key, due, (GUARD << KIND_SHIFT) | (cell << CELL_SHIFT))
    return False


@phase
def _lose_key(s: Tables, key: int, now: int) -> None:
    cell = (key >> CELL_SHIFT) & CELL_MASK
    cycle = (key >> CYCLE_SHIFT) & CYCLE_MASK
    local = key & ITEM_MASK
    drop_job(s, cell, cycle, local, job_row(s.ring, s.stride, cell, cycle, local), NODE_DOWN, now)


@phase
def _crash(s: Tables, server: int, now: int) -> None:
    """Lose what runs or waits for cores on a server whose node goes down."""
    for i in range(s.servers[server, N_RUN] + s.servers[server, N_WAIT]):
        key, received = _progress(s, server, i)
        if key == FOREIGN:
            continue
        if s.servers[server, IS_CPU] != 0:
            s.own[(key >> CELL_SHIFT) & CELL_MASK, s.servers[server, NODE_OF]] += received
        _lose_key(s, key, now)
    while s.servers[server, N_RUN] > 0:
        key = s.run_key[s.servers[server, BASE]]
        leave(s, server, index(s.jobs[key_row(s.ring, s.stride, key), SITE]), now)
    s.servers[server, N_WAIT] = 0
    # Jobs that wait for their turn count, too.
    s.servers[server, USED] = 0


@phase
def _lose_joins(s: Tables, node: int) -> None:
    """Lose the inputs that wait on a node for the rest of their join."""
    for slot in range(s.slots.shape[0]):
        cell = slot // s.ring
        # A shadow may have nothing under way and yet wait for what it shares with its parent.
        if s.slots[slot, LIVE] == 0 and s.cells[cell, PARENT] < 0:
            continue
        for local in range(s.cells[cell, N_TASKS]):
            row = slot * s.stride + local
            inputs = s.tasks[s.cells[cell, TASK_0] + local, N_IN]
            partial = 0 < s.jobs[row, MISSING] < inputs
            if partial and s.sites[s.jobs[row, SITE], NODE] == node:
                lose(s, cell, s.slots[slot, CYCLE], NODE_DOWN)
                s.jobs[row, MISSING] = NEVER


@phase
def _change(s: Tables, now: int) -> None:
    """Apply the next change of a node: foreign threads, down, up."""
    change = s.clock[NEXT_CHANGE]
    s.clock[NEXT_CHANGE] = change + 1
    node = s.changes[change, CHANGE_NODE]
    down = s.changes[change, CHANGE_DOWN]
    turned = False
    for number in range(s.servers.shape[0]):
        server = index(number)
        if s.servers[server, NODE_OF] != node:
            continue
        tick(s, server, now)
        turned = s.servers[server, DOWN] != down
        if turned and down != 0:
            _crash(s, server, now)
        s.servers[server, DOWN] = down
        if s.servers[server, IS_CPU] != 0:
            stress = s.changes[change, CHANGE_STRESS]
            renew_before_stress(s, server, now)
            anew = stress != s.servers[server, STRESS] or (turned and down != 0)
            if anew and s.servers[server, SCHEDULER] == TURNS:
                restress(s, server, stress)
            s.servers[server, STRESS] = stress
        set_speed(s, server)
        mark(s, server)
    for number in range(s.paces.shape[0]):
        other = s.paces[index(number), OTHER]
        if other >= 0 and s.servers[index(other), NODE_OF] == node:
            repace(s, index(s.paces[index(number), PACED]), now)
    if turned:
        _turn_sites(s, node, down, now)


@phase
def _quota(s: Tables, server: int, now: int) -> None:
    """A server's quota is used up or renewed, unless the announcement has gone stale."""
    if s.servers[server, QUOTA_T] == now:
        s.servers[server, QUOTA_T] = -1
        tick(s, server, now)
        draw_quota(s, server, now)
        mark(s, server)


@phase
def _turn_sites(s: Tables, node: int, down: int, now: int) -> None:
    """Empty the inputs of a node that went down; restart its workers when it is up again."""
    for number in range(s.sites.shape[0]):
        site = index(number)
        if s.sites[site, NODE] != node:
            continue
        if down != 0:
            drop_waiting(s, s.sites[site, SITE_CELL], s.sites[site, SITE_TASK], site, now)
            s.sites[site, IDLE] = s.sites[site, WORKERS]
            continue
        ready = now + s.sites[site, START_NS]
        s.sites[site, READY_AT] = 0
        if ready > now:
            s.sites[site, READY_AT] = ready
            key = (RESTART << KIND_SHIFT) | (s.sites[site, SITE_CELL] << CELL_SHIFT) | number
            push_event(s.clock, s.event_t, s.event_key, ready, key)
    if down != 0:
        _lose_joins(s, node)


@phase
def _announce_change(s: Tables) -> None:
    change = s.clock[NEXT_CHANGE]
    if change < s.changes.shape[0]:
        key = CHANGE << KIND_SHIFT
        push_event(s.clock, s.event_t, s.event_key, s.changes[change, CHANGE_AT], key)


@phase
def _opens(s: Tables, cell: int, cycle: int) -> int:
    """Window that a cycle is the first of, as far as is known; -1 for none."""
    beyond = cycle - s.cells[cell, CLOSE_CYCLE]
    window = UNKNOWN
    if beyond < 0:
        if cycle == s.cells[cell, WINDOW_FIRST]:
            window = s.cells[cell, WINDOW]
    elif beyond % s.cells[cell, WINDOW_CYCLES] == 0:
        # The window before has not closed yet.
        window = s.cells[cell, WINDOW] + 1 + beyond // s.cells[cell, WINDOW_CYCLES]
    return window


@phase
def _release(s: Tables, cell: int, cycle: int, now: int) -> None:
    window = _opens(s, cell, cycle)
    if 0 <= window < s.opened.shape[1]:
        _snapshot(s, s.opened, cell, window, now)
    release(s, cell, cycle, now)


@phase
def _completion(s: Tables, cell: int, cycle: int, local: int, key: int, now: int) -> None:
    """Complete a job, unless its announcement has gone stale."""
    row = job_row(s.ring, s.stride, cell, cycle, local)
    site = index(s.jobs[row, SITE])
    server = index(s.sites[site, SERVER])
    if s.servers[server, NEXT_KEY] != key or s.servers[server, NEXT_T] != now:
        return
    if next_thread(s, server, site, row, key, now):
        return
    complete(s, server, site, cell, cycle, local, row, now)
    free_worker(s, cell, local, site)
    task = index(s.cells[cell, TASK_0] + local)
    n_out = s.tasks[task, N_OUT]
    if n_out == 0:
        finish(s, cell, cycle, row, now)
        return
    s.jobs[row, NETWORK] = now - s.jobs[row, NETWORK]
    if n_out > 1:
        s.slots[slot_row(s.ring, cell, cycle), LIVE] += n_out - 1
    # What a shadow shares is sent to it as well, after the cycle's own outputs.
    shadow = shared_by(s, cell, cycle, local)
    first = s.tasks[task, OUT_0]
    to = cell
    while True:
        for i in range(first, first + n_out):
            flow = s.out_flows[index(i)]
            if to != cell:
                target = s.flows[index(s.cells[cell, FLOW_0] + flow), TARGET]
                if shared_by(s, cell, cycle, target) >= 0:
                    continue
                s.slots[slot_row(s.ring, shadow, cycle), LIVE] += 1
            hop = hop_of(s, to, cycle, flow)
            if hop < 0:
                hand_over(s, to, cycle, flow, now)
            else:
                send(s, to, cycle, flow, hop, FIRST, now)
        if shadow < 0 or to != cell:
            break
        to = shadow


@phase
def _admit(s: Tables, cell: int, cycle: int, local: int, now: int) -> None:
    """A worker takes a job to its server."""
    row = job_row(s.ring, s.stride, cell, cycle, local)
    site = index(s.jobs[row, SITE])
    key = job_key(cell, cycle, local)
    admit(s, site, key, row, s.exec_ns[site, cycle], now)


@phase
def _settle(s: Tables, now: int) -> None:
    """Deal with the jobs that the event has made ready."""
    for i in range(s.clock[N_READY]):
        key = s.ready[i]
        cell = (key >> CELL_SHIFT) & CELL_MASK
        cycle = (key >> CYCLE_SHIFT) & CYCLE_MASK
        local = key & ITEM_MASK
        if key & TAKEN or become_ready(s, cell, cycle, local, now):
            _admit(s, cell, cycle, local, now)
    s.clock[N_READY] = 0


@phase
def _retry(s: Tables, cell: int, cycle: int, flow: int, now: int) -> None:
    """Send a message again after a lost attempt."""
    slot = slot_row(s.ring, cell, cycle)
    attempt = s.attempts[slot, flow] + 1
    send(s, cell, cycle, flow, hop_of(s, cell, cycle, flow), attempt, now)


@phase
def _restart(s: Tables, cell: int, site: int, now: int) -> None:
    """Workers of a restarted node take what has come meanwhile, unless it is down again."""
    if s.sites[site, READY_AT] != now:
        return
    s.sites[site, READY_AT] = 0
    waiting = min(s.sites[site, WAITING], s.sites[site, IDLE])
    s.sites[site, IDLE] -= waiting
    for _ in range(waiting):
        free_worker(s, cell, s.sites[site, SITE_TASK], site)


@phase
def _room(s: Tables) -> int:
    """Whether the next event finds room for all it may add; otherwise what must grow."""
    if s.clock[N_EVENTS] + s.margin > s.event_t.size:
        return GROW_EVENTS
    key = s.event_key[0]
    if key >> KIND_SHIFT == RELEASE:
        cell = (key >> CELL_SHIFT) & CELL_MASK
        cycle = (key >> CYCLE_SHIFT) & CYCLE_MASK
        if s.slots[slot_row(s.ring, cell, cycle), LIVE] > 0:
            return GROW_RING
        shadow = s.cells[cell, SHADOW]
        if shadow >= 0 and s.slots[slot_row(s.ring, shadow, cycle), LIVE] > 0:
            return GROW_RING
    return PAUSED


@phase
def _handle(s: Tables, kind: int, cell: int, cycle: int, item: int, key: int, now: int) -> None:
    if kind == COMPLETION:
        _completion(s, cell, cycle, item, key, now)
    elif kind == ARRIVAL:
        arrive(s, cell, cycle, item, now)
    elif kind == RELEASE:
        _release(s, cell, cycle, now)
    elif kind == START:
        note_ready(s, cell, cycle, item)
    elif kind == RETRY:
        _retry(s, cell, cycle, item, now)
    elif kind == CHANGE and item == 0:
        _change(s, now)
        _announce_change(s)
    elif kind == CHANGE:
        _quota(s, index(item - 1), now)
    elif kind == RESTART:
        _restart(s, cell, index(item), now)


@kernel
def advance(
    ring: int,
    stride: int,
    margin: int,
    tasks: Ints,
    flows: Ints,
    out_flows: Ints,
    site_of: Ints,
    route: Ints,
    back_ns: Ints,
    shadow_parts: Ints,
    hops: Ints,
    loss_keys: NDArray[np.uint64],
    layer_rows: Ints,
    segments: Ints,
    segments_f: Floats,
    changes: Ints,
    paces: Ints,
    paces_f: Floats,
    release_ns: Ints,
    close_ns: Ints,
    exec_ns: Ints,
    delay_ns: Ints,
    extra_ns: Ints,
    stamps: NDArray[np.int16],
    clock: Ints,
    cells: Ints,
    sites: Ints,
    servers: Ints,
    servers_f: Floats,
    links: Ints,
    run_v: Floats,
    run_key: Ints,
    wait_rank: Ints,
    wait_ready: Ints,
    wait_key: Ints,
    wait_left: Floats,
    dirty: Ints,
    ready: Ints,
    event_t: Ints,
    event_key: Ints,
    jobs: Ints,
    slots: Ints,
    attempts: Ints,
    own: Floats,
    latency_ns: Ints,
    compute_ns: Ints,
    network_ns: Ints,
    outcome: NDArray[np.int8],
    opened: Floats,
    closed: Floats,
    log: Ints,
    log_outcome: NDArray[np.int8],
    log_arrived: Ints,
) -> int:
    """Play events until a window closes (with PAUSE set), room runs out, or every window closed.

    The arguments are the fields of `Tables`, which says what each is; as bare arrays they cross
    from Python in half the time that a tuple takes.

    Returns
    -------
    int
        PAUSED: clock[CLOSED_CELL] closed a window, call again after stamping the next cycles.
        STEP: the caller's event clock[STEP_KEY] (a step of a migration, or the guard that fires) is
        due at clock[STEP_NS]. FINISHED: no window is left to close. GROW_EVENTS, GROW_RING: enlarge
        the heap of events, or the ring of cycles in flight, and call again; nothing was lost.
    """
    s = Tables(
        ring,
        stride,
        margin,
        fixed_columns(tasks, N_TASK),
        fixed_columns(flows, N_FLOW),
        out_flows,
        site_of,
        route,
        back_ns,
        shadow_parts,
        fixed_columns(hops, N_HOP),
        loss_keys,
        layer_rows,
        fixed_columns(segments, N_SEGMENT),
        fixed_columns(segments_f, N_SEGMENT_F),
        fixed_columns(changes, N_CHANGE),
        fixed_columns(paces, N_PACE),
        paces_f,
        release_ns,
        close_ns,
        exec_ns,
        delay_ns,
        extra_ns,
        stamps,
        clock,
        fixed_columns(cells, N_CELL),
        fixed_columns(sites, N_SITE),
        fixed_columns(servers, N_SERVER),
        fixed_columns(servers_f, N_SERVER_F),
        fixed_columns(links, N_LINK),
        run_v,
        run_key,
        wait_rank,
        wait_ready,
        wait_key,
        wait_left,
        dirty,
        ready,
        event_t,
        event_key,
        fixed_columns(jobs, N_JOB),
        fixed_columns(slots, N_SLOT),
        attempts,
        own,
        latency_ns,
        compute_ns,
        network_ns,
        outcome,
        opened,
        closed,
        log,
        log_outcome,
        log_arrived,
    )
    announced = False
    while announced or _announce(s) > 0:
        announced = True
        if s.clock[N_EVENTS] == 0:
            break
        status = _room(s)
        if status != PAUSED:
            return status
        now = s.event_t[0]
        key = s.event_key[0]
        pop_event(s.clock, s.event_t, s.event_key)
        kind = key >> KIND_SHIFT
        cell = (key >> CELL_SHIFT) & CELL_MASK
        cycle = (key >> CYCLE_SHIFT) & CYCLE_MASK
        if kind == CLOSE:
            # A window that the guard has cut short does not close.
            if cycle != s.cells[cell, CLOSE_CYCLE]:
                continue
            _close(s, cell, now)
            if s.clock[PAUSE] != 0:
                return PAUSED
            announced = False
            continue
        if now > s.clock[END]:
            break
        if kind == MIGRATE or (kind == GUARD and _silent(s, cell, now)):
            s.clock[STEP_KEY] = key
            s.clock[STEP_NS] = now
            return STEP
        _handle(s, kind, cell, cycle, key & ITEM_MASK, key, now)
        _settle(s, now)
        flush(s, now)
    return FINISHED
