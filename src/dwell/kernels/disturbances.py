"""Combined disturbances of nodes and links over time."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import c_int64, c_void_p
from typing import Any, NamedTuple

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.on_off_intervals import OnOffIntervals
from dwell.kernels.rows import FLOAT_ROWS_OUT, INT_ROWS_OUT, PLAIN, structs
from dwell.model.number_arrays import Floats, Ints


class NodeEffect(NamedTuple):
    """Effect of one disturbance on a node.

    Parameters
    ----------
    intervals : OnOffIntervals
        Times and levels of the disturbance.
    node : int
        Number of the node.
    threads : float64 array, shape (LEVELS,)
        Number of foreign threads at each level.
    down : bool
        Whether the node is down.
    """

    intervals: OnOffIntervals
    node: int
    threads: Floats
    down: bool


class LinkFault(NamedTuple):
    """Effect of one disturbance on a link.

    Parameters
    ----------
    intervals : OnOffIntervals
        Times and levels of the disturbance.
    layers : int64 array, shape (LEVELS,)
        Layers of extra delay at each level, as bits.
    arriving : float64 array, shape (LEVELS,)
        Share of the attempts that arrive in spite of the disturbance.
    rate_mbps : float64 array, shape (LEVELS,)
        Upper bound of the link's rate; infinite if the disturbance sets none.
    down : bool
        Whether the link is down.
    """

    intervals: OnOffIntervals
    layers: Ints
    arriving: Floats
    rate_mbps: Floats
    down: bool


def node_changes(effects: Sequence[NodeEffect], nodes: int, last_ns: int) -> Ints:
    """Return the changes of all nodes up to an instant, as the table of `NodeChanges`.

    Nodes begin without foreign threads and up. The result has the shape (changes, 4).
    """
    kind = structs()["NodeEffect"]
    rows = [kind(_pointers(i), node, down, _levels(threads)) for i, node, threads, down in effects]
    heap = (ctypes.POINTER(kind) * len(rows))(*map(ctypes.pointer, rows))
    changes = np.empty((_most_changes(effects), 4), np.int64)
    states = np.zeros((nodes, 2), np.int64)
    return changes[: _node_changes()(heap, len(rows), last_ns, states, changes)]


def link_segments(
    faults: Sequence[LinkFault], link: int, rate_mbps: float, loss: float
) -> tuple[Ints, Floats]:
    """Return the segments of a link, as the two tables of `LinkSegments`.

    The tables have the shapes (segments, 4) and (segments, 2). `rate_mbps` and `loss` describe the
    undisturbed link.
    """
    kind, shares = structs()["LinkFault"], PLAIN["Shares"]
    rows = (kind * len(faults))(
        *(
            kind(_pointers(i), down, _levels(layers), shares(*arriving), shares(*rates))
            for i, layers, arriving, rates, down in faults
        )
    )
    most = 1 + _most_changes(faults)
    segments, qualities = np.zeros((most, 4), np.int64), np.empty((most, 2))
    segments[0, 1] = link
    qualities[0] = rate_mbps, loss
    made = _link_segments()(rows, len(rows), segments, qualities)
    return segments[:made], qualities[:made]


def _most_changes(disturbances: Sequence[NodeEffect] | Sequence[LinkFault]) -> int:
    return sum(2 * len(one.intervals.begin) for one in disturbances)


def _pointers(intervals: OnOffIntervals) -> Any:
    """Return a struct with pointers to arrays, which must outlive it."""
    columns = (column.ctypes.data for column in intervals)
    return structs()["OnOffIntervals"](*columns, len(intervals.begin), 0)


def _levels(values: Ints | Floats) -> Any:
    return PLAIN["Levels"](*map(int, values))


_node_changes = foreign(
    "dwell_node_changes", c_int64, c_void_p, c_int64, c_int64, INT_ROWS_OUT, INT_ROWS_OUT
)
_link_segments = foreign(
    "dwell_link_segments", c_int64, c_void_p, c_int64, INT_ROWS_OUT, FLOAT_ROWS_OUT
)
