"""Coordination: what a cell of a fleet has to ask before it moves."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dwell.control.controller import Proposal


class Coordination(Protocol):
    """Says of a move that is proposed whether it may be made."""

    def refusal(self, proposal: Proposal, incumbent: str) -> str:
        """Return why a move may not be made; nothing where it may."""
        ...


class Uncoordinated:
    """Lets every move pass."""

    def refusal(self, proposal: Proposal, incumbent: str) -> str:
        """Return nothing."""
        return ""


class ByChance:
    """Lets a move pass with a probability: the share of its J that the cell gains.

    Where all cells of a fleet see the same advantage at once, some go, and the others look again
    (Fischer and Vöcking, PODC 2005, DOI 10.1145/1073814.1073868). Controllers need not know of each
    other for it.

    Parameters
    ----------
    rng : numpy Generator
        Of one cell.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __repr__(self) -> str:
        return "<ByChance>"

    def refusal(self, proposal: Proposal, incumbent: str) -> str:
        """Return why not, in about that share of the cases; a policy without prices passes."""
        costs, name = proposal.decision.costs, proposal.decision.name
        if incumbent not in costs or name not in costs or not costs[incumbent] > 0:
            return ""
        # The price of the move is in what the other candidate costs.
        chance = min(1.0, max(0.0, (costs[incumbent] - costs[name]) / costs[incumbent]))
        return "" if self._rng.random() < chance else f"chance: {chance:.3g}"
