"""WorkFunction: the work-function algorithm for metrical task systems, one window late.

Borodin, Linial and Saks (J. ACM 39(4), 1992, DOI 10.1145/146585.146588) pose the problem and give
the bound; the algorithm is written here as in Chrobak and Larmore (LNCS 1442, 1998,
DOI 10.1007/BFb0029565). Its states are the candidates, its requests are windows, and its distance
is the price of a move, ``d(x, s) = weights.switching * hamming(x, s)``.

The work function w_k(s) is the least possible cost of windows 1 to k for a cell that knows them all
in advance, starts on the initial candidate, and ends on s::

    w_0(s) = d(initial, s)
    w_k(s) = min over x of  w_{k-1}(x) + r_k(x) + d(x, s)

where r_k(x) is J of window k under x, as estimated, without its switching term. The next candidate
is the s that minimises w_k(s) + d(s, incumbent) under the condition w_k(s) = w_{k-1}(s) + r_k(s):
the cheapest way to end on s spends window k on s.

How it is computed
    Both conditions together mean: s minimises w_{k-1}(s) + r_k(s) + d(s, incumbent). The minimum of
    that sum is w_k(incumbent) by definition, and by the triangle inequality no w_k(s) +
    d(s, incumbent) is below it. A window takes O(n^2) operations for n candidates. Each window
    subtracts the minimum of w_k, which keeps w_k in [0, weights.switching] in a run of any length;
    decisions depend only on differences.

Errors of estimates
    The cell moves to s only if w_{k-1} + r_k of the incumbent exceeds the sum above by more than
    the `dwell.cost.margin` of the two estimates. Since w_{k-1}(incumbent) - w_{k-1}(s) is never
    more than d(s, incumbent), a move needs a window in which s is cheaper by more than the margin,
    and persistent errors cannot accumulate into a move. If the incumbent is not eligible, the
    margin does not apply: caps take precedence over J. If estimates have no standard errors, the
    margin is 0. A decision that covers a share of a window uses the same share of the margin.

Not claimed
    The algorithm costs at most 2n - 1 times the optimum, plus a constant, if it sees a window's
    costs before it chooses where to spend that window, if the costs are exact, and if nothing
    stops it from moving. Here the costs are known only after the window, they are estimates, and
    caps and margins exclude candidates. **No bound holds**: an adversary can charge the incumbent
    any cost in every window, and the cell pays it in full. Measure the benefit on each cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import add

from dwell.cost import exceeds
from dwell.model.frozen import FrozenDict
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import PricingPolicy

#: Sums whose relative difference is at most this are a tie: w_k carries rounding errors.
TIE_TOLERANCE = 1e-9


class WorkFunction(PricingPolicy):
    """Moves once the optimum in hindsight justifies it, with neither threshold nor dwell.

    * A tie is a move, because an adversary charges a policy that stays when the optimum is
      indifferent. The earlier of several targets wins. A tie with candidates at distance 0 from the
      incumbent (the same placement, or ``weights.switching`` of 0) is a hold, because equal
      candidates would alternate for ever.
    * A candidate over a cap is not eligible, as in DTP. If no candidate is eligible, the candidates
      closest to their caps are compared as usual, and the reason is ``infeasible``. Caps restrict
      the choice but not the work function: r_k of every candidate enters w_k, and the chosen
      candidate minimises w_{k-1}(s) + r_k(s) + d(s, incumbent) over the eligible candidates.
    * w_k does not change in a window that the policy does not receive.

    Parameters
    ----------
    candidates, initial, objective
        As in `dwell.policies.DTP`.
    """

    by_price = True

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
    ) -> None:
        super().__init__(candidates=candidates, initial=initial, objective=objective)
        self._index = {name: i for i, name in enumerate(self.candidates)}
        #: Windows per decision.
        self._served = 1.0
        weight = objective.weights.switching
        self._distances = tuple(
            tuple(weight * moved for moved in self._pricing.switching(name).values())
            for name in self.candidates
        )

    def start(self, problem: Problem) -> None:
        """Reset the policy, and compute the share of a window per decision."""
        super().start(problem)
        self._served = 1 / problem.decisions_per_window

    @property
    def work(self) -> FrozenDict[str, float]:
        """w_k minus its minimum, by candidate, in units of J."""
        return FrozenDict(zip(self.candidates, self._work, strict=True))

    @property
    def _work(self) -> tuple[float, ...]:
        work: tuple[float, ...] | None = self._standing.memory
        return self._distances[self._index[self.initial]] if work is None else work

    def _adopted(self) -> object:
        """Keep w_k, which does not depend on the incumbent."""
        return self._standing.memory

    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, tuple[float, ...]]:
        """Add a window to the work function and choose by it; `observed` has no influence.

        `delta_j` is NaN: the rule compares sums over all windows, not J of one window.
        """
        estimates = self._known(estimates)
        now, pricing = self.incumbent, self._pricing
        costs = pricing.estimated(estimates, now)
        # From a candidate to itself: J without a switching term.
        served_by = (pricing.cost(estimates[name], name, name) for name in self.candidates)
        window = [cost * self._served for cost in served_by]
        served = list(map(add, self._work, window))
        # Subtract before adding distances: large costs would round w_k.
        least = min(served)
        reduced = [value - least for value in served]
        work = tuple(min(map(add, reduced, row)) for row in self._distances)
        eligible, within_caps = pricing.eligible(estimates)
        best = self._choose(served, eligible)
        if best == now or (now in eligible and self._unsure(best, served, estimates)):
            return self._stay("hold" if within_caps else "infeasible", costs), work
        reason = pricing.reason(best, costs, eligible, within_caps=within_caps)
        return self._move(best, reason, costs), work

    def _unsure(self, best: str, served: list[float], estimates: Mapping[str, QoS]) -> bool:
        """Return whether a move saves no more than this decision's share of the margin."""
        now = self.incumbent
        least = self._served * self._pricing.margin(estimates[best], estimates[now])
        here, there = self._index[now], self._index[best]
        saved = served[here] - served[there] - self._distances[here][there]
        # Without errors the margin is 0, and a tie moves.
        return least > 0 and not exceeds(saved, least)

    def _choose(self, served: list[float], eligible: list[str]) -> str:
        """Return the eligible candidate with the least ``served + distance``; ties move.

        Parameters
        ----------
        served : list of float
            w_{k-1} + r_k, in the candidates' order.
        eligible : list of str
            At least one, in the candidates' order.
        """
        now = self.incumbent
        distances = self._distances[self._index[now]]
        totals = {
            name: served[self._index[name]] + distances[self._index[name]] for name in eligible
        }
        slack = TIE_TOLERANCE * min(totals.values())
        bound = min(totals.values()) + slack
        ties = [name for name, total in totals.items() if total <= bound]
        if now in ties:
            # A distance within the slack counts as 0: equal candidates would alternate for ever.
            ties = [name for name in ties if distances[self._index[name]] > slack]
        return ties[0] if ties else now
