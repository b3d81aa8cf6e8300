"""Links: serialisation at the rate in order of sending, then a delay that may overtake."""

from __future__ import annotations

import math

import numpy as np

from dwell.kernels.compiled import index, phase
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
    Tables,
)
from dwell.kernels.streams import attempt_uniform

__all__ = ["lose", "send", "slot_row"]


@phase
def slot_row(s: Tables, cell: int, cycle: int) -> int:
    """Row of a cycle in the ring of the cycles in flight."""
    ring = s.ring
    return index(cell * ring + (cycle & (ring - 1)))


@phase
def lose(s: Tables, cell: int, cycle: int, outcome: int) -> None:
    """Mark a cycle as one that can never be done; its first loss names the outcome."""
    slot = slot_row(s, cell, cycle)
    if s.slots[slot, LOST] == 0:
        s.slots[slot, LOST] = 1
        s.outcome[cell, cycle] = outcome


@phase
def _begin(s: Tables, link: int, now: int) -> int:
    """First instant at which the link can take a message; moves on to the segment of that instant.

    Returns -1 where the link is down and drops, -2 where it is down for good and would hold.
    """
    start = max(now, s.links[link, FREE])
    while True:
        segment = s.links[link, SEGMENT]
        last = s.links[link, SEGMENT_END] - 1
        while segment < last and s.segments[index(segment + 1), SEGMENT_AT] <= start:
            segment += 1
        s.links[link, SEGMENT] = segment
        if s.segments[index(segment), SEGMENT_DOWN] == 0:
            return start
        if s.links[link, RETRANSMIT_NS] < 0:
            return -1
        if segment == last:
            return -2
        start = s.segments[index(segment + 1), SEGMENT_AT]


@phase
def send(s: Tables, cell: int, cycle: int, flow: int, hop: int, attempt: int, now: int) -> None:
    """Send one message of a flow for the first time (attempt 0) or once more."""
    link = index(s.hops[index(hop), LINK])
    start = _begin(s, link, now)
    if start < 0:
        s.slots[slot_row(s, cell, cycle), LIVE] -= 1
        lose(s, cell, cycle, DROPPED if start == -1 else IN_FLIGHT)
        return
    segment = index(s.links[link, SEGMENT])
    rate = s.segments_f[segment, SEGMENT_RATE]
    transmission = 0
    if rate < math.inf:
        transmission = int(np.rint(s.hops[index(hop), PAYLOAD] * 8000.0 / rate))
    sent = start + transmission
    s.links[link, FREE] = sent
    loss = s.segments_f[segment, SEGMENT_LOSS]
    name = (cell << CELL_SHIFT) | (cycle << CYCLE_SHIFT) | flow
    slot = slot_row(s, cell, cycle)
    if loss > 0.0 and attempt_uniform(s.loss_keys[index(hop)], cycle, attempt) < loss:
        timeout = s.links[link, RETRANSMIT_NS]
        if timeout < 0:
            s.slots[slot, LIVE] -= 1
            lose(s, cell, cycle, DROPPED)
            return
        s.attempts[slot, flow] = attempt
        push_event(s.clock, s.event_t, s.event_key, sent + timeout, (RETRY << KIND_SHIFT) | name)
        return
    delay = s.delay_ns[index(hop), cycle]
    layers = s.segments[segment, SEGMENT_LAYERS]
    layer = 0
    while layers != 0:
        if layers & 1:
            delay += s.extra_ns[s.layer_rows[hop, layer], cycle]
        layers >>= 1
        layer += 1
    arrival = sent + delay
    if s.links[link, IN_ORDER] != 0:
        arrival = max(arrival, s.links[link, LAST_ARRIVAL])
        s.links[link, LAST_ARRIVAL] = arrival
    push_event(s.clock, s.event_t, s.event_key, arrival, (ARRIVAL << KIND_SHIFT) | name)
