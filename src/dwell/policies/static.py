"""Static: the placement that never moves."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import NOT_PRICED, CandidatePolicy
from dwell.policies.pricing import Pricing, check_metrics


class Static(CandidatePolicy):
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
        super().__init__(candidates, initial)
        self.objective = objective
        self._pricing = None if objective is None else Pricing(self.candidates, objective)

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
