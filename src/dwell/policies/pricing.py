"""J and the caps for a fixed set of candidates.

The formulas are in `dwell.cost`. This module looks up the nodes of each tier and compares
placements once instead of in every window.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import itemgetter
from typing import NoReturn

from dwell.cost import (
    TierUtilisation,
    busiest,
    cost_error,
    excess,
    hamming,
    margin,
    margin_errors,
    price,
    tier_nodes,
    weighed,
)
from dwell.errors import MetricError, PolicyError
from dwell.model.frozen import FrozenDict
from dwell.model.objective import MISSES_SHARE, Objective
from dwell.model.placement import Placement
from dwell.model.qos import QoS, Reason

INFINITY = math.inf

#: Candidates within this distance of the least relative excess are compared by J.
EXCESS_TOLERANCE = 1e-6


def check_metrics(qos: object, whose: str) -> QoS:
    """Return `qos`, or raise MetricError if it is anything but a QoS."""
    if not isinstance(qos, QoS):
        raise MetricError(f"{whose} is {qos!r}; it must be a QoS")
    return qos


def explain_estimate(estimates: object, name: str, candidates: Mapping[str, Placement]) -> None:
    """Raise MetricError if `estimates` holds no QoS for candidate `name` (off the fast path)."""
    if not isinstance(estimates, Mapping):
        raise MetricError(f"estimates is {estimates!r}; it must map every candidate to a QoS")
    if name not in estimates:
        given = ", ".join(map(str, estimates)) or "none"
        raise MetricError(
            f"estimates has nothing for candidate {name} (given: {given}); "
            f"it must hold a QoS for each of {', '.join(candidates)}"
        )
    check_metrics(estimates[name], f"the estimate of {name}")


def _shares(
    names: tuple[str, ...], accelerators: Collection[str]
) -> Callable[[Mapping[str, float]], tuple[float, ...]]:
    """Return the function that looks up the utilisation of a tier: a tuple, never empty."""
    nodes = tuple(name for name in names if name not in accelerators)
    if len(nodes) < len(names):
        # The metrics of a window may lack accelerators.
        rest = names[len(nodes) :]
        return lambda used: (
            0.0,
            *[used[name] for name in nodes],
            *[used[name] for name in rest if name in used],
        )
    if not nodes:
        return lambda utilisation: (0.0,)
    # Given one key alone, itemgetter would return a bare value.
    return itemgetter(*nodes, nodes[0]) if len(nodes) == 1 else itemgetter(*nodes)


class Pricing:
    """Prices the candidates of one policy."""

    def __init__(self, candidates: Mapping[str, Placement], objective: Objective) -> None:
        if not isinstance(objective, Objective):
            raise PolicyError(f"objective is {objective!r}; it must be an Objective")
        self.candidates = candidates
        self.objective = objective
        self._weighs = objective.weighs_age or objective.weighs_price
        nodes = tier_nodes(objective)
        of = objective.accelerators
        self._robot, self._edge = _shares(nodes.robot, of), _shares(nodes.edge, of)
        self._cloud = _shares(nodes.cloud, of) if nodes.cloud else None
        # Hamming distances by incumbent, computed at its first use: usually few of the n candidates
        # become the incumbent, and n * n comparisons would be wasted.
        self._rows: dict[str, dict[str, float]] = {}

    def switching(self, previous: str) -> Mapping[str, float]:
        """Return S of every candidate, with `previous` as the placement before it."""
        row = self._rows.get(previous)
        if row is None:
            before = self.candidates[previous]
            row = {name: hamming(placed, before) for name, placed in self.candidates.items()}
            self._rows[previous] = row
        return row

    def used(self, qos: QoS) -> TierUtilisation:
        """Return U_r, U_e and U_c of a window; raise MetricError if a metric is missing."""
        try:
            used = qos.utilisation
            cloud = 0.0 if self._cloud is None else max(self._cloud(used))
            return TierUtilisation(max(self._robot(used)), max(self._edge(used)), cloud)
        except (AttributeError, KeyError, TypeError):
            self._explain(qos, "observed")

    def cost(self, qos: QoS, current: str, previous: str) -> float:
        """Return J of a window under `current` after `previous`.

        Raises MetricError if a metric is missing, or J is not finite.
        """
        try:
            value = self._price(qos, self.switching(previous)[current])
        except (AttributeError, KeyError, TypeError):
            self._explain(qos, f"the window of {current}")
        if not value < INFINITY:
            self._explain(qos, f"the window of {current}")
        return value

    def estimated(self, estimates: Mapping[str, QoS], incumbent: str) -> FrozenDict[str, float]:
        """Return J of every candidate against the incumbent, in the candidates' order.

        Raises MetricError if a candidate or one of its metrics is missing, or a J is not finite.
        """
        costs = {}
        name = ""
        try:
            for name, switching in self.switching(incumbent).items():
                costs[name] = self._price(estimates[name], switching)
        except (AttributeError, KeyError, TypeError):
            explain_estimate(estimates, name, self.candidates)
            self._explain(estimates[name], f"the estimate of {name}")
        if not sum(costs.values()) < INFINITY:
            name = max(costs, key=costs.__getitem__)
            self._explain(estimates[name], f"the estimate of {name}")
        return FrozenDict(costs)

    def margin(self, one: QoS, other: QoS) -> float:
        """Return the least difference in J of two estimates that exceeds their error."""
        if one.error is None and other.error is None:
            return 0.0
        errors = (margin_errors(qos, len(self.candidates)) for qos in (one, other))
        return margin(*(cost_error((l95, rate), self.objective, age) for l95, rate, age in errors))

    def eligible(self, estimates: Mapping[str, QoS]) -> tuple[list[str], bool]:
        """Return the candidates to choose from, and whether they respect the caps.

        If no candidate respects them, return the candidates whose largest relative excess is within
        `EXCESS_TOLERANCE` of the least. Otherwise a saturated robot, over its cap in every
        placement, would block the policy.
        """
        caps = self.objective.caps
        latency_ms, utilisation = caps.latency_ms, caps.utilisation
        share = math.inf if caps.misses is None else MISSES_SHARE
        within = []
        for name in self.candidates:
            qos = estimates[name]
            known = qos.misses is None or qos.misses <= share
            if known and qos.uncut_l95_ms <= latency_ms and busiest(qos) <= utilisation:
                within.append(name)
        if within:
            return within, True
        excesses = {name: excess(estimates[name], self.objective) for name in self.candidates}
        bound = min(excesses.values()) + EXCESS_TOLERANCE
        return [name for name, value in excesses.items() if value <= bound], False

    def reason(
        self, best: str, costs: Mapping[str, float], eligible: Sequence[str], *, within_caps: bool
    ) -> Reason:
        """Return the reason of a move to `best`, from the two results of `eligible`."""
        if not within_caps:
            return "infeasible"
        cheaper = [name for name, value in costs.items() if value < costs[best]]
        return "migrate" if set(cheaper) <= set(eligible) else "capped"

    def _price(self, qos: QoS, switching: float) -> float:
        used = qos.utilisation
        return price(
            qos.l95_ms,
            qos.violation_rate,
            max(self._robot(used)),
            max(self._edge(used)),
            0.0 if self._cloud is None else max(self._cloud(used)),
            switching,
            self.objective,
            *(weighed(qos, self.objective) if self._weighs else (0.0, 0.0)),
        )

    def _explain(self, qos: object, whose: str) -> NoReturn:
        """Raise the MetricError of metrics that could not be priced (off the fast path)."""
        metrics = check_metrics(qos, whose)
        for node in self.objective.tiers:
            if node not in metrics.utilisation:
                known = ", ".join(metrics.utilisation) or "none"
                raise MetricError(
                    f"{whose} has no utilisation of {node} (nodes given: {known}); "
                    "J needs it for every node of objective.tiers"
                )
        raise MetricError(f"{whose}, {metrics}, has no finite J; a metric is too large")
