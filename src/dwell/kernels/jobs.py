"""Estimates of waits and of foreign threads from the jobs of a window (see ``jobs.cpp``)."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Array, byref, c_double, c_int64, c_void_p
from typing import Any, NamedTuple

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.meter import WindowRows
from dwell.kernels.rows import structs
from dwell.model.number_arrays import Floats

#: Scratch numbers per job of a window, for own jobs and shadow jobs.
SCRATCH = 40


class NodeJobs(NamedTuple):
    """Jobs on the CPU of a node.

    Parameters
    ----------
    cores : float64 array, shape (candidates, tasks)
        Cores of each task's job under each candidate; 0 if it runs on another node.
    is_fair : bool
        Whether jobs share the cores as threads of equal weight.
    n_cores, spare : float
        Cores of the node, and cores without its background load.
    period_ns : int
    bursts : float
        Share of the time with bursts.
    """

    cores: Floats
    is_fair: bool
    n_cores: float
    spare: float
    period_ns: int
    bursts: float = 0.0

    def row(self, flows: int) -> Any:
        """Return the kernel's row; it is valid as long as `cores` exists."""
        head = self.cores.shape[1], flows, self.cores.ctypes.data, self.is_fair
        of_node = self.n_cores, self.spare, self.period_ns, 0.0, self.bursts, 0.0, 0.0
        return structs()["NodeJobs"](*head, *of_node)


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
        self._scratch = _Scratch()
        self._out = WindowRows(np.empty((0, 0), np.int64), 0, 0)

    def __reduce__(self) -> tuple[type[WaitingJobs], tuple[Sequence[NodeJobs], int]]:
        # A copy needs its own addresses.
        return WaitingJobs, (self._nodes, self._flows)

    def added(
        self, window: WindowRows, foreign_threads: Sequence[float], own_cores: Sequence[float]
    ) -> WindowRows:
        """Return a window with the typical wait of each task's jobs in the work of own jobs.

        `own_cores` has the mean cores that the cell's jobs used on each full node; 0 for others.
        The next call overwrites the result.
        """
        for row, threads, own in zip(self._rows, foreign_threads, own_cores, strict=True):
            row.foreign, row.own = threads, own
        if self._out.table.shape != window.table.shape:
            self._out = WindowRows(np.empty_like(window.table), window.tasks, window.flows)
        of, out = byref(window.row), byref(self._out.row)
        _add_waits()(self._rows, len(self._rows), of, self._scratch.address(window), out)
        return self._out


class SlowedJobs:
    """Estimates the number of foreign threads on a node from the jobs of windows."""

    def __init__(self, node: NodeJobs, flows: int) -> None:
        self._node, self._flows = node, flows
        self._row, self._scratch = node.row(flows), _Scratch()

    def __reduce__(self) -> tuple[type[SlowedJobs], tuple[NodeJobs, int]]:
        # A copy needs its own addresses.
        return SlowedJobs, (self._node, self._flows)

    def level(
        self,
        window: WindowRows,
        used: tuple[float, float],
        *,
        shadows: bool,
        is_shared: bool = False,
    ) -> tuple[float, float, bool] | None:
        """Estimate the number of foreign threads since their last change.

        Parameters
        ----------
        used : tuple of (own, others)
            Mean cores that the cell's jobs used, and that foreign threads used, on a full node; 0
            if it is not full.
        shadows : bool
            Whether shadow jobs count if own jobs are too few.
        is_shared : bool
            Whether jobs of other cells run on the node, too (`WindowRows.beside`).

        Returns
        -------
        tuple of (threads, error, is_slowed), or None
            See `dwell.estimators.foreign_threads.Level`; None if the jobs allow no estimate.
        """
        self._row.own, self._row.others = used
        out, beside = (c_double * 2)(), window.beside_address if is_shared else None
        of = byref(self._row), byref(window.row), beside, shadows
        found = _level()(*of, self._scratch.address(window), out)
        return (out[0], out[1], found == 2) if found else None


class _Scratch:
    """Memory for the jobs of a window; its allocation takes longer than the computation."""

    def __init__(self) -> None:
        self._memory, self._address = np.empty(0), 0

    def address(self, window: WindowRows) -> int:
        """Return the address of enough memory."""
        if len(self._memory) < len(window.table) * window.tasks * SCRATCH:
            self._memory = np.empty(len(window.table) * window.tasks * SCRATCH)
            self._address = self._memory.ctypes.data
        return self._address


_add_waits = foreign("dwell_add_waits", None, c_void_p, c_int64, *(c_void_p,) * 3)
_level = foreign("dwell_level", c_int64, *(c_void_p,) * 3, c_int64, *(c_void_p,) * 2)
