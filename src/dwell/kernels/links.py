"""Links: serialisation at the rate in order of sending, then a delay that may overtake."""

from __future__ import annotations

import math

import numpy as np

from dwell.kernels.compiled import index, kernel, phase
from dwell.kernels.far_instants import later, whole_ns
from dwell.kernels.heaps import push_event
from dwell.kernels.layout import (
    ARRIVAL,
    CELL_SHIFT,
    CYCLE_SHIFT,
    DROPPED,
    FREE,
    IN_FLIGHT,
    IN_ORDER,
    KIND_SHIFT,
    LAST_ARRIVAL,
    LINK,
    LIVE,
    LOST,
    LOST_ON_LINK,
    PAYLOAD,
    RETRANSMIT_NS,
    RETRY,
    SEGMENT,
    SEGMENT_AT,
    SEGMENT_DOWN,
    SEGMENT_END,
    SEGMENT_LAYERS,
    SEGMENT_LOSS,
    SEGMENT_RATE,
    STATE_TIMEOUT_NS,
    UNKNOWN,
    Tables,
)
from dwell.kernels.streams import attempt_uniform


@phase
def slot_row(ring: int, cell: int, cycle: int) -> int:
    """Row of a cycle in the ring of the cycles in flight."""
    return index(cell * ring + (cycle & (ring - 1)))


@phase
def lose(s: Tables, cell: int, cycle: int, outcome: int) -> None:
    """Mark a cycle as one that can never be done; its first loss names the outcome."""
    slot = slot_row(s.ring, cell, cycle)
    if s.slots[slot, LOST] == 0:
        s.slots[slot, LOST] = 1
        s.outcome[cell, cycle] = outcome


@phase
def _begin(s: Tables, link: int, now: int) -> int:
    """When the link can take a message; its current segment becomes the one of that instant.

    A link that drops takes it at once even while it is down, to lose it; one that retransmits
    holds it back to the end of the outage, if there is one.
    """
    start = max(now, s.links[link, FREE])
    last = s.links[link, SEGMENT_END] - 1
    segment = s.links[link, SEGMENT]
    while segment < last and s.segments[index(segment + 1), SEGMENT_AT] <= start:
        segment += 1
    if s.links[link, RETRANSMIT_NS] >= 0:
        while segment < last and s.segments[index(segment), SEGMENT_DOWN] != 0:
            segment += 1
            start = s.segments[index(segment), SEGMENT_AT]
    s.links[link, SEGMENT] = segment
    return int(start)


@phase
def _lose_message(
    s: Tables, cell: int, cycle: int, flow: int, outcome: int, at: int, now: int
) -> None:
    """Lose a message when its transmission begins, or would begin."""
    if at > now:
        key = (ARRIVAL << KIND_SHIFT) | (cell << CELL_SHIFT) | (cycle << CYCLE_SHIFT)
        push_event(s.clock, s.event_t, s.event_key, at, key | flow | LOST_ON_LINK)
        return
    s.slots[slot_row(s.ring, cell, cycle), LIVE] -= 1
    lose(s, cell, cycle, outcome)


@phase
def send(s: Tables, cell: int, cycle: int, flow: int, hop: int, attempt: int, now: int) -> None:
    """Send one message of a flow for the first time (attempt 0) or once more."""
    link = index(s.hops[index(hop), LINK])
    start = _begin(s, link, now)
    segment = index(s.links[link, SEGMENT])
    transmission = 0
    lost = s.segments[segment, SEGMENT_DOWN] != 0
    if not lost:
        transmission = _transmission(s, hop, segment)
        s.links[link, FREE] = later(start, transmission)
        lost = _is_lost(s, hop, segment, cycle, attempt)
    sent = later(start, transmission)
    name = (cell << CELL_SHIFT) | (cycle << CYCLE_SHIFT) | flow
    if lost:
        timeout = s.links[link, RETRANSMIT_NS]
        if timeout < 0:
            _lose_message(s, cell, cycle, flow, DROPPED, start, now)
        elif s.segments[segment, SEGMENT_DOWN] != 0:
            # A link that holds messages back and is down for good: it waits for ever.
            _lose_message(s, cell, cycle, flow, IN_FLIGHT, now, now)
        else:
            s.attempts[slot_row(s.ring, cell, cycle), flow] = attempt
            key = (RETRY << KIND_SHIFT) | name
            push_event(s.clock, s.event_t, s.event_key, later(sent, timeout), key)
        return
    arrival = _arrival(s, hop, segment, cycle, sent)
    push_event(s.clock, s.event_t, s.event_key, arrival, (ARRIVAL << KIND_SHIFT) | name)


@kernel
def send_state(s: Tables, hop: int, cycle: int, attempt: int, now: int) -> tuple[int, bool, int]:
    """Send the state of a task that moves; it is carried reliably, whatever the link does.

    Returns
    -------
    t : int
        Instant of its arrival, or of the next attempt; -1 where the link is down for good.
    arrived : bool
        Which of the two.
    attempt : int
        Number of the next attempt; waiting for the end of an outage is none.
    """
    link = index(s.hops[index(hop), LINK])
    start = _begin(s, link, now)
    segment = index(s.links[link, SEGMENT])
    if s.segments[segment, SEGMENT_DOWN] != 0:
        for following in range(s.links[link, SEGMENT] + 1, s.links[link, SEGMENT_END]):
            if s.segments[index(following), SEGMENT_DOWN] == 0:
                return s.segments[index(following), SEGMENT_AT], False, attempt
        return UNKNOWN, False, attempt
    sent = later(start, _transmission(s, hop, segment))
    s.links[link, FREE] = sent
    if _is_lost(s, hop, segment, cycle, attempt):
        timeout = s.links[link, RETRANSMIT_NS]
        again = later(sent, timeout if timeout >= 0 else STATE_TIMEOUT_NS)
        return again, False, attempt + 1
    return _arrival(s, hop, segment, cycle, sent), True, attempt


@phase
def _transmission(s: Tables, hop: int, segment: int) -> int:
    """Time that a message takes at the rate of a link."""
    rate = s.segments_f[segment, SEGMENT_RATE]
    if rate < math.inf:
        return whole_ns(np.rint(s.hops[index(hop), PAYLOAD] * 8000.0 / rate))
    return 0


@phase
def _is_lost(s: Tables, hop: int, segment: int, cycle: int, attempt: int) -> bool:
    """Whether an attempt to send a message is lost."""
    loss = s.segments_f[segment, SEGMENT_LOSS]
    return bool(loss > 0.0 and attempt_uniform(s.loss_keys[index(hop)], cycle, attempt) < loss)


@phase
def _arrival(s: Tables, hop: int, segment: int, cycle: int, sent: int) -> int:
    """Instant at which a message arrives whose transmission has ended."""
    link = index(s.hops[index(hop), LINK])
    arrival = later(sent, _propagation(s, hop, segment, cycle))
    if s.links[link, IN_ORDER] != 0:
        arrival = max(arrival, s.links[link, LAST_ARRIVAL])
        s.links[link, LAST_ARRIVAL] = arrival
    return int(arrival)


@phase
def _propagation(s: Tables, hop: int, segment: int, cycle: int) -> int:
    """Delay of a message, extra delays of what is active included."""
    delay = s.delay_ns[index(hop), cycle]
    layers = s.segments[segment, SEGMENT_LAYERS]
    layer = 0
    while layers != 0:
        if layers & 1:
            delay = later(delay, s.extra_ns[s.layer_rows[index(hop), layer], cycle])
        layers >>= 1
        layer += 1
    return int(delay)
