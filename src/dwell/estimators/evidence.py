"""Evidence: instants of jobs and messages in a finished window.

Every message carries the instants of its jobs and hops. A window therefore shows the time of each
task on its node and of each message on its link. The simulator and the live runtime provide the
same instants.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.meter import WindowRows
from dwell.model.number_arrays import Ints

Rows: TypeAlias = slice | NDArray[np.bool_] | NDArray[np.int64]

#: Value of an instant that was still in the future, or unknown, at the end of the window.
UNKNOWN = -1
#: Value of the instants of jobs and messages that are not due in a cycle.
NOT_DUE = -2


@dataclass(frozen=True, slots=True)
class Instants:
    """Instants of the jobs and messages of a window's cycles, nanoseconds; `UNKNOWN` if never.

    Arrays that the engine omits are None.

    Parameters
    ----------
    ready_ns, end_ns : int64 array, shape (W, tasks)
        When all inputs of a job had arrived, and when the job had completed.
    arrived_ns : int64 array, shape (W, flows)
        When the message of a flow reached its target task. It was sent when the source's job
        ended; within a node it arrives at once.
    start_ns : int64 array, shape (W, tasks), optional
        When a worker started a job.
    work_ns : int64 array, shape (W, tasks), optional
        Core time of a completed job, summed over its threads; on an accelerator the time from its
        start to its end.
    """

    ready_ns: Ints
    end_ns: Ints
    arrived_ns: Ints
    start_ns: Ints | None = None
    work_ns: Ints | None = None

    def __repr__(self) -> str:
        return f"<Instants of {len(self.end_ns)} cycles>"

    def at(self, rows: Rows) -> Instants:
        """Return the instants of the selected cycles."""
        return Instants(
            ready_ns=self.ready_ns[rows],
            end_ns=self.end_ns[rows],
            arrived_ns=self.arrived_ns[rows],
            start_ns=None if self.start_ns is None else self.start_ns[rows],
            work_ns=None if self.work_ns is None else self.work_ns[rows],
        )

    def columns(self, placement: NDArray[np.integer]) -> tuple[NDArray[np.integer], ...]:
        """Return the arguments of `WindowRows.of` for cycles or shadows under candidates."""
        nothing = np.full_like(self.ready_ns, UNKNOWN)
        work_ns = nothing if self.work_ns is None else self.work_ns
        start_ns = nothing if self.start_ns is None else self.start_ns
        return placement, self.ready_ns, self.end_ns, self.arrived_ns, work_ns, start_ns


@dataclass(frozen=True)
class Evidence:
    """Instants of a window, as known at its end; tasks and flows in the pipeline's order.

    Parameters
    ----------
    release_ns : int64 array, shape (W,)
    rows : WindowRows
        All instants as one table.
    shadows_share : bool
        Whether shadow jobs share the cores that own jobs leave equally with foreign threads. If
        they have lower priority, their times do not show the number of foreign threads.
    earlier : Evidence, optional
        The `Problem.earlier_cycles` cycles before, as known now; None if all tasks run in each
        cycle. Runs of slow tasks that had not ended by the decision before count now.
    """

    close_ns: int
    release_ns: Ints
    rows: WindowRows
    shadows_share: bool = True
    earlier: Evidence | None = None

    @classmethod
    def of(
        cls,
        close_ns: int,
        release_ns: Ints,
        placement: NDArray[np.integer],
        cycles: Instants,
        shadow_placement: NDArray[np.integer],
        shadows: Instants | None,
        *,
        shadows_share: bool = True,
        earlier: Evidence | None = None,
    ) -> Evidence:
        """Make the evidence from the instants of cycles and of their shadows."""
        sent = None if shadows is None else shadows.columns(shadow_placement)
        rows = WindowRows.of(cycles.columns(placement), sent)
        return cls(close_ns, release_ns, rows, shadows_share, earlier)

    def with_instants(self, cycles: Instants, shadows: Instants | None) -> Evidence:
        """Return the evidence with other instants."""
        return Evidence.of(
            self.close_ns,
            self.release_ns,
            self.placement,
            cycles,
            self.shadow_placement,
            shadows,
            shadows_share=self.shadows_share,
        )

    # Most windows need only the table.

    @cached_property
    def placement(self) -> Ints:
        """Index of the candidate that each cycle ran under, shape (W,)."""
        return self.rows.columns(shadow=False)[0]

    @cached_property
    def cycles(self) -> Instants:
        """Instants of the jobs and messages of the cycles."""
        return self._instants(shadow=False)

    @cached_property
    def shadow_placement(self) -> Ints:
        """Index of the candidate that a cycle was also sent through; -1 for none."""
        if self.rows.has_shadows:
            return self.rows.columns(shadow=True)[0]
        return np.full_like(self.placement, -1)

    @cached_property
    def shadows(self) -> Instants | None:
        """Instants of the jobs and messages that a shadow did not share with the cycle itself.

        It stops before the sinks: its last messages arrive there and are discarded.
        """
        return self._instants(shadow=True) if self.rows.has_shadows else None

    def _instants(self, *, shadow: bool) -> Instants:
        _, ready, end, arrived, work, start = self.rows.columns(shadow=shadow)
        return Instants(ready, end, arrived, start, work)

    def __repr__(self) -> str:
        shadows = int((self.shadow_placement >= 0).sum())
        return f"<Evidence of {len(self.release_ns)} cycles, {shadows} of them with a shadow>"
