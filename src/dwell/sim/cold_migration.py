"""Cold migrations: workers start and receive state before an order takes effect."""

from __future__ import annotations

from dwell.kernels.advance import end_repeats, post_event, send_state
from dwell.kernels.arrays import CellArrays
from dwell.kernels.codes import CYCLE_BITS, EventKind, cycle_of, item_of, make_key
from dwell.kernels.realisation import Realisation
from dwell.model import Problem

# The cycle field of an event contains the number of the migration, the attempt, and a ready bit.
NUMBER_SHIFT = 20
ATTEMPTS = (1 << (NUMBER_SHIFT - 1)) - 1
NUMBERS = (1 << (CYCLE_BITS - NUMBER_SHIFT)) - 1


class ColdMigration:
    """The current cold migration of a cell, if any.

    `dwell.kernels.advance` returns its events to Python: a worker has started, state has arrived,
    or state must be sent again. An event's item is the task. Its cycle field contains the number of
    the migration, the attempt, and whether the task is ready.

    `boundary` is the first cycle after the window that led to the order.
    """

    def __init__(self, problem: Problem, realisation: Realisation) -> None:
        self.candidates = problem.candidates
        self.tasks = tuple(problem.pipeline.tasks.values())
        self.hop_row = {hop: row for row, hop in enumerate(realisation.hops)}
        self.boundary = self.number = 0
        # Hop for the state of each task that is not ready yet; -1 for a task without state.
        self.hops: dict[int, int] = {}

    def moves(self, incumbent: str, order: str) -> bool:
        """Whether an order moves a task."""
        return self.candidates[incumbent] != self.candidates[order]

    def begin(
        self, arrays: CellArrays, incumbent: str, order: str, boundary: int, arrival_ns: int
    ) -> None:
        """Start a worker for every task that an order moves."""
        self.boundary, self.number = boundary, self.number + 1
        old, new = self.candidates[incumbent], self.candidates[order]
        for row, task in enumerate(self.tasks):
            if old[task.name] != new[task.name]:
                link = f"{old[task.name]}->{new[task.name]}"
                self.hops[row] = self.hop_row.get((task.name, task.name, link), -1)
                started_ns = arrival_ns + round(task.start_ms * 1e6)
                self._announce(arrays, row, 0, self.hops[row] < 0, started_ns)

    def step(self, arrays: CellArrays) -> bool:
        """Process the current event; return True if the last task is ready now."""
        clock = arrays.tables.clock[0]
        key, now = int(clock["step_key"]), int(clock["step_ns"])
        field, row = cycle_of(key), item_of(key)
        attempt, ready = (field >> 1) & ATTEMPTS, bool(field & 1)
        number = field >> NUMBER_SHIFT
        arrival = make_key(EventKind.MIGRATE, arrays.part.row, number << NUMBER_SHIFT | 1, row)
        if not self.hops or number != self.number & NUMBERS:
            # The event belongs to a migration that the guard has cancelled.
            end_repeats(arrays, arrival, now)
            return False
        if ready:
            del self.hops[row]
            return not self.hops
        t, attempt = send_state(arrays, self.hops[row], self.boundary, attempt, arrival, now)
        if t >= 0:
            self._announce(arrays, row, attempt, False, t)
        return False

    def stop(self) -> None:
        """Cancel the current migration, if any, and its order."""
        self.hops.clear()

    def _announce(self, arrays: CellArrays, row: int, attempt: int, ready: bool, t: int) -> None:
        field = ((self.number & NUMBERS) << NUMBER_SHIFT) | ((attempt & ATTEMPTS) << 1) | ready
        post_event(arrays, t, EventKind.MIGRATE, cycle=field, item=row)
