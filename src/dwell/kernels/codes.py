"""Codes that the kernel's tables hold, and the packing of event keys: those of ``codes.h``."""

from __future__ import annotations

from enum import IntEnum

#: An instant that never comes: the largest that is exact as int64 and as float64.
LAST_NS = (1 << 63) - 1024


class CycleOutcome(IntEnum):
    """What became of a cycle or a job."""

    IN_FLIGHT, DONE, DROPPED, REPLACED, NODE_DOWN = range(5)


class Scheduler(IntEnum):
    """How a server gives out its cores; TURNS: fair, with a quota that is noticed at ticks."""

    FAIR, FIFO, PRIORITY, TURNS = range(4)


class ShadowPart(IntEnum):
    """What a task is to the shadow of a cycle."""

    SHARED, SHADOWED, DISCARDED = range(3)


class Status(IntEnum):
    """What a call of the event loop ends with.

    PAUSED: a decision is due; stamp the next cycles and go on. FINISHED: no window is left to
    close. GROW_EVENTS, GROW_RING: enlarge the queue, or the ring of cycles in flight, and go on;
    nothing was lost. STEP: the caller's event is due. BUSY: the budget of events is spent; go on.
    """

    PAUSED, FINISHED, GROW_EVENTS, GROW_RING, STEP, BUSY = range(6)


class BuiltInPolicy(IntEnum):
    """Policies that the kernel has a second body of."""

    STATIC, DTP, CUSUM, LATENCY_FIRST, ATP = range(5)


class Tier(IntEnum):
    """Tiers of nodes in J; of a node in none caps alone take notice."""

    ROBOT, EDGE, CLOUD, NONE = range(4)


class EventKind(IntEnum):
    """Kinds of events, in the order in which equal times are handled."""

    (
        COMPLETION,
        ARRIVAL,
        START,
        RETRY,
        CHANGE,
        RESTART,
        MIGRATE,
        CLOSE,
        DECIDE,
        GUARD,
        RELEASE,
    ) = range(11)


# A key packs (kind, cell, cycle, item), so that keys order as the tuple does. The item is a task
# or a flow of the cell, a site, or nothing, according to the kind.
ITEM_BITS, CYCLE_BITS, CELL_BITS = 14, 32, 13
CYCLE_SHIFT = ITEM_BITS
CELL_SHIFT = CYCLE_SHIFT + CYCLE_BITS
KIND_SHIFT = CELL_SHIFT + CELL_BITS
ITEM_MASK, CYCLE_MASK, CELL_MASK = (1 << ITEM_BITS) - 1, (1 << CYCLE_BITS) - 1, (1 << CELL_BITS) - 1
#: Most flows of a cell: the bit above marks what is lost on its link.
MOST_FLOWS = (1 << (ITEM_BITS - 1)) - 1


def make_key(kind: EventKind, cell: int = 0, cycle: int = 0, item: int = 0) -> int:
    """Pack the key of an event."""
    return (kind << KIND_SHIFT) | (cell << CELL_SHIFT) | (cycle << CYCLE_SHIFT) | item


def kind_of(key: int) -> EventKind:
    """EventKind of the event that a key names."""
    return EventKind(key >> KIND_SHIFT)


def cell_of(key: int) -> int:
    """Row of the cell of the event that a key names."""
    return (key >> CELL_SHIFT) & CELL_MASK


def cycle_of(key: int) -> int:
    """Cycle, or what else the caller counts, of the event that a key names."""
    return (key >> CYCLE_SHIFT) & CYCLE_MASK


def item_of(key: int) -> int:
    """Task, flow or site of the event that a key names."""
    return key & ITEM_MASK
