"""Codes in the kernel's tables, and packing of event keys; the same as in ``codes.h``."""

from __future__ import annotations

from enum import IntEnum

#: Instant for events that never happen: the largest that is exact as int64 and as float64.
LAST_NS = (1 << 63) - 1024


class CycleOutcome(IntEnum):
    """Outcome of a cycle or a job; NOT_APPLIED is an outcome of live cycles only."""

    IN_FLIGHT, DONE, DROPPED, REPLACED, NODE_DOWN, NOT_APPLIED, IDLE = range(7)


class Scheduler(IntEnum):
    """How a server schedules its cores; TURNS is fair, with a quota that is checked at ticks."""

    FAIR, FIFO, PRIORITY, TURNS = range(4)


class ShadowPart(IntEnum):
    """Role of a task in the shadow of a cycle."""

    SHARED, SHADOWED, DISCARDED = range(3)


class Status(IntEnum):
    """Result of a call of the event loop.

    PAUSED: a decision is due; stamp the next cycles and call again. FINISHED: all windows have
    closed. GROW_EVENTS, GROW_RING: enlarge the queue, or the ring of cycles in flight, and call
    again; all events are intact. STEP: an event for the caller is due. BUSY: the budget of events
    is used up; call again.
    """

    PAUSED, FINISHED, GROW_EVENTS, GROW_RING, STEP, BUSY = range(6)


class BuiltInPolicy(IntEnum):
    """Policies that the kernel implements, too."""

    STATIC, DTP, CUSUM, LATENCY_FIRST, ATP = range(5)


class Tier(IntEnum):
    """Tiers of nodes in J; a node without a tier affects caps only."""

    ROBOT, EDGE, CLOUD, NONE = range(4)


class EventKind(IntEnum):
    """Kinds of events, in the order of events at equal times."""

    COMPLETION, ARRIVAL, START, RETRY, CHANGE, RESTART = range(6)
    MIGRATE, CLOSE, DECIDE, GUARD, RELEASE = range(6, 11)


# A key packs (kind, cell, cycle, item) and sorts like this tuple. The item depends on the kind: a
# task or a flow of the cell, a site, or nothing.
ITEM_BITS, CYCLE_BITS, CELL_BITS = 14, 32, 13
CYCLE_SHIFT = ITEM_BITS
CELL_SHIFT = CYCLE_SHIFT + CYCLE_BITS
KIND_SHIFT = CELL_SHIFT + CELL_BITS
ITEM_MASK, CYCLE_MASK, CELL_MASK = (1 << ITEM_BITS) - 1, (1 << CYCLE_BITS) - 1, (1 << CELL_BITS) - 1
#: Largest number of flows of a cell; the next bit marks messages that are lost on their link.
MOST_FLOWS = (1 << (ITEM_BITS - 1)) - 1


def make_key(kind: EventKind, cell: int = 0, cycle: int = 0, item: int = 0) -> int:
    """Pack the key of an event."""
    return (kind << KIND_SHIFT) | (cell << CELL_SHIFT) | (cycle << CYCLE_SHIFT) | item


def kind_of(key: int) -> EventKind:
    """Return the kind of an event from its key."""
    return EventKind(key >> KIND_SHIFT)


def cell_of(key: int) -> int:
    """Return the row of an event's cell from its key."""
    return (key >> CELL_SHIFT) & CELL_MASK


def cycle_of(key: int) -> int:
    """Return the cycle of an event, or the caller's own number, from its key."""
    return (key >> CYCLE_SHIFT) & CYCLE_MASK


def item_of(key: int) -> int:
    """Return the task, flow or site of an event from its key."""
    return key & ITEM_MASK
