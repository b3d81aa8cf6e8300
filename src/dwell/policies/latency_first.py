"""LatencyFirst: always the candidate with the lowest estimated L95."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import NOT_PRICED, CandidatePolicy
from dwell.policies.pricing import Pricing, check_metrics, explain_estimate


class LatencyFirst(CandidatePolicy):
    """Moves to the lowest estimated L95 in every window, with neither hysteresis nor dwell.

    This is latency-driven service selection, what FogROS2-LS (Chen et al., ICRA 2024) does among
    replicated deployments of a service: it knows no deadline, no utilisation, no caps and no price
    of a move. Ties go to the incumbent, then to the order of the candidates.

    Parameters
    ----------
    candidates : mapping of str to Placement
    initial : str, optional
        The candidate it starts on; the first where None.
    objective : Objective, optional
        Where given, J of every candidate is recorded; it decides nothing.

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

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the policy with the parameters of ``problem.controller``."""
        return cls(
            candidates=problem.candidates,
            initial=problem.initial,
            objective=problem.objective,
        )

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Decision:
        """Choose the candidate with the lowest estimated L95.

        Raises
        ------
        MetricError
            If `observed` is no QoS, or an estimate is missing.
        """
        check_metrics(observed, "observed")
        incumbent = self._incumbent
        name = incumbent.name
        try:
            best, lowest = name, estimates[name].l95_ms
            for name in self.candidates:
                latency = estimates[name].l95_ms
                if latency < lowest:
                    best, lowest = name, latency
        except (AttributeError, KeyError, TypeError):
            explain_estimate(estimates, name, self.candidates)
            raise
        costs = NOT_PRICED
        if self._pricing is not None:
            costs = self._pricing.estimated(estimates, incumbent.name)
        if best == incumbent.name:
            return incumbent.stay("hold", costs)
        return incumbent.move(best, "migrate", costs)
