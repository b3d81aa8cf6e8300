"""Static: the placement that never moves."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import NOT_PRICED, Incumbent, check_candidates, check_name
from dwell.policies.pricing import Pricing, check_metrics

__all__ = ["Static"]


class Static:
    """Wants its candidate whatever happens; every decision is a hold there.

    Where somebody else has moved the cell, every decision is for the way back.

    Parameters
    ----------
    candidates : mapping of str to Placement
    initial : str, optional
        The candidate it stays on; the first where None.
    objective : Objective, optional
        Where given, J of every estimated candidate is recorded; it decides nothing.

    Raises
    ------
    PolicyError
        If `initial` is no candidate, or candidates place different tasks.
    """

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective | None = None,
    ) -> None:
        self.candidates = check_candidates(candidates)
        self.initial = check_name("initial", initial, self.candidates)
        self.objective = objective
        self._pricing = None if objective is None else Pricing(self.candidates, objective)
        self._incumbent = Incumbent(self.candidates, self.initial)

    def __repr__(self) -> str:
        return f"Static(initial={self.initial!r})"

    @property
    def incumbent(self) -> str:
        """Name of the active candidate."""
        return self._incumbent.name

    def start(self, problem: Problem) -> None:
        """Begin again on the initial candidate."""
        self._incumbent.begin(self.initial)

    def adopt(self, name: str) -> None:
        """Take over `name` as the incumbent: somebody else moved the cell there."""
        self._incumbent.adopt(name)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS] | None = None) -> Decision:
        """Hold, or return to the candidate.

        Raises
        ------
        MetricError
            If `observed` is no QoS, or (with an objective) an estimate is missing.
        """
        check_metrics(observed, "observed")
        costs = NOT_PRICED
        if self._pricing is not None and estimates is not None:
            costs = self._pricing.estimated(estimates, self._incumbent.name)
        if self._incumbent.name != self.initial:
            return self._incumbent.move(self.initial, "migrate", costs)
        return self._incumbent.stay("hold", costs)
