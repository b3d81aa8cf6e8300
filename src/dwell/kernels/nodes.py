"""Servers: who runs at what speed, and when the next job completes.

All running jobs of a server advance at one common speed, so a virtual clock that advances at that
speed turns processor sharing into a heap: a job that starts at virtual time v with c nanoseconds of
work ends at virtual time v + c, whoever comes or goes meanwhile. A job that holds fewer cores than
it has threads has so much more work. The virtual clock is set back to 0 whenever the server runs
empty, which keeps its rounding error below a picosecond in practice.

Where a quota is noticed at ticks, threads take turns instead. All but the one that has the turn are
in the heap of those that wait, foreign threads too, by the core time that each has received.
"""

from __future__ import annotations

import numpy as np

from dwell.kernels.compiled import index, phase
from dwell.kernels.far_instants import LAST_NS, later, whole_ns
from dwell.kernels.heaps import (
    pop_running,
    pop_waiting,
    push_event,
    push_running,
    push_waiting,
)
from dwell.kernels.layout import (
    AFTER_NS,
    BACKGROUND,
    BASE,
    BEFORE_NS,
    BEHIND_NS,
    BESIDE,
    BUSY_NS,
    CELL_MASK,
    CELL_SHIFT,
    CHANGE,
    CORES,
    CYCLE_MASK,
    CYCLE_SHIFT,
    DIRTY,
    DOWN,
    DRAWN_NS,
    FAIR,
    FIFO,
    FIRST,
    FOREIGN,
    ITEM_MASK,
    KIND_SHIFT,
    LAST,
    LEAST_NS,
    LEFT_NS,
    N_DIRTY,
    N_READY,
    N_RUN,
    N_WAIT,
    NEED,
    NEXT_KEY,
    NEXT_T,
    OTHER,
    PACE,
    PACED,
    PACED_DRAWN_NS,
    PACED_LEAST_NS,
    PACED_QUOTA_NS,
    PACED_SLACK_NS,
    PACED_STRESSED_NS,
    PERIOD,
    PERIOD_AGO,
    PERIOD_NS,
    POOL_NS,
    PRIORITY,
    QUOTA_NS,
    QUOTA_T,
    RANK,
    READY,
    REST,
    SCHEDULER,
    SERVER,
    SITE,
    SLACK_NS,
    SPARE,
    SPEED,
    STARTED,
    STRESS,
    STRESSED_NS,
    THREADS,
    THROTTLED,
    TICK_AGO,
    TICK_NS,
    TURN,
    TURN_NS,
    TURN_V,
    TURNS,
    UNKNOWN,
    USED,
    VIRTUAL,
    WAKE_GAP_NS,
    WAKE_KEY,
    WAKE_T,
    WAKES,
    Tables,
)
from dwell.kernels.streams import attempt_uniform

# Work left below this many nanoseconds is rounding, not work.
SLACK = 1e-3
# Of those that have received the same, jobs go first.
LATE = LAST_NS


@phase
def job_row(ring: int, stride: int, cell: int, cycle: int, local: int) -> int:
    """Row of a job in the ring of the cycles in flight."""
    return index((cell * ring + (cycle & (ring - 1))) * stride + local)


@phase
def key_row(ring: int, stride: int, key: int) -> int:
    """Row of the job that a key names."""
    cell = (key >> CELL_SHIFT) & CELL_MASK
    cycle = (key >> CYCLE_SHIFT) & CYCLE_MASK
    return job_row(ring, stride, cell, cycle, key & ITEM_MASK)


@phase
def time_alone(s: Tables, site: int, work: int) -> float:
    """How long a job of some execution time takes with the cores that it holds, undisturbed."""
    need, threads = s.sites[site, NEED], s.sites[site, THREADS]
    return float(work) if need == threads else float(work) * threads / need


@phase
def mark(s: Tables, server: int) -> None:
    """Remember that a server must give out cores at the end of the event."""
    if s.servers[server, DIRTY] == 0:
        s.servers[server, DIRTY] = 1
        s.dirty[s.clock[N_DIRTY]] = server
        s.clock[N_DIRTY] += 1


@phase
def _account(s: Tables, server: int, now: int) -> int:
    """Bring a server's busy time up to now; returns the time since it last was."""
    elapsed = now - s.servers[server, LAST]
    busy = s.servers[server, USED] + s.servers[server, STRESS]
    background = s.servers_f[server, BACKGROUND]
    if background > 0.0 and elapsed > 0 and s.servers[server, DOWN] == 0:
        if s.servers[server, QUOTA_NS] == 0:
            background = min(background, max(s.servers[server, CORES] - busy, 0))
        s.servers_f[server, BEHIND_NS] += elapsed * background
    if elapsed > 0 and busy > 0 and s.servers[server, DOWN] == 0:
        taken = min(busy, s.servers[server, CORES])
        if s.servers[server, THROTTLED] == 0:
            s.servers_f[server, BUSY_NS] += float(elapsed) * taken
            if s.servers[server, QUOTA_NS] > 0:
                s.servers[server, LEFT_NS] -= elapsed * taken
                s.servers[server, TURN_NS] += elapsed * taken
    s.servers[server, LAST] = now
    return int(elapsed)


@phase
def renew_before_stress(s: Tables, server: int, now: int) -> None:
    """Begin the periods that have begun before a server's foreign threads change.

    Without a pool, what happens at the instant at which a period begins comes before it.
    """
    if s.servers[server, QUOTA_NS] > 0:
        if s.servers[server, SLACK_NS] > 0 or s.servers[server, SCHEDULER] == TURNS:
            _renew(s, server, now)
            return
        _renew(s, server, now - 1)
        # One that a job of this instant has begun already begins anew, with nothing used of it.
        period = now // s.servers[server, PERIOD_NS]
        if period > 0 and period * s.servers[server, PERIOD_NS] == now:
            s.servers[server, PERIOD] = period - 1


@phase
def _renew(s: Tables, server: int, now: int) -> None:
    """Fill a server's bucket, or the pool of its quota, if a period has begun."""
    period = (now + s.servers[server, PERIOD_AGO]) // s.servers[server, PERIOD_NS]
    if period > s.servers[server, PERIOD]:
        s.servers[server, PERIOD] = period
        pooled = s.servers[server, SLACK_NS] > 0 or s.servers[server, SCHEDULER] == TURNS
        filled = POOL_NS if pooled else LEFT_NS
        stressed = s.servers[server, STRESS] > 0
        s.servers[server, filled] = s.servers[server, STRESSED_NS if stressed else QUOTA_NS]


@phase
def refill(s: Tables, server: int, now: int) -> None:
    """Open or shut a server by its quota; its clock must be up to date.

    While anything runs there is an event at every boundary of a period and wherever the quota is
    used up, so nothing that was spent belongs to two periods. With a slack the quota fills a pool,
    and what runs draws all of it whenever it has used up what it had.
    """
    _renew(s, server, now)
    s.servers[server, THROTTLED] = 1 if s.servers[server, LEFT_NS] <= 0 else 0
    set_speed(s, server)


@phase
def draw_quota(s: Tables, server: int, now: int) -> None:
    """Draw on the pool where what was drawn before is used up; its clock must be up to date.

    Only after all changes of this instant: what ends now draws nothing.
    """
    if s.servers[server, SCHEDULER] == TURNS:
        _strike(s, server, now)
        return
    refill(s, server, now)
    busy = s.servers[server, USED] + s.servers[server, STRESS]
    if s.servers[server, LEFT_NS] <= 0 and busy > 0 and s.servers[server, DOWN] == 0:
        s.servers[server, LEFT_NS] += s.servers[server, POOL_NS]
        s.servers[server, POOL_NS] = 0
        refill(s, server, now)


@phase
def _strike(s: Tables, server: int, now: int) -> None:
    """Pass the turn on; the clock must be up to date.

    At a tick, if it has lasted long enough; at a wake, if another has received less.
    """
    if (now + s.servers[server, TICK_AGO]) % s.servers[server, TICK_NS] == 0:
        _pass_on(s, server)
    running = s.servers[server, TURN] != 0 and s.servers[server, THROTTLED] == 0
    if s.servers[server, WAKE_T] == now and running and s.servers[server, N_WAIT] > 0:
        if s.wait_rank[index(s.servers[server, BASE])] < _by_turn(s, server):
            _put_back(s, server)


@phase
def _pass_on(s: Tables, server: int) -> None:
    """Pass the turn on, if it has lasted long enough; the clock must be up to date."""
    short = s.servers[server, TURN_NS] < s.servers[server, LEAST_NS]
    if not short and s.servers[server, THROTTLED] == 0:
        _put_back(s, server)


@phase
def _put_back(s: Tables, server: int) -> None:
    """Have the thread that has the turn wait for another; the clock must be up to date."""
    received = _by_turn(s, server)
    if s.servers[server, N_RUN] == 0:
        _queue_up(s, server, received, LATE, FOREIGN, 0.0)
    else:
        base = index(s.servers[server, BASE])
        key = s.run_key[base]
        left = max(s.run_v[base] - s.servers_f[server, VIRTUAL], 0.0)
        row = key_row(s.ring, s.stride, key)
        _queue_up(s, server, received, s.jobs[row, READY], key, left)
        s.servers[server, N_RUN] = 0
    _end_turn(s, server)


@phase
def _notice(s: Tables, server: int, now: int) -> None:
    """Let the kernel look whether a quota is used up; the server's clock must be up to date.

    What was overrun is a debt: a server that is stopped goes on when refills have paid it
    (distribute_cfs_runtime); one that runs draws a slice (assign_cfs_rq_runtime), or stops.
    """
    _renew(s, server, now)
    left = s.servers[server, LEFT_NS]
    if left <= 0:
        wanted = 1 if s.servers[server, THROTTLED] != 0 else s.servers[server, DRAWN_NS]
        drawn = min(s.servers[server, POOL_NS], wanted - left)
        s.servers[server, POOL_NS] -= drawn
        s.servers[server, LEFT_NS] = left + drawn
    stopped = 1 if s.servers[server, LEFT_NS] <= 0 else 0
    if stopped > s.servers[server, THROTTLED] and s.servers[server, TURN] != 0:
        _put_back(s, server)
    s.servers[server, THROTTLED] = stopped
    set_speed(s, server)


@phase
def _next_look(s: Tables, server: int, now: int) -> int:
    """When the quota of a busy server is looked at next.

    At the begin of a period if it is stopped, else at a tick or where the background wakes.
    """
    if s.servers[server, THROTTLED] != 0:
        begin = (s.servers[server, PERIOD] + 1) * s.servers[server, PERIOD_NS]
        return int(begin - s.servers[server, PERIOD_AGO])
    if s.servers[server, QUOTA_T] == now:
        return now  # the look of this instant has yet to come
    tick_ns = s.servers[server, TICK_NS]
    tick_t = now + tick_ns - (now + s.servers[server, TICK_AGO]) % tick_ns
    return int(min(tick_t, _next_wake(s, server, now)))


@phase
def _next_wake(s: Tables, server: int, now: int) -> int:
    """When something of the background wakes next, after now: a Poisson process."""
    gap_ns = s.servers_f[server, WAKE_GAP_NS]
    key = np.uint64(s.servers[server, WAKE_KEY])
    while s.servers[server, WAKE_T] <= now:
        drawn = attempt_uniform(key, s.servers[server, WAKES], 0)
        s.servers[server, WAKES] += 1
        gap = whole_ns(-np.log(1.0 - drawn) * gap_ns)
        s.servers[server, WAKE_T] = later(s.servers[server, WAKE_T] + 1, gap)
    return int(s.servers[server, WAKE_T])


@phase
def _announce_quota(s: Tables, server: int, now: int) -> None:
    """Announce when a server's quota is used up or renewed; an older announcement goes stale."""
    turns = s.servers[server, SCHEDULER] == TURNS
    if turns:
        _notice(s, server, now)
    else:
        refill(s, server, now)
    busy = s.servers[server, USED] + s.servers[server, STRESS]
    if busy == 0 or s.servers[server, DOWN] != 0:
        s.servers[server, QUOTA_T] = -1
        # Beyond the slack, what was drawn goes back.
        slack, quota = s.servers[server, SLACK_NS], s.servers[server, QUOTA_NS]
        if (slack > 0 or turns) and s.servers[server, LEFT_NS] > slack:
            pool = s.servers[server, POOL_NS] + s.servers[server, LEFT_NS] - slack
            s.servers[server, POOL_NS] = min(pool, quota)
            s.servers[server, LEFT_NS] = slack
        return
    t = (s.servers[server, PERIOD] + 1) * s.servers[server, PERIOD_NS]
    if turns:
        t = _next_look(s, server, now)
    elif s.servers[server, THROTTLED] == 0:
        rate = min(busy, s.servers[server, CORES])
        t = min(t, now + (s.servers[server, LEFT_NS] + rate - 1) // rate)
    elif s.servers[server, POOL_NS] > 0:
        t = now
    if t != s.servers[server, QUOTA_T]:
        s.servers[server, QUOTA_T] = t
        # The item of a change of a node is 0; that of a server's quota is its row, from 1.
        key = (CHANGE << KIND_SHIFT) | (server + 1)
        push_event(s.clock, s.event_t, s.event_key, t, key)


@phase
def tick(s: Tables, server: int, now: int) -> None:
    """Bring a server's virtual clock and busy time up to now."""
    elapsed = _account(s, server, now)
    if s.servers[server, N_RUN] > 0:
        s.servers_f[server, VIRTUAL] += elapsed * s.servers_f[server, SPEED]


@phase
def set_speed(s: Tables, server: int) -> None:
    """Set the common speed after threads, stress or quota changed; the clock must be up to date.

    With c' = c - b cores left by the background, fair: min(1, c' / (K + s)); fifo and priority:
    c' / (c + s); in turns: the core among the threads of the job whose turn it is; any: less by
    what others contend for and foreign threads interfere, and 0 while the quota is used up.
    """
    spare = s.servers_f[server, SPARE]
    stress = s.servers[server, STRESS]
    if s.servers[server, SCHEDULER] == FAIR:
        load = s.servers[server, USED] + stress
        s.servers_f[server, SPEED] = 1.0 if load <= spare else spare / load
    elif s.servers[server, SCHEDULER] == TURNS:
        need = 1
        if s.servers[server, N_RUN] > 0:
            row = key_row(s.ring, s.stride, s.run_key[index(s.servers[server, BASE])])
            need = s.sites[index(s.jobs[row, SITE]), NEED]
        s.servers_f[server, SPEED] = 1.0 / need
    else:
        s.servers_f[server, SPEED] = spare / (s.servers[server, CORES] + stress)
    s.servers_f[server, SPEED] *= s.servers_f[server, PACE]
    if stress > 0:
        s.servers_f[server, SPEED] *= s.servers_f[server, BESIDE]
    if s.servers[server, THROTTLED] != 0:
        s.servers_f[server, SPEED] = 0.0


@phase
def repace(s: Tables, server: int, now: int) -> None:
    """Set what others leave of a server's core by which of them have foreign threads.

    What it counts is in time of the core: what is left of it is converted, to the nanosecond.
    """
    row, pace, stressed = FIRST, 0.0, False
    for number in range(s.paces.shape[0]):
        i = index(number)
        if s.paces[i, PACED] != server:
            continue
        other = s.paces[i, OTHER]
        if other < 0:  # comes first
            row, pace = FIRST + number, s.paces_f[i]
        elif s.servers[index(other), STRESS] > 0 and s.servers[index(other), DOWN] == 0:
            if not stressed or s.paces_f[i] < pace:
                row, pace, stressed = FIRST + number, s.paces_f[i], True
    if pace == s.servers_f[server, PACE]:
        return
    tick(s, server, now)
    renew_before_stress(s, server, now)
    s.servers_f[server, BEHIND_NS] += s.servers_f[server, BUSY_NS] * s.servers_f[server, PACE]
    s.servers_f[server, BUSY_NS] = 0.0
    ratio = s.servers_f[server, PACE] / pace
    s.servers[server, LEFT_NS] = np.int64(np.rint(s.servers[server, LEFT_NS] * ratio))
    s.servers[server, POOL_NS] = np.int64(np.rint(s.servers[server, POOL_NS] * ratio))
    s.servers[server, QUOTA_NS] = s.paces[index(row), PACED_QUOTA_NS]
    s.servers[server, STRESSED_NS] = s.paces[index(row), PACED_STRESSED_NS]
    s.servers[server, SLACK_NS] = s.paces[index(row), PACED_SLACK_NS]
    s.servers[server, LEAST_NS] = s.paces[index(row), PACED_LEAST_NS]
    s.servers[server, DRAWN_NS] = s.paces[index(row), PACED_DRAWN_NS]
    s.servers_f[server, PACE] = pace
    set_speed(s, server)
    mark(s, server)


@phase
def _start(s: Tables, server: int, site: int, key: int, row: int, left: float, now: int) -> None:
    n = s.servers[server, N_RUN]
    if n == 0:
        s.servers_f[server, VIRTUAL] = 0.0
    if s.jobs[row, STARTED] < 0:
        s.jobs[row, STARTED] = now
    finish = s.servers_f[server, VIRTUAL] + left
    push_running(s.run_v, s.run_key, s.servers[server, BASE], n, finish, key)
    s.servers[server, N_RUN] = n + 1
    s.servers[server, USED] += s.sites[site, NEED]


@phase
def _queue_up(s: Tables, server: int, rank: int, ready: int, key: int, left: float) -> None:
    """Add a job to those that wait for cores, or a thread to those that wait for their turn."""
    base = s.servers[server, BASE]
    n = s.servers[server, N_WAIT]
    w = s.wait_rank, s.wait_ready, s.wait_key, s.wait_left
    push_waiting(w[0], w[1], w[2], w[3], base, n, rank, ready, key, left)
    s.servers[server, N_WAIT] = n + 1


@phase
def _end_turn(s: Tables, server: int) -> None:
    s.servers[server, TURN] = 0
    s.servers[server, TURN_NS] = 0


@phase
def _average(s: Tables, server: int) -> int:
    """Mean core time that the threads of a server have received: where a new one begins."""
    base = s.servers[server, BASE]
    n = s.servers[server, N_WAIT]
    # Counted from one of them: 64 bits may not hold the sum.
    origin = s.wait_rank[index(base)] if n > 0 else 0
    beyond = 0
    for i in range(n):
        beyond += s.wait_rank[index(base + i)] - origin
    if s.servers[server, TURN] != 0:
        beyond += _by_turn(s, server) - origin
        n += 1
    return int(origin + beyond // n) if n > 0 else 0


@phase
def _by_turn(s: Tables, server: int) -> int:
    """Core time that the thread that has the turn has received; the clock must be up to date."""
    return int(s.servers[server, TURN_V] + s.servers[server, TURN_NS])


@phase
def _least(s: Tables, server: int) -> int:
    """Least core time that a thread of a server has received: where one begins that is owed."""
    n = s.servers[server, N_WAIT]
    waiting = s.wait_rank[index(s.servers[server, BASE])] if n > 0 else 0
    if s.servers[server, TURN] == 0:
        return int(waiting)
    received = _by_turn(s, server)
    return int(min(waiting, received) if n > 0 else received)


@phase
def _take_turn(s: Tables, server: int, now: int) -> None:
    """Give the turn, if nobody has it and the quota lets anybody, to who has received least."""
    tick(s, server, now)
    _notice(s, server, now)
    n = s.servers[server, N_WAIT]
    if n == 0 or s.servers[server, TURN] != 0 or s.servers[server, THROTTLED] != 0:
        return
    base = index(s.servers[server, BASE])
    key, left = s.wait_key[base], s.wait_left[base]
    s.servers[server, TURN] = 1
    s.servers[server, TURN_V] = s.wait_rank[base]
    pop_waiting(s.wait_rank, s.wait_ready, s.wait_key, s.wait_left, s.servers[server, BASE], n)
    s.servers[server, N_WAIT] = n - 1
    if key == FOREIGN:
        return
    s.servers_f[server, VIRTUAL] = 0.0
    row = key_row(s.ring, s.stride, key)
    if s.jobs[row, STARTED] < 0:
        s.jobs[row, STARTED] = now
    push_running(s.run_v, s.run_key, s.servers[server, BASE], 0, left, key)
    s.servers[server, N_RUN] = 1
    set_speed(s, server)


@phase
def restress(s: Tables, server: int, threads: int) -> None:
    """Replace the foreign threads that take turns by so many new ones; the clock must be right."""
    received = _average(s, server)
    base, n = s.servers[server, BASE], s.servers[server, N_WAIT]
    s.servers[server, N_WAIT] = 0
    # The heap of the jobs grows no faster than that of all is read.
    for i in range(n):
        row = index(base + i)
        if s.wait_key[row] != FOREIGN:
            rank, ready, key = s.wait_rank[row], s.wait_ready[row], s.wait_key[row]
            _queue_up(s, server, rank, ready, key, s.wait_left[row])
    if s.servers[server, N_RUN] == 0:
        _end_turn(s, server)
    for _ in range(threads):
        _queue_up(s, server, received, LATE, FOREIGN, 0.0)


@phase
def _line_up(s: Tables, server: int, site: int, row: int, key: int, work: int, mean: int) -> None:
    """Let the next thread of a job wait for its turn: one before the stage, its own, one after.

    The stage's, which has worked for long when it sleeps, begins with the mean. One that does
    little whenever it wakes is owed: it goes before all others, and takes the turn of one that has
    had it for long enough.
    """
    rest, after = s.jobs[row, REST], s.sites[site, AFTER_NS]
    if work == 0 and rest > after:
        work, received = rest - after, mean
    else:
        if work == 0:
            work = rest
        received = _least(s, server) - 1
        _pass_on(s, server)
    s.jobs[row, REST] = rest - work
    _queue_up(s, server, received, s.jobs[row, READY], key, float(work))
    s.servers[server, USED] += 1
    mark(s, server)


@phase
def next_thread(s: Tables, server: int, site: int, row: int, key: int, now: int) -> bool:
    """Let the next thread of a job line up, if there is one, where its thread has done its part.

    It is woken by the one that then sleeps, so that the mean that it begins with is over both.
    """
    if s.jobs[row, REST] == 0:
        return False
    tick(s, server, now)
    mean = _average(s, server)
    leave(s, server, site, now)
    _line_up(s, server, site, row, key, 0, mean)
    return True


@phase
def admit(s: Tables, site: int, key: int, row: int, work: int, now: int) -> None:
    """Make a job that a worker has taken runnable."""
    server = index(s.sites[site, SERVER])
    scheduler = s.servers[server, SCHEDULER]
    if scheduler == TURNS:
        tick(s, server, now)
        before = s.sites[site, BEFORE_NS]
        s.jobs[row, REST] = work
        first = before if before < work else 0
        _line_up(s, server, site, row, key, first, _average(s, server))
        return
    s.jobs[row, REST] = 0
    left = time_alone(s, site, work)
    n = s.servers[server, N_WAIT]
    need = s.sites[site, NEED]
    # Where nobody else can want the cores now, the job needs no queue.
    alone = n == 0 and s.clock[N_READY] == 1
    fits = alone and s.servers[server, USED] + need <= s.servers[server, CORES]
    if s.servers[server, QUOTA_NS] > 0:
        tick(s, server, now)
        refill(s, server, now)
    if scheduler == FAIR or fits:
        tick(s, server, now)
        _start(s, server, site, key, row, left, now)
        if scheduler == FAIR:
            set_speed(s, server)
        if s.servers[server, DIRTY] != 0:
            return
        lone = s.servers[server, N_RUN] == 1 and s.servers[server, QUOTA_NS] == 0
        if lone and s.servers_f[server, SPEED] == 1.0 and left == work:
            _announce(s, server, later(now, work), key)
        else:
            schedule(s, server, now)
        return
    mark(s, server)
    rank = 0 if scheduler == FIFO else s.sites[site, RANK]
    _queue_up(s, server, rank, s.jobs[row, READY], key, left)


@phase
def _preempt(s: Tables, server: int) -> bool:
    """Take the cores of the last running job behind the first waiting one, if there is any."""
    base = s.servers[server, BASE]
    worst = UNKNOWN
    rank, ready, key = s.wait_rank[base], s.wait_ready[base], s.wait_key[base]
    for i in range(s.servers[server, N_RUN]):
        other = s.run_key[base + i]
        if s.run_v[index(base + i)] - s.servers_f[server, VIRTUAL] <= SLACK:
            continue  # it has all its work and completes at this very instant
        row = key_row(s.ring, s.stride, other)
        other_rank = s.sites[index(s.jobs[row, SITE]), RANK]
        other_ready = s.jobs[row, READY]
        if other_rank > rank or (
            other_rank == rank and (other_ready > ready or (other_ready == ready and other > key))
        ):
            worst, rank, ready, key = FIRST + i, other_rank, other_ready, other
    if worst < 0:
        return False
    row = key_row(s.ring, s.stride, key)
    left = s.run_v[base + worst] - s.servers_f[server, VIRTUAL]
    pop_running(s.run_v, s.run_key, base, s.servers[server, N_RUN], worst)
    s.servers[server, N_RUN] -= 1
    s.servers[server, USED] -= s.sites[index(s.jobs[row, SITE]), NEED]
    _queue_up(s, server, rank, ready, key, max(left, 0.0))
    return True


@phase
def dispatch(s: Tables, server: int, now: int) -> None:
    """Give out the cores of a server that is not fair."""
    if s.servers[server, SCHEDULER] == TURNS:
        _take_turn(s, server, now)
        return
    if s.servers[server, N_WAIT] == 0:
        return
    tick(s, server, now)
    base = s.servers[server, BASE]
    preemptive = s.servers[server, SCHEDULER] == PRIORITY
    while s.servers[server, N_WAIT] > 0:
        key = s.wait_key[base]
        row = key_row(s.ring, s.stride, key)
        site = index(s.jobs[row, SITE])
        need = s.sites[site, NEED]
        if s.servers[server, USED] + need <= s.servers[server, CORES]:
            left = s.wait_left[base]
            n = s.servers[server, N_WAIT]
            pop_waiting(s.wait_rank, s.wait_ready, s.wait_key, s.wait_left, base, n)
            s.servers[server, N_WAIT] = n - 1
            _start(s, server, site, key, row, left, now)
        elif not preemptive or not _preempt(s, server):
            break


@phase
def leave(s: Tables, server: int, site: int, now: int) -> None:
    """Take the job that finishes first off a server."""
    base = s.servers[server, BASE]
    n = s.servers[server, N_RUN]
    elapsed = _account(s, server, now)
    if n > 1:  # the virtual clock of an empty server starts anew
        s.servers_f[server, VIRTUAL] += elapsed * s.servers_f[server, SPEED]
    pop_running(s.run_v, s.run_key, base, n, FIRST)
    s.servers[server, N_RUN] = n - 1
    if s.servers[server, SCHEDULER] == TURNS:
        s.servers[server, USED] -= 1
        _end_turn(s, server)
    else:
        s.servers[server, USED] -= s.sites[site, NEED]
    s.servers[server, NEXT_KEY] = -1
    if n > 1 or s.servers[server, N_WAIT] > 0 or s.servers[server, QUOTA_NS] > 0:
        mark(s, server)
    if s.servers[server, SCHEDULER] == FAIR:
        set_speed(s, server)


@phase
def schedule(s: Tables, server: int, now: int) -> None:
    """Announce the completion of the job that finishes first; an older announcement goes stale."""
    if s.servers[server, QUOTA_NS] > 0:
        _announce_quota(s, server, now)
    speed = s.servers_f[server, SPEED]
    base = s.servers[server, BASE]
    left = s.run_v[index(base)] - s.servers_f[server, VIRTUAL]
    stopped = speed == 0.0 and left > SLACK
    if s.servers[server, N_RUN] == 0 or s.servers[server, DOWN] != 0 or stopped:
        s.servers[server, NEXT_KEY] = -1
        return
    if speed != 1.0 and speed != 0.0:
        left = left / speed
    t = later(now, max(whole_ns(np.ceil(left - SLACK)), 0))
    _announce(s, server, t, s.run_key[index(base)])


@phase
def _announce(s: Tables, server: int, t: int, key: int) -> None:
    if key != s.servers[server, NEXT_KEY] or t != s.servers[server, NEXT_T]:
        s.servers[server, NEXT_KEY] = key
        s.servers[server, NEXT_T] = t
        push_event(s.clock, s.event_t, s.event_key, t, key)
