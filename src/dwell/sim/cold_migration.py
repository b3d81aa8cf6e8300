"""Cold migrations: workers start and receive state before an order takes effect."""

from __future__ import annotations

from dwell.kernels.advance import end_repeats, post_event, send_state
from dwell.kernels.arrays import CellArrays
from dwell.kernels.codes import CYCLE_BITS, EventKind, cycle_of, item_of, make_key
from dwell.kernels.realisation import Realisation
from dwell.model import Problem
from dwell.model.placement import nodes_of

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
        # Hop for the state of each task that is not ready yet; -1 for a task without state. The
        # second new node of a task has a number behind all tasks.
        self.hops: dict[int, int] = {}

    def moves(self, incumbent: str, order: str) -> bool:
        """Whether an order brings a task to a new node."""
        return bool(self._added(incumbent, order))

    def _added(self, incumbent: str, order: str) -> list[tuple[int, str, str]]:
        """Return the tasks' rows with old and new node: of the first copy, and each node added."""
        old, new = self.candidates[incumbent], self.candidates[order]
        return [
            (row, old.first[task.name], node)
            for row, task in enumerate(self.tasks)
            for node in nodes_of(new[task.name])
            if node not in nodes_of(old[task.name])
        ]

    def begin(
        self, arrays: CellArrays, incumbent: str, order: str, boundary: int, arrival_ns: int
    ) -> None:
        """Start a worker for every task that an order moves."""
        self.boundary, self.number = boundary, self.number + 1
        for row, here, there in self._added(incumbent, order):
            task = self.tasks[row]
            # A task with two new nodes has two rows.
            item = row + len(self.tasks) * (row in self.hops)
            hop = self.hop_row.get((task.name, task.name, f"{here}->{there}"), -1)
            self.hops[item] = hop
            started_ns = arrival_ns + round(task.start_ms * 1e6)
            self._announce(arrays, item, 0, hop < 0, started_ns)

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
