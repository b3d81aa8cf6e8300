"""Course: where a cell is placed, whose move that was, and where it is wanted."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Course:
    """The placement in force, as whoever holds this knows it.

    Beside the stamper of a live cell it is the truth; the controller's changes by what the stamper
    says. In the simulator there is one, since an order that is given is carried out.

    ================  ===========  ===========  =======  ==========  ========
    what happens      `placement`  `previous`   `dwell`  `by_guard`  `wanted`
    ================  ===========  ===========  =======  ==========  ========
    `stay`            same         `placement`  given    same        none
    `move`            new          what held    given    no          none
    `fall`            new          what held    0        yes         none
    `find`            new          new          0        given       same
    `miss`            same         `placement`  same     same        same
    `hold`            same         `placement`  same     same        new
    ================  ===========  ===========  =======  ==========  ========

    Parameters
    ----------
    placement : str
        Candidate that holds.
    run, term : int
        Run, and its term that the placement holds in.
    by_guard : bool
        Whether that is the guard's own move.

    Attributes
    ----------
    previous : str
        Candidate before the last decision; a window's cost has the switching term between the two.
    dwell : int
        Windows since the last move (n_d).
    wanted : str or None
        What the guard's fallback would be left for, were it proven.
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
        """Note a window after which nothing moves."""
        self.previous, self.dwell, self.wanted = self.placement, dwell, None

    def miss(self) -> None:
        """Note a window that nobody has decided on."""
        self.previous = self.placement

    def move(self, placement: str, dwell: int = 0) -> None:
        """Note that an order holds."""
        self.previous, self.placement = self.placement, placement
        self.by_guard, self.dwell, self.wanted = False, dwell, None

    def credit(self, *, by_guard: bool) -> None:
        """Note whose move it is that holds."""
        self.by_guard = by_guard

    def fall(self, placement: str, left: str) -> None:
        """Note that the guard has moved the cell, away from what held until then."""
        self.previous, self.placement = left, placement
        self.by_guard, self.dwell, self.wanted = True, 0, None

    def find(self, placement: str, *, by_guard: bool = False) -> None:
        """Note where the cell is, however it came there: nothing has been switched."""
        self.placement = self.previous = placement
        self.by_guard, self.dwell = by_guard, 0

    def hold(self, wanted: str) -> None:
        """Note that the guard's fallback is kept, since what is wanted is not proven."""
        self.previous, self.wanted = self.placement, wanted

    def enter(self, run: int, term: int) -> None:
        """Note which term of which run that is."""
        self.run, self.term = run, term

    def leaves_unproven(self, placement: str, proven: str | None) -> bool:
        """Whether a move would leave the guard's fallback for what no probes have proven."""
        return self.by_guard and placement not in (self.placement, proven)
