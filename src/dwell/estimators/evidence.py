"""Evidence: what the messages of a closed window said about jobs and links.

Every message carries the instants of the jobs and hops it went through, so that a window shows more
than its metrics: how long each task took on the node it ran on, and each message on its link. The
simulator and the live runtime hand over the same instants.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.meter import WindowRows
from dwell.model.number_arrays import Ints

Rows: TypeAlias = slice | NDArray[np.bool_] | NDArray[np.int64]

#: Stands for an instant that had not come, or was not known, when the window closed.
UNKNOWN = -1


@dataclass(frozen=True, slots=True)
class Instants:
    """Instants of the jobs and messages of a window's cycles, nanoseconds; `UNKNOWN` if never.

    What an engine does not know of any job is None.

    Parameters
    ----------
    ready_ns, end_ns : int64 array, shape (W, tasks)
        When all inputs of a job were there, and when it had completed.
    arrived_ns : int64 array, shape (W, flows)
        When the message of a flow was handed to its target; it was sent when its source's job
        ended. On one node it is handed over at once.
    start_ns : int64 array, shape (W, tasks), optional
        When a worker began with a job.
    work_ns : int64 array, shape (W, tasks), optional
        Core time that a completed job received, over all of its threads; that of one on an
        accelerator is from its start to its end.
    """

    ready_ns: Ints
    end_ns: Ints
    arrived_ns: Ints
    start_ns: Ints | None = None
    work_ns: Ints | None = None

    def __repr__(self) -> str:
        return f"<Instants of {len(self.end_ns)} cycles>"

    def at(self, rows: Rows) -> Instants:
        """Instants of some of the cycles."""
        return Instants(
            ready_ns=self.ready_ns[rows],
            end_ns=self.end_ns[rows],
            arrived_ns=self.arrived_ns[rows],
            start_ns=None if self.start_ns is None else self.start_ns[rows],
            work_ns=None if self.work_ns is None else self.work_ns[rows],
        )

    def columns(self, placement: NDArray[np.integer]) -> tuple[NDArray[np.integer], ...]:
        """Return what `WindowRows.of` takes of cycles, or shadows, under candidates."""
        nothing = np.full_like(self.ready_ns, UNKNOWN)
        work_ns = nothing if self.work_ns is None else self.work_ns
        start_ns = nothing if self.start_ns is None else self.start_ns
        return placement, self.ready_ns, self.end_ns, self.arrived_ns, work_ns, start_ns


@dataclass(frozen=True, slots=True)
class Evidence:
    """One window's instants, as known at its close; tasks and flows in the pipeline's order.

    Parameters
    ----------
    release_ns : int64 array, shape (W,)
    placement : int array, shape (W,)
        Index of the candidate that each cycle ran under.
    shadow_placement : int array, shape (W,)
        Index of the candidate that a cycle was also sent through; -1 for none.
    shadows : Instants or None
        Instants of the jobs and messages that a shadow did not share with the cycle itself. It
        stops before the sinks: its last messages arrive there and are discarded.
    shadows_share : bool
        Whether shadow jobs share the cores that own jobs leave with foreign threads as equals.
        Where they stand behind these, how long they take says nothing of how many there are.
    """

    close_ns: int
    release_ns: Ints
    placement: NDArray[np.integer]
    cycles: Instants
    shadow_placement: NDArray[np.integer]
    shadows: Instants | None
    shadows_share: bool = True
    _rows: WindowRows | None = field(default=None, init=False, repr=False, compare=False)

    @classmethod
    def of(cls, rows: WindowRows, close_ns: int, release_ns: Ints) -> Evidence:
        """Make the evidence of instants that are in one table."""
        placement, ready, end, arrived, work, start = rows.columns(shadow=False)
        cycles, shadows = Instants(ready, end, arrived, start, work), None
        if rows.has_shadows:
            sent, ready, end, arrived, work, start = rows.columns(shadow=True)
            shadows = Instants(ready, end, arrived, start, work)
        else:
            sent = np.full_like(placement, -1)
        made = cls(close_ns, release_ns, placement, cycles, sent, shadows)
        object.__setattr__(made, "_rows", rows)
        return made

    @property
    def rows(self) -> WindowRows:
        """All instants as one table, which is made once."""
        if self._rows is None:
            sent = None
            if self.shadows is not None:
                sent = self.shadows.columns(self.shadow_placement)
            rows = WindowRows.of(self.cycles.columns(self.placement), sent)
            object.__setattr__(self, "_rows", rows)
            return rows
        return self._rows

    def __repr__(self) -> str:
        shadows = int((self.shadow_placement >= 0).sum())
        return f"<Evidence of {len(self.release_ns)} cycles, {shadows} of them with a shadow>"
