"""The times of the parts of a window's cycles (see ``meter.cpp``)."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import byref, c_int64, c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.library import foreign
from dwell.kernels.rows import structs
from dwell.model.number_arrays import Floats, Ints


class CyclesLayout:
    """Parts (jobs and messages) of the cycles under one candidate, and of their shadows.

    Parameters
    ----------
    sources : int64 array, shape (flows,)
        Source of each flow.
    parts : int64 array, shape (1 + candidates, tasks + flows)
        Number of the part of each task, then of each flow. Row 0 is for the cycles themselves, the
        other rows for their shadows through each candidate; -1 for no own part.
    shared : bool array, shape (1 + candidates, flows)
        Whether the source of a flow is shared with the cycle.
    """

    def __init__(self, sources: Ints, parts: Ints, shared: NDArray[np.bool_]) -> None:
        flows = len(sources)
        # Keep the arrays whose addresses are in the row.
        self._behind = tuple(map(np.ascontiguousarray, (sources, parts, shared)))
        addresses = (table.ctypes.data for table in self._behind)
        self.row = structs()["Layout"](parts.shape[1] - flows, flows, *addresses)

    def __reduce__(self) -> tuple[type[CyclesLayout], tuple[NDArray[Any], ...]]:
        # A copy has its own addresses.
        return CyclesLayout, self._behind


class WindowRows:
    """The instants of a window's cycles, as an argument of the kernel's functions.

    Parameters
    ----------
    table : int64 array, shape (n, columns)
        See `of`.
    tasks, flows : int
        Number of tasks and flows.
    beside : int64 array, shape (n, 1 or 2, tasks, 2), optional
        Two integrals over the run of each job, of the cycles and then of their shadows. The first
        integrates the threads of all cells on its server, its own included. The second, for shadow
        jobs, integrates the threads of the own jobs of all cells. Only if cells share nodes.
    """

    def __init__(self, table: Ints, tasks: int, flows: int, beside: Ints | None = None) -> None:
        self.table, self.tasks, self.flows, self.beside = table, tasks, flows, beside
        self.row = structs()["Window"](table.ctypes.data, *table.shape)
        self._known: tuple[int, int] | None = None

    @classmethod
    def of(
        cls,
        cycles: Sequence[NDArray[np.integer]],
        shadows: Sequence[NDArray[np.integer]] | None = None,
    ) -> WindowRows:
        """Return the instants of cycles, and of their shadows, as one table.

        Parameters
        ----------
        cycles, shadows : sequence of six int64 arrays
            Candidate of each cycle, shape (n,), -1 for none; readiness and completion of its jobs,
            both (n, tasks); arrival of its messages, (n, flows); core time and start of its jobs,
            both (n, tasks). Future instants and unknown values are -1.
        """
        columns = [cycles[0][:, None], *cycles[1:]]
        if shadows is not None:
            columns += [shadows[0][:, None], *shadows[1:]]
        # One table needs one address; the look-up of an address takes as long as a copy.
        table = np.concatenate(columns, axis=1, dtype=np.int64)
        return cls(table, cycles[1].shape[1], cycles[3].shape[1])

    def columns(self, *, shadow: bool) -> tuple[Ints, Ints, Ints, Ints, Ints, Ints]:
        """Return the columns of the cycles, or of their shadows (see `of`)."""
        tasks, flows, table = self.tasks, self.flows, self.table
        ready = 1 + (1 + 4 * tasks + flows) * shadow
        end, arrived = ready + tasks, ready + 2 * tasks
        work, start = arrived + flows, arrived + flows + tasks
        return (
            table[:, ready - 1],
            table[:, ready:end],
            table[:, end:arrived],
            table[:, arrived:work],
            table[:, work:start],
            table[:, start : start + tasks],
        )

    @property
    def beside_address(self) -> int | None:
        """Address of `beside`."""
        return None if self.beside is None else self.beside.ctypes.data

    @property
    def has_shadows(self) -> bool:
        """Whether there are columns of shadows."""
        return bool(self.table.shape[1] > 1 + 4 * self.tasks + self.flows)

    def __reduce__(self) -> tuple[type[WindowRows], tuple[Ints, int, int, Ints | None]]:
        # A copy has its own address.
        return WindowRows, (self.table, self.tasks, self.flows, self.beside)

    def unknown(self, limit_ns: int) -> tuple[bool, bool, bool]:
        """Return which kinds of unknown values the window has.

        Returns
        -------
        tuple of bool
            Whether an own job that began before `limit_ns` is unfinished; whether the work of a
            completed own job is unknown; whether the work of a completed shadow job is unknown.
        """
        found = self._look(limit_ns)
        return bool(found & 1), bool(found & 2), bool(found & 4)

    def candidates(self, limit_ns: int) -> list[int]:
        """Return the candidates of the cycles, ascending; one call of the kernel per limit."""
        if self._look(limit_ns) & 8:
            return sorted(set(self.table[:, 0].tolist()))
        return [self.table.item(0, 0)]

    def _look(self, limit_ns: int) -> int:
        known = self._known
        if known is None or known[0] != limit_ns:
            found = _unknown()(self.tasks, self.flows, byref(self.row), limit_ns)
            known = self._known = limit_ns, found
        return known[1]


#: `counted` of cycles of which no window has counted anything.
OWN = -1, 0


class PartTimes:
    """Times, or demands, of the parts of a window's cycles, milliseconds; infinite if lost.

    Parameters
    ----------
    parts : int
        Number of parts.
    cost : float64 array, shape (parts,), optional
        Given to measure demands instead of times: for a job the ratio of its time alone to its core
        time, for a message its transmission time in nanoseconds.
    link : int64 array, shape (parts,), optional
        Number of the link of a message, if messages wait there; -1 for none.
    repeats : int64 array, shape (parts,), optional
        1 for messages of links that repeat what is lost and keep the order, else 0.
    more_ns : int64 array, shape (parts,), optional
        Time by which each part may begin before the limit of a window (see `begin`) without being
        lost.

    Raises
    ------
    KernelError
        If the library cannot be loaded; raised before the first window.
    """

    def __init__(
        self,
        parts: int,
        cost: Floats | None = None,
        link: Ints | None = None,
        repeats: Ints | None = None,
        more_ns: Ints | None = None,
    ) -> None:
        self._meter = _meter()
        self._cost, self._link, self._repeats, self._more_ns = cost, link, repeats, more_ns
        self._count, self._order = np.zeros((2, parts), np.int64)
        #: The kernel's row of the times found.
        self.found = structs()["Found"]()
        self.found.count, self.found.order = self._count.ctypes.data, self._order.ctypes.data
        if cost is not None and link is not None and repeats is not None:
            self.found.cost, self.found.link = cost.ctypes.data, link.ctypes.data
            self.found.repeats = repeats.ctypes.data
        if more_ns is not None:
            self.found.more_ns = more_ns.ctypes.data
        self._ms, self._crossings = np.empty((parts, 0)), np.empty(0, np.int64)

    def __reduce__(self) -> tuple[type[PartTimes], tuple[int | Floats | Ints | None, ...]]:
        # A copy has its own addresses, and starts without times.
        given = self._cost, self._link, self._repeats, self._more_ns
        return PartTimes, (len(self._count), *given)

    def begin(
        self, window: WindowRows, limit_ns: int, *, later: int = 0, counted: tuple[int, int] = OWN
    ) -> None:
        """Begin a window; this overwrites the times of the previous window.

        Parameters
        ----------
        limit_ns : int
            A job or message that began before this, and has not ended, counts as lost; with
            `more_ns` of its part, if it began earlier by as much.
        later : int
            Number of cycles that `go_on` adds.
        counted : tuple of int
            Of earlier cycles: the end of the last window, and the time since. Only parts with
            `more_ns` count that had not ended by then, and did not count as lost.
        """
        self._window, self._limit_ns = window, limit_ns
        self.found.counted_ns, self.found.passed_ns = counted
        count, flows = len(window.table) + later, window.flows
        if self._ms.shape[1] < 2 * count:
            self._ms = np.empty((len(self._count), 2 * count))
            self.found.ms, self.found.most = self._ms.ctypes.data, self._ms.shape[1]
        if self._cost is not None:
            # Messages of every cycle and its shadow; a `Crossing` has seven numbers.
            room = 2 * count * flows * 7
            if len(self._crossings) < room:
                self._crossings = np.empty(room, np.int64)
                self.found.crossings = self._crossings.ctypes.data
        self._count[:] = 0
        self.found.n_parts = 0

    def go_on(self, window: WindowRows) -> None:
        """Continue with the window's own cycles after the earlier cycles."""
        self._window = window
        self.found.counted_ns, self.found.passed_ns = OWN

    def add(self, active: int, layout: CyclesLayout) -> None:
        """Add the times of the cycles under one candidate, then the times of their shadows."""
        row = byref(self._window.row)
        self._meter(byref(layout.row), row, active, self._limit_ns, byref(self.found))

    @property
    def numbers(self) -> list[int]:
        """Numbers of the parts, in the order in which they were found."""
        numbers: list[int] = self._order[: self.found.n_parts].tolist()
        return numbers

    def values(self, part: int) -> Floats:
        """Return the times of a part."""
        return self._ms[part, : self._count[part]]

    def by_part(self) -> dict[int, Floats]:
        """Return the times by number of part, in the order in which they were found."""
        return {part: self.values(part) for part in self.numbers}


_unknown = foreign("dwell_unknown", c_int64, c_int64, c_int64, c_void_p, c_int64)
_meter = foreign("dwell_meter", None, c_void_p, c_void_p, c_int64, c_int64, c_void_p)
