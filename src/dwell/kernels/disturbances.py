"""What nodes and links go through: the disturbances of each, which come and go, merged in time."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import c_double, c_int64, c_void_p
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.library import library
from dwell.kernels.on_off_intervals import OnOffIntervals
from dwell.model.scenario import RAMP_STEPS

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

#: How strong a disturbance may be: not at all, or as strong as after each step of a ramp.
LEVELS: Final = RAMP_STEPS + 1


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
    rows = [
        _NodeEffect(_pointers(i), node, down, _ints(threads)) for i, node, threads, down in effects
    ]
    heap = (ctypes.POINTER(_NodeEffect) * len(rows))(*map(ctypes.pointer, rows))
    changes = np.empty((_most_changes(effects), 4), np.int64)
    states = np.zeros((nodes, 2), np.int64)
    made = _functions().dwell_node_changes(heap, len(rows), last_ns, states, changes)
    return changes[:made]


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
    rows = (_LinkFault * len(faults))(
        *(
            _LinkFault(_pointers(i), down, _ints(layers), _floats(arriving), _floats(rates))
            for i, layers, arriving, rates, down in faults
        )
    )
    most = 1 + _most_changes(faults)
    segments, qualities = np.zeros((most, 4), np.int64), np.empty((most, 2))
    segments[0, 1] = link
    qualities[0] = rate_mbps, loss
    made = _functions().dwell_link_segments(rows, len(rows), segments, qualities)
    return segments[:made], qualities[:made]


def _most_changes(disturbances: Sequence[NodeEffect] | Sequence[LinkFault]) -> int:
    return sum(2 * len(one.intervals.begin) for one in disturbances)


class _OnOffIntervals(ctypes.Structure):
    """``on_off_intervals.h`` has the same struct."""

    _fields_ = (
        ("begin_ns", c_void_p),
        ("end_ns", c_void_p),
        ("levels", c_void_p),
        ("count", c_int64),
        ("passed", c_int64),
    )


class _NodeEffect(ctypes.Structure):
    """``disturbances.cpp`` has the same struct."""

    _fields_ = (
        ("intervals", _OnOffIntervals),
        ("node", c_int64),
        ("down", c_int64),
        ("threads", c_int64 * LEVELS),
    )


class _LinkFault(ctypes.Structure):
    """``disturbances.cpp`` has the same struct."""

    _fields_ = (
        ("intervals", _OnOffIntervals),
        ("down", c_int64),
        ("layers", c_int64 * LEVELS),
        ("arriving", c_double * LEVELS),
        ("rate_mbps", c_double * LEVELS),
    )


def _pointers(intervals: OnOffIntervals) -> _OnOffIntervals:
    """Point to arrays, which must outlive the struct."""
    begin, end, level = (column.ctypes.data for column in intervals)
    return _OnOffIntervals(begin, end, level, len(intervals.begin), 0)


def _ints(values: Ints | Floats) -> ctypes.Array[c_int64]:
    kind: type[ctypes.Array[c_int64]] = c_int64 * LEVELS
    return kind(*map(int, values))


def _floats(values: Floats) -> ctypes.Array[c_double]:
    kind: type[ctypes.Array[c_double]] = c_double * LEVELS
    return kind(*values)


@cache
def _functions() -> ctypes.CDLL:
    """Return the library; its functions refuse tables of another type, or not in one piece."""
    kernel = library()
    ints = np.ctypeslib.ndpointer(np.int64, ndim=2, flags=("C_CONTIGUOUS", "WRITEABLE"))
    floats = np.ctypeslib.ndpointer(np.float64, ndim=2, flags=("C_CONTIGUOUS", "WRITEABLE"))
    kernel.dwell_node_changes.restype = c_int64
    kernel.dwell_node_changes.argtypes = [c_void_p, c_int64, c_int64, ints, ints]
    kernel.dwell_link_segments.restype = c_int64
    kernel.dwell_link_segments.argtypes = [c_void_p, c_int64, ints, floats]
    return kernel
