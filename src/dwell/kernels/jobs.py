"""What the jobs of a window say of waits and of foreign threads (see ``jobs.cpp``)."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Array, byref, c_double, c_int64, c_void_p
from typing import Any, NamedTuple

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.meter import WindowRows
from dwell.kernels.rows import structs
from dwell.model.number_arrays import Floats

#: Numbers of scratch for each job of a window, own jobs and shadow jobs.
SCRATCH = 40


class NodeJobs(NamedTuple):
    """Jobs on the CPU of a node.

    Parameters
    ----------
    cores : float64 array, shape (candidates, tasks)
        Cores of the job of each task under each candidate; 0 where it runs elsewhere.
    is_fair : bool
        Whether jobs share the cores as threads of equal weight.
    n_cores, spare : float
        Cores of the node, and cores that its background leaves.
    bursts : float
        Share of the time in which there are bursts.
    """

    cores: Floats
    is_fair: bool
    n_cores: float
    spare: float
    bursts: float = 0.0

    def row(self, flows: int) -> Any:
        """Return the kernel's row; it is valid as long as `cores` exists."""
        head = self.cores.shape[1], flows, self.cores.ctypes.data, self.is_fair
        return structs()["NodeJobs"](*head, self.n_cores, self.spare, 0.0, self.bursts)


class WaitingJobs:
    """Adds waits to the work of jobs (see `dwell.estimators.measured.Meter`).

    Parameters
    ----------
    nodes : sequence of NodeJobs
        Nodes whose jobs share their cores evenly.
    """

    def __init__(self, nodes: Sequence[NodeJobs], flows: int) -> None:
        self._nodes, self._flows = tuple(nodes), flows
        rows = [node.row(flows) for node in nodes]
        self._rows: Array[Any] = (structs()["NodeJobs"] * len(rows))(*rows)
        # Memory of this size takes the system longer to give than the kernel to use.
        self._scratch = np.empty(0)

    def __reduce__(self) -> tuple[type[WaitingJobs], tuple[Sequence[NodeJobs], int]]:
        # A copy has addresses of its own.
        return WaitingJobs, (self._nodes, self._flows)

    def add(self, window: WindowRows, foreign_threads: Sequence[float]) -> None:
        """Add to the work of own jobs in a window what most jobs of their task waited for."""
        for row, threads in zip(self._rows, foreign_threads, strict=True):
            row.foreign = threads
        if len(self._scratch) < len(window.table) * window.tasks * SCRATCH:
            self._scratch = _scratch(window)
        of = self._scratch.ctypes.data
        _add_waits()(self._rows, len(self._rows), byref(window.row), of)


def level(
    node: NodeJobs, window: WindowRows, *, shadows: bool, is_shared: bool = False
) -> tuple[float, float, bool] | None:
    """Tell beside how many foreign threads the jobs of a node ran since the last change.

    Parameters
    ----------
    shadows : bool
        Whether shadow jobs count where there are too few own jobs.
    is_shared : bool
        Whether jobs of other cells run there, too (`WindowRows.beside`).

    Returns
    -------
    tuple of (threads, error, is_slowed), or None
        See `dwell.estimators.foreign_threads.Level`; None where jobs say nothing.
    """
    out, row, scratch = (c_double * 2)(), node.row(window.flows), _scratch(window)
    beside = window.beside_address if is_shared else None
    found = _level()(byref(row), byref(window.row), beside, shadows, scratch.ctypes.data, out)
    return (out[0], out[1], found == 2) if found else None


def _scratch(window: WindowRows) -> Floats:
    return np.empty(len(window.table) * window.tasks * SCRATCH)


_add_waits = foreign("dwell_add_waits", None, c_void_p, c_int64, c_void_p, c_void_p)
_level = foreign("dwell_level", c_int64, *(c_void_p,) * 3, c_int64, *(c_void_p,) * 2)
