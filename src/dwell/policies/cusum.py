"""CUSUM: moves once the advantage of another candidate has added up to enough.

A single window says little about a small difference of J and much about a large one. Instead of a
threshold on one window's difference and a minimum dwell, each candidate s has a cumulative sum of
what it would have saved, as in Page's test for a change of the mean (Biometrika 41, 1954,
DOI 10.1093/biomet/41.1-2.100)::

    g(s) < -max(0, memory * g(s) + J(incumbent) - J(s) - slack - margin(s))

J is that of the estimates, against the incumbent, whose own switching term is therefore 0;
margin(s) is the `dwell.cost.margin` of the two, 0 where estimates say no errors. An error stays as
long as the samples behind it, so that it must not add up: it is taken off in every window. If any
eligible g(s) exceeds the threshold, the cheapest of those candidates becomes the incumbent, if it
is cheaper in this window too, and all sums begin again at 0.

An advantage above ``threshold + slack + margin`` moves the cell at once, whatever the last move's
date; one below ``slack + margin + (1 - memory) * threshold`` never does, however long it lasts.
There is no minimum dwell: what bounds migrations is what they are worth. Before each of them, and
after the one before it, the advantages of the candidate it goes to, each less slack and margin
where that is above 0, have added up to more than the threshold. So, with A the sum over all windows
of the largest such advantage, there are fewer than A / threshold migrations.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from dwell.cost import exceeds
from dwell.model.bounds import MIN_IMPROVEMENT, Bound
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.qos import Decision, QoS, Reason
from dwell.policies.dtp import cheapest
from dwell.policies.incumbent import PricingPolicy, check_parameter


class Cusum(PricingPolicy):
    """Moves to the cheapest candidate whose advantage over the incumbent has added up.

    A candidate over a cap is not eligible, as in DTP, and the reasons are the same; if none is
    eligible, those closest to their caps are compared. Sums of candidates over a cap go on.

    Parameters
    ----------
    candidates, initial, objective
        As in `dwell.policies.DTP`.
    threshold : float
        Sum that an advantage must exceed, in units of J.
    slack : float
        Advantage of a window, beside the margin of the estimates, that counts as none, in units of
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
        """Add a window to the sums, which are remembered, and compare them with the threshold.

        `delta_j` is the advantage of this window over the cheapest candidate whose sum is over the
        threshold, 0 where there is none.
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
