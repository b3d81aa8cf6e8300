"""WorkFunction: the work-function algorithm for metrical task systems, one window late.

Borodin, Linial and Saks (J. ACM 39(4), 1992, DOI 10.1145/146585.146588) pose the problem and give
the bound; the algorithm is written here as in Chrobak and Larmore (LNCS 1442, 1998,
DOI 10.1007/BFb0029565). Its states are the candidates, what it serves are windows, and its
distance is the price of a move, ``d(x, s) = weights.switching * hamming(x, s)``.

The work function w_k(s) is the least that windows 1 to k could have cost a cell that knew them all
in advance, began on the initial candidate, and ends on s::

    w_0(s) = d(initial, s)
    w_k(s) = min over x of  w_{k-1}(x) + r_k(x) + d(x, s)

where r_k(x) is J of window k under x, as estimated, without its switching term. The next candidate
is the s that minimises w_k(s) + d(s, incumbent) among those with w_k(s) = w_{k-1}(s) + r_k(s), that
is, among those that it would be best to have spent window k on in order to end there.

How it is computed
    Both conditions together say: s minimises w_{k-1}(s) + r_k(s) + d(s, incumbent). The minimum of
    that sum is w_k(incumbent) by definition, and by the triangle inequality no w_k(s) +
    d(s, incumbent) is below it. A window takes O(n^2) operations for n candidates. The minimum of
    w_k is subtracted in each window, so that w_k lies in [0, weights.switching] however long a run
    is; decisions depend on differences alone.

Errors of estimates
    The cell moves to s only where w_{k-1} + r_k of the incumbent exceeds the sum above by more than
    the `dwell.cost.margin` of the two estimates. Since w_{k-1}(incumbent) - w_{k-1}(s) is never
    more than d(s, incumbent), that takes a window in which s is cheaper by more than the margin,
    and errors that last add up to no move. An incumbent that is not eligible is left without it:
    there caps decide, not J. Where estimates say no errors, all is as above. A decision that serves
    a share of a window takes the same share of the margin.

What is not claimed
    The algorithm costs at most 2n - 1 times the optimum, plus a constant, if it sees a window's
    costs before it chooses where to spend that window, if the costs are exact, and if nothing
    stops it from moving. Here a window is over when its costs are seen, they are estimates, and
    caps and margins exclude candidates. **No bound holds**: costs that
    always strike the incumbent are paid in full every time, however large. What it is worth on a
    cell has to be measured.
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

    * A tie is a move: staying where the optimum would as soon have left is what an adversary
      charges for. Among several candidates to move to, their order decides. Only a tie with
      candidates at no distance from the incumbent (the same placement, or ``weights.switching``
      of 0) is a hold: such equals would take turns for ever.
    * A candidate over a cap is not eligible, as in DTP. If none is eligible, those closest to
      their caps are compared as usual, and the reason is ``infeasible``. Caps restrict where it
      goes, not what it remembers: r_k of a candidate over its caps enters w_k as it is, and the
      candidate chosen minimises w_{k-1}(s) + r_k(s) + d(s, incumbent) over the eligible ones.
    * A window that the policy is not shown leaves w_k as it is.

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
        #: Windows that a decision serves.
        self._served = 1.0
        weight = objective.weights.switching
        self._distances = tuple(
            tuple(weight * moved for moved in self._pricing.switching(name).values())
            for name in self.candidates
        )

    def start(self, problem: Problem) -> None:
        """Begin again; a decision serves its share of a window."""
        super().start(problem)
        self._served = 1 / problem.decisions_per_window

    @property
    def work(self) -> FrozenDict[str, float]:
        """w_k less its minimum, by candidate, in units of J."""
        return FrozenDict(zip(self.candidates, self._work, strict=True))

    @property
    def _work(self) -> tuple[float, ...]:
        work: tuple[float, ...] | None = self._standing.memory
        return self._distances[self._index[self.initial]] if work is None else work

    def _adopted(self) -> object:
        """Keep w_k: it is about what was possible, not about where the cell was."""
        return self._standing.memory

    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, tuple[float, ...]]:
        """Add a window to the work function, which is remembered, and choose by it.

        Nothing is decided by what was observed. `delta_j` is NaN: the rule compares sums over all
        windows, not J of one.
        """
        estimates = self._known(estimates)
        now, pricing = self.incumbent, self._pricing
        costs = pricing.estimated(estimates, now)
        # From a candidate to itself: J of a window that no move preceded.
        served_by = (pricing.cost(estimates[name], name, name) for name in self.candidates)
        window = [cost * self._served for cost in served_by]
        served = list(map(add, self._work, window))
        # Subtracted before distances are added: large costs then round off nothing of w_k.
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
        """Whether a move saves no more in the sums than the margin of this decision's share."""
        now = self.incumbent
        least = self._served * self._pricing.margin(estimates[best], estimates[now])
        here, there = self._index[now], self._index[best]
        saved = served[here] - served[there] - self._distances[here][there]
        # Without errors a tie is a move.
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
            # A distance within the slack counts as none: equals would take turns for ever.
            ties = [name for name in ties if distances[self._index[name]] > slack]
        return ties[0] if ties else now
