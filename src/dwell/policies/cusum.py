"""CUSUM: moves when the cumulative advantage of another candidate exceeds a threshold.

A single window is weak evidence of a small difference of J and strong evidence of a large one.
Instead of a threshold on one window's difference and a minimum dwell, each candidate s has a
cumulative sum of its savings, as in Page's test for a change of the mean (Biometrika 41, 1954,
DOI 10.1093/biomet/41.1-2.100)::

    g(s) < -max(0, memory * g(s) + J(incumbent) - J(s) - slack - margin(s))

J comes from the estimates, with switching terms against the incumbent, so the incumbent's own term
is 0. margin(s) is the `dwell.cost.margin` of the two estimates, 0 if they have no standard errors.
Consecutive estimates share samples, so their errors persist; every window subtracts the margin, and
errors do not accumulate. If an eligible g(s) exceeds the threshold, the cheapest such candidate
becomes the incumbent, provided that it is also cheaper in this window, and all sums restart at 0.

An advantage above ``threshold + slack + margin`` moves the cell at once, even just after a move. An
advantage below ``slack + margin + (1 - memory) * threshold`` never moves it, however long it lasts.
The advantage bounds the number of migrations, without a minimum dwell. Between two
migrations, the positive parts of advantage - slack - margin of the second migration's target add up
to more than the threshold. With A the sum over all windows of the largest such part, a run
therefore has fewer than A / threshold migrations.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Self

from dwell.cost import exceeds
from dwell.model.bounds import MIN_IMPROVEMENT, Bound
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.qos import Decision, QoS, Reason
from dwell.policies.dtp import cheapest
from dwell.policies.incumbent import PricingPolicy, check_parameter

if TYPE_CHECKING:
    from dwell.model import Problem


class Cusum(PricingPolicy):
    """Moves to the cheapest candidate whose cumulative advantage exceeds the threshold.

    A candidate over a cap is not eligible, as in DTP, and the reasons are the same; if none is
    eligible, the candidates closest to their caps are compared. Sums of candidates over a cap
    continue to grow and shrink.

    Parameters
    ----------
    candidates, initial, objective
        As in `dwell.policies.DTP`.
    threshold : float
        Cumulative advantage that a move must exceed, in units of J. `from_problem` takes the
        default times d/W: each of the W/d decisions of a window adds its whole gain.
    slack : float
        Part of each window's advantage that is subtracted in addition to the margin, in units of
        J.
    memory : float
        Share of a sum that outlives a window, in (0, 1].

    Raises
    ------
    PolicyError
        If a parameter is out of its range, `initial` is no candidate, or candidates place
        different tasks.
    """

    by_price = True

    SETTINGS = MappingProxyType({"slack": "min_improvement"})

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
        threshold: float = 0.4,
        slack: float = 0.05,
        memory: float = 1.0,
    ) -> None:
        super().__init__(candidates=candidates, initial=initial, objective=objective)
        self.threshold = check_parameter("threshold", threshold, MIN_IMPROVEMENT)
        self.slack = check_parameter("slack", slack, MIN_IMPROVEMENT)
        self.memory = check_parameter("memory", memory, Bound(0, 1, above=True))

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the policy with the parameters of ``problem.controller``."""
        policy = super().from_problem(problem)
        policy.threshold *= problem.decide_cycles / problem.window_cycles
        return policy

    def __repr__(self) -> str:
        return (
            f"Cusum(initial={self.initial!r}, threshold={self.threshold:g}, "
            f"slack={self.slack:g}, memory={self.memory:g})"
        )

    @property
    def sums(self) -> Mapping[str, float]:
        """G of every candidate; the incumbent's is 0."""
        return dict(zip(self.candidates, self._standing.memory, strict=True))

    def _blank(self) -> tuple[float, ...]:
        return (0.0,) * len(self.candidates)

    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, tuple[float, ...]]:
        """Add a window to the sums and compare them with the threshold.

        `delta_j` is this window's advantage of the cheapest candidate whose sum exceeds the
        threshold, 0 if no sum does.
        """
        estimates = self._known(estimates)
        now, pricing = self.incumbent, self._pricing
        costs = pricing.estimated(estimates, now)
        stays, known = costs[now], estimates[now]
        eligible, within_caps = pricing.eligible(estimates)
        sums = {}
        for name, value in zip(self.candidates, self._standing.memory, strict=True):
            least = self.slack + pricing.margin(estimates[name], known)
            gain = stays - costs[name] - least
            sums[name] = 0.0 if name == now else max(0.0, self.memory * value + gain)
        due = [name for name in eligible if exceeds(sums[name], self.threshold)]
        delta_j = 0.0
        if due:
            best = cheapest(costs, due, now)
            delta_j = stays - costs[best]
        if not exceeds(delta_j, 0.0):
            reason: Reason = "hold" if within_caps else "infeasible"
            return self._stay(reason, costs, delta_j), tuple(sums.values())
        reason = pricing.reason(best, costs, eligible, within_caps=within_caps)
        return self._move(best, reason, costs, delta_j), self._blank()
