"""DTP: window-based dynamic task placement (paper, Algorithm 1).

Window k ran under the incumbent, placement k - 1. The lines of the algorithm, with its corner
cases decided:

* J of the incumbent comes from its entry in the estimates, with the switching term of its own last
  decision (placement k - 1 against k - 2). J of every candidate, the incumbent included, comes from
  its entry against the incumbent. The incumbent's entry is what was measured, as in the paper,
  unless the estimator learns: both sides of Delta J are then its predictions.
* Delta J must exceed Delta_min and the `dwell.cost.margin` of the two estimates, which is 0 where
  they say no errors, by more than `dwell.cost.GAIN_TOLERANCE`.
* n_d counts decisions since the last migration and blocks while n_d < N_min. Two migrations are
  therefore at least N_min + 1 decisions apart, and K decisions hold at most
  floor(K / (N_min + 1)) of them, whatever the metrics do.
* The minimum goes to the incumbent on a tie, then to the order of the candidates. If it is the
  incumbent, the window is a hold whatever Delta J says, and n_d grows.
* A candidate over a cap is not eligible; where a cheaper one was left out for that, the reason of
  a move is ``capped``. If none is eligible, those closest to their caps are compared by J as
  usual, and the reason is ``infeasible``; the hysteresis still applies.

``escape`` is an addition to the algorithm, off by default: an incumbent that was seen over a cap
moves to the cheapest candidate within its caps, if there is one, whatever n_d and Delta J say. The
bounds on migrations do not hold then.
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
        pi_0; the first candidate where None.
    objective : Objective
        Weights, targets, caps and tiers of J.
    min_dwell : int
        N_min, calls of `decide`; 0 lets every call migrate. `from_problem` turns the cell's windows
        into calls.
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
        """One pass of the loop of Algorithm 1, which does without estimates in a dwell window."""
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
        """J of the incumbent, with the switching term of its own last decision."""
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
        Wins every tie, where it is eligible.
    """
    best, lowest = "", float("inf")
    for name in eligible:
        value = costs[name]
        if value < lowest or (name == incumbent and value == lowest):
            best, lowest = name, value
    return best
