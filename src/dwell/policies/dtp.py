"""DTP: window-based dynamic task placement (paper, Algorithm 1).

Window k ran under the incumbent, placement k - 1. The lines of the algorithm, with its corner
cases decided:

* J of staying uses the incumbent's estimate and the switching term of its own last decision
  (placement k - 1 against k - 2). J of every candidate, including the incumbent, uses the
  candidate's estimate and its switching term against the incumbent. The incumbent's estimate equals
  its measurement, as in the paper, unless the estimator learns: both sides of Delta J are then
  predictions.
* Delta J must exceed the sum of Delta_min and the `dwell.cost.margin` of the two estimates by more
  than `dwell.cost.GAIN_TOLERANCE`. The margin is 0 if the estimates have no standard errors.
* n_d counts decisions since the last migration; no migration happens while n_d < N_min. Two
  migrations are therefore at least N_min + 1 decisions apart, and K decisions contain at most
  floor(K / (N_min + 1)) migrations, for any metrics.
* On a tie the incumbent wins, then the earlier candidate. If the incumbent is the minimum, the
  decision is a hold for any Delta J, and n_d grows.
* A candidate over a cap is not eligible. If this excludes a cheaper candidate, the reason of the
  move is ``capped``. If no candidate is eligible, the candidates closest to their caps are compared
  by J as usual, and the reason is ``infeasible``; the hysteresis still applies.

``escape`` is an addition to the algorithm, off by default: if the incumbent was observed over a cap
and another candidate is within its caps, the cell moves to the cheapest such candidate, regardless
of n_d and Delta J. The bounds on migrations do not apply to these moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Self

from dwell.cost import exceeds, excess
from dwell.errors import MetricError
from dwell.model.bounds import MIN_DWELL, MIN_IMPROVEMENT
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import PricingPolicy, check_parameter


class DTP(PricingPolicy):
    """Moves to the cheapest candidate once it is cheap enough and the dwell is over.

    Parameters
    ----------
    candidates : mapping of str to Placement
        Pi_cand, over the same tasks; the order breaks ties.
    initial : str, optional
        pi_0; the first candidate if None.
    objective : Objective
        Weights, targets, caps and tiers of J.
    min_dwell : int
        N_min, in calls of `decide`; 0 lets every call migrate. `from_problem` converts the cell's
        windows to calls.
    min_improvement : float
        Delta_min, in units of J: an improvement must exceed it, and the margin of the estimates.
    escape : bool
        Whether an incumbent over a cap may leave before the hysteresis is met.

    Raises
    ------
    PolicyError
        If a parameter is out of its range, `initial` is no candidate, or candidates place
        different tasks.
    """

    by_price = True

    SETTINGS = MappingProxyType({"min_improvement": "min_improvement", "escape": "escape"})

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
        min_dwell: int = 3,
        min_improvement: float = 0.05,
        escape: bool = False,
    ) -> None:
        super().__init__(candidates=candidates, initial=initial, objective=objective)
        self.min_dwell = check_parameter("min_dwell", min_dwell, MIN_DWELL)
        self.min_improvement = check_parameter("min_improvement", min_improvement, MIN_IMPROVEMENT)
        self.escape = escape

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the policy with the parameters of ``problem.controller``."""
        policy = super().from_problem(problem)
        policy.min_dwell = problem.min_dwell_decisions
        return policy

    def __repr__(self) -> str:
        return (
            f"DTP(initial={self.initial!r}, min_dwell={self.min_dwell}, "
            f"min_improvement={self.min_improvement:g}{', escape=True' if self.escape else ''})"
        )

    def _decide(self, observed: QoS, estimates: Mapping[str, QoS] | None) -> tuple[Decision, None]:
        """Run one pass of Algorithm 1's loop; a dwell window needs no estimates."""
        now, dwell, pricing = self.incumbent, self._standing.dwell, self._pricing
        costs = self._costs(estimates)
        if self.escape and estimates is not None and excess(observed, self.objective) > 0:
            eligible, within_caps = pricing.eligible({**estimates, now: observed})
            if within_caps:
                best = cheapest(costs, eligible, now)
                reason = pricing.reason(best, costs, eligible, within_caps=True)
                return self._move(best, reason, costs, self._stays(estimates) - costs[best]), None
        if dwell < self.min_dwell:
            return self._stay("dwell", costs), None
        if estimates is None:
            raise MetricError(
                f"estimates is None after the dwell (n_d = {dwell}, min_dwell = "
                f"{self.min_dwell}); give one for each of {', '.join(self.candidates)}"
            )
        eligible, within_caps = pricing.eligible(estimates)
        best = cheapest(costs, eligible, now)
        delta_j = self._stays(estimates) - costs[best]
        least = self.min_improvement + pricing.margin(estimates[best], estimates[now])
        if best != now and exceeds(delta_j, least):
            reason = pricing.reason(best, costs, eligible, within_caps=within_caps)
            return self._move(best, reason, costs, delta_j), None
        return self._stay("hold" if within_caps else "infeasible", costs, delta_j), None

    def _stays(self, estimates: Mapping[str, QoS]) -> float:
        """Return J of the incumbent, with the switching term of its own last decision."""
        name = self.incumbent
        return self._pricing.cost(estimates[name], name, self._standing.previous)


def cheapest(costs: Mapping[str, float], eligible: Iterable[str], incumbent: str) -> str:
    """Return the eligible candidate with the lowest J.

    Parameters
    ----------
    costs : mapping of str to float
        J by candidate.
    eligible : iterable of str
        At least one, in the order that breaks ties.
    incumbent : str
        Wins every tie, if it is eligible.
    """
    best, lowest = "", float("inf")
    for name in eligible:
        value = costs[name]
        if value < lowest or (name == incumbent and value == lowest):
            best, lowest = name, value
    return best
