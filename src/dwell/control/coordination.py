"""Coordination: what a cell of a fleet has to ask before it moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.control.watchdog import Doubts, SeenWindow
from dwell.estimators.protocol import CellEstimator
from dwell.model import Decision, QoS

#: Φ before and after what was looked at, and the round that it is of; what is not known is None.
Asked: TypeAlias = tuple[float | None, float | None, int | None]
NOT_ASKED: Asked = (None, None, None)


class Verdict(NamedTuple):
    """What a fleet says of a decision.

    Parameters
    ----------
    name : str
        Candidate of the cycles that follow.
    why : str, optional
        Why it is not the one that the policy has decided for.
    asked : tuple
        Φ before and after the move that was looked at, and the round.
    """

    name: str
    why: str | None = None
    asked: Asked = NOT_ASKED


class Wish(NamedTuple):
    """What a policy has decided at a close.

    Parameters
    ----------
    decision : Decision
    estimates : mapping of str to QoS
        Of every candidate.
    incumbent : str
        Where the cell is.
    estimator : CellEstimator
        Whose estimates they are.
    by_price : bool
        Whether the policy would move to any candidate that is cheap enough, so that another one
        may be taken in the place of its own.
    seen : SeenWindow, optional
        What the decision looks at.
    doubts : Doubts, optional
        Candidates of the cell whose windows were not what was played.
    on_fallback : bool
        Whether the guard holds the cell on a fallback.
    """

    decision: Decision
    estimates: Mapping[str, QoS]
    incumbent: str
    estimator: CellEstimator
    by_price: bool
    seen: SeenWindow | None = None
    doubts: Doubts | None = None
    on_fallback: bool = False


class Coordination(Protocol):
    """Says of a decision whether it may be carried out, or what is to be done in its place."""

    @property
    def knows_others(self) -> bool:
        """Whether what other cells of the fleet do is known, so that it is no foreign load."""
        return False

    def consider(self, wish: Wish) -> Verdict:
        """Look at what a policy has decided at a close."""
        ...

    def meet(self, estimator: CellEstimator) -> None:
        """Have the cell's estimator take notice of the fleet, before the first window."""
        return

    def turns(self, release_ns: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """Whether shadows may be sent to shared nodes with each cycle; None where all may."""
        return None

    def place(self, name: str) -> None:
        """Take note of where the cell is, though nothing was asked: the guard, or a person."""
        return


class ByChance(Coordination):
    """Lets a move pass with a probability: the share of its J that the cell gains.

    Where all cells of a fleet see the same advantage at once, some go, and the others look again
    (Fischer and Vöcking, PODC 2005, DOI 10.1145/1073814.1073868). Controllers need not know of each
    other for it. The move of a policy without prices passes.

    Parameters
    ----------
    rng : numpy Generator
        Of one cell.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __repr__(self) -> str:
        return "<ByChance>"

    def consider(self, wish: Wish) -> Verdict:
        """Refuse a move in some of the cases."""
        decision, incumbent = wish.decision, wish.incumbent
        costs = decision.costs
        if not decision.migrated or incumbent not in costs or not costs[incumbent] > 0:
            return Verdict(decision.name)
        # The price of the move is in what the other candidate costs.
        gain = costs[incumbent] - costs[decision.name]
        chance = min(1.0, max(0.0, gain / costs[incumbent]))
        if self._rng.random() < chance:
            return Verdict(decision.name)
        return Verdict(incumbent, f"chance: {chance:.3g}")
