"""The placement of a cell, the author of its last move, and the placement that is wanted."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Course:
    """The placement in force, as far as the process that keeps this object knows it.

    In a live cell, the stamper's course is authoritative, and the controller's follows the reports
    of the stamper. The simulator needs only one course, because it carries out every order.

    ================  ===========  ===========  =======  ==========  ========
    method            `placement`  `previous`   `dwell`  `by_guard`  `wanted`
    ================  ===========  ===========  =======  ==========  ========
    `stay`            same         `placement`  given    same        none
    `move`            new          last one     given    no          none
    `fall`            new          given        0        yes         none
    `find`            new          new          0        given       same
    `miss`            same         `placement`  same     same        same
    `hold`            same         `placement`  same     same        new
    ================  ===========  ===========  =======  ==========  ========

    Parameters
    ----------
    placement : str
        Candidate in force.
    run, term : int
        Run, and its term, in which the placement is in force.
    by_guard : bool
        Whether the guard made the move to the placement.

    Attributes
    ----------
    previous : str
        Candidate before the last decision. The cost of a window includes the switching term from
        `previous` to `placement`.
    dwell : int
        Decisions since the last move (n_d).
    wanted : str or None
        Candidate that will replace the guard's fallback once probes have proven it.
    """

    placement: str
    run: int = 0
    term: int = 0
    by_guard: bool = False
    previous: str = ""
    dwell: int = 0
    wanted: str | None = None

    def __post_init__(self) -> None:
        self.previous = self.previous or self.placement

    def stay(self, dwell: int) -> None:
        """Record a decision to stay."""
        self.previous, self.dwell, self.wanted = self.placement, dwell, None

    def miss(self) -> None:
        """Record a window without a decision."""
        self.previous = self.placement

    def move(self, placement: str, dwell: int = 0) -> None:
        """Record that an order has taken effect."""
        self.previous, self.placement = self.placement, placement
        self.by_guard, self.dwell, self.wanted = False, dwell, None

    def credit(self, *, by_guard: bool) -> None:
        """Record whether the guard made the last move."""
        self.by_guard = by_guard

    def fall(self, placement: str, left: str) -> None:
        """Record that the guard has moved the cell from `left` to `placement`."""
        self.previous, self.placement = left, placement
        self.by_guard, self.dwell, self.wanted = True, 0, None

    def find(self, placement: str, *, by_guard: bool = False) -> None:
        """Record the placement of the cell without a switching term."""
        self.placement = self.previous = placement
        self.by_guard, self.dwell = by_guard, 0

    def hold(self, wanted: str) -> None:
        """Record that the cell stays on the guard's fallback until probes prove `wanted`."""
        self.previous, self.wanted = self.placement, wanted

    def enter(self, run: int, term: int) -> None:
        """Record the run and its term."""
        self.run, self.term = run, term

    def leaves_unproven(self, placement: str, proven: str | None) -> bool:
        """Whether a move would leave the guard's fallback for an unproven candidate."""
        return self.by_guard and placement not in (self.placement, proven)
