"""What nodes and links go through: the disturbances of each, which come and go, merged in time."""

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
    """What one disturbance does to a node.

    Parameters
    ----------
    intervals : OnOffIntervals
        When it is on, and at which level.
    node : int
        Number of the node.
    threads : float64 array, shape (LEVELS,)
        Foreign threads at each level, whole numbers.
    down : bool
        Whether the node is down.
    """

    intervals: OnOffIntervals
    node: int
    threads: Floats
    down: bool


class LinkFault(NamedTuple):
    """What one disturbance does to a link.

    Parameters
    ----------
    intervals : OnOffIntervals
        When it is on, and at which level.
    layers : int64 array, shape (LEVELS,)
        Layers of extra delay at each level, as bits.
    arriving : float64 array, shape (LEVELS,)
        Share of the attempts that it does not lose.
    rate_mbps : float64 array, shape (LEVELS,)
        Rate that the link has at most; infinite where it is the link's own.
    down : bool
        Whether the link is down.
    """

    intervals: OnOffIntervals
    layers: Ints
    arriving: Floats
    rate_mbps: Floats
    down: bool


def node_changes(effects: Sequence[NodeEffect], nodes: int, last_ns: int) -> Ints:
    """Sum up what nodes go through, from quiet and up on, to an instant.

    Parameters
    ----------
    effects : sequence of NodeEffect
    nodes : int
        Number of nodes.
    last_ns : int
        No change comes later.

    Returns
    -------
    int64 array, shape (changes, 4)
        Table of `dwell.kernels.realisation.NodeChanges`.
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
    """Sum up what a link goes through: the faults of it, which come and go, and its own state.

    Parameters
    ----------
    faults : sequence of LinkFault
    link : int
        Number of the link.
    rate_mbps, loss : float
        Its own.

    Returns
    -------
    int64 array, shape (segments, 4); float64 array, shape (segments, 2)
        Tables of `dwell.kernels.realisation.LinkSegments`.
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
    """Point to arrays, which must outlive the struct."""
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
