"""Moves of a run: their time, source, target and reason."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

if TYPE_CHECKING:
    from dwell.model.number_arrays import Mask
    from dwell.record.fleet_run import FleetRun
    from dwell.record.run import Run
    from dwell.record.table_arrays import TableArrays

#: Reason of a move that the robot made by itself.
GUARD = "guard"
#: Reasons of moves that no decision on cycles made: the robot's, and those of operators.
UNDECIDED = (GUARD, "pinned", "drained", "ordered")


class _Columns(Protocol):
    """A table with columns by name: a data frame, or the lists of a journal."""

    def __getitem__(self, name: str, /) -> Sequence[Any] | Any: ...


class Move(NamedTuple):
    """A move of a cell.

    Parameters
    ----------
    row : int
        Its row in `decisions`.
    window : int
        The last window before it.
    cycle : int
        The first cycle after the cycles that the decision evaluated.
    source, target : str
        The placements before and after.
    reason : str
        The rule that made it.
    """

    row: int
    window: int
    cycle: int
    source: str
    target: str
    reason: str

    @property
    def by_guard(self) -> bool:
        """Whether the robot moved by itself."""
        return self.reason == GUARD

    @property
    def is_decided(self) -> bool:
        """Whether a decision on cycles made it."""
        return self.reason not in UNDECIDED


def moves(run: Run | FleetRun) -> list[Move]:
    """Return the moves of a run, or of all cells of a fleet, in the order of the decisions."""
    return moves_in(run.decisions)


def moves_in(decisions: _Columns) -> list[Move]:
    """Return the moves in a table of decisions."""
    rows = [row for row, migrated in enumerate(decisions["migrated"]) if migrated]
    names = ("window", "last_cycle", "incumbent", "placement", "reason")
    columns = [decisions[name] for name in names]
    return [_move(row, *(column[row] for column in columns)) for row in rows]


def _move(row: int, window: int, last: int, source: str, target: str, reason: str) -> Move:
    # A move without a decision is recorded under the window that follows it.
    return Move(row, window - (reason in UNDECIDED), last + 1, source, target, reason)


def by_guard(decisions: TableArrays) -> Mask:
    """Return which decisions are moves of the guard."""
    return decisions.names("reason").equal(GUARD)
