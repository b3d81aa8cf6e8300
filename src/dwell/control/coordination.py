"""Coordination of the moves of a fleet's cells: every decision needs a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.control.watchdog import Doubts, SeenWindow
from dwell.estimators.protocol import CellEstimator
from dwell.model import Decision, QoS

#: Φ before and after the move considered, and the round; None for unknown values.
Asked: TypeAlias = tuple[float | None, float | None, int | None]
NOT_ASKED: Asked = (None, None, None)


class Verdict(NamedTuple):
    """The verdict of a fleet on a decision.

    Parameters
    ----------
    name : str
        Candidate of the next cycles.
    why : str, optional
        Reason against the policy's candidate.
    asked : tuple
        Φ before and after the move considered, and the round.
    """

    name: str
    why: str | None = None
    asked: Asked = NOT_ASKED


class Wish(NamedTuple):
    """A decision of a policy, for the verdict of the fleet.

    Parameters
    ----------
    decision : Decision
    estimates : mapping of str to QoS
        Estimates of all candidates.
    incumbent : str
        Placement of the cell.
    estimator : CellEstimator
        Estimator of the estimates.
    by_price : bool
        Whether the policy accepts any candidate that is cheap enough; the fleet may then choose
        another candidate than the policy.
    seen : SeenWindow, optional
        Window of the decision.
    doubts : Doubts, optional
        Candidates of the cell whose windows contradicted the simulation.
    on_fallback : bool
        Whether the cell is on a fallback of the guard.
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
    """Accepts decisions of a cell's policy, or replaces them."""

    @property
    def knows_others(self) -> bool:
        """Whether the load of the fleet's other cells is known, and thus not foreign."""
        return False

    def consider(self, wish: Wish) -> Verdict:
        """Return the verdict on a decision of the policy."""
        ...

    def meet(self, estimator: CellEstimator) -> None:
        """Pass facts of the fleet to the cell's estimator before the first window."""
        return

    def turns(self, release_ns: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """Return whether each cycle may send shadows to shared nodes; None if all may."""
        return None

    def place(self, name: str) -> None:
        """Record the placement of the cell after a move by the guard or a person."""
        return


class ByChance(Coordination):
    """Accepts a move at random, with the relative saving of J as its probability.

    If all cells of a fleet see the same advantage at once, only some of them move, and the others
    decide again later (Fischer and Vöcking, PODC 2005, DOI 10.1145/1073814.1073868). Controllers
    need no knowledge of each other. Moves of a policy without prices are always accepted.

    Parameters
    ----------
    rng : numpy Generator
        Random numbers of one cell.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __repr__(self) -> str:
        return "<ByChance>"

    def consider(self, wish: Wish) -> Verdict:
        """Accept or refuse a move at random."""
        decision, incumbent = wish.decision, wish.incumbent
        costs = decision.costs
        if not decision.migrated or incumbent not in costs or not costs[incumbent] > 0:
            return Verdict(decision.name)
        # The cost of the other candidate includes the switching term.
        gain = costs[incumbent] - costs[decision.name]
        chance = min(1.0, max(0.0, gain / costs[incumbent]))
        if self._rng.random() < chance:
            return Verdict(decision.name)
        return Verdict(incumbent, f"chance: {chance:.3g}")
