"""Cost of shadow jobs to a candidate's own cycles, and the largest affordable share of cycles.

If `shadow_fraction` is `auto`, every candidate gets the largest share with a cost below `LEAST` or
below `PART` of Delta_min, the larger of the two: shadows must not make a placement look worse by
enough to decide a move. The cost excludes the utilisation of the shadow jobs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dwell.estimators.prices import Price, prices_of
from dwell.estimators.sent_shadows import hindered
from dwell.model.controller_settings import AUTO
from dwell.model.frozen import FrozenDict
from dwell.model.problem import Problem
from dwell.model.shadow_plan import ShadowFraction

#: Shares to try after `Problem.shadow_fraction`, the largest; if none is affordable, 0.
SHARES = 0.02, 0.01, 0.005
#: Part of Delta_min that shadows may cost; cost in J that is always allowed.
PART, LEAST = 0.2, 0.001
#: Simulated cycles of a candidate, with shadows and without.
CYCLES = 20_000


@dataclass(frozen=True, slots=True)
class ShadowPrice:
    """Price of sending shadows while a candidate is active."""

    #: Share of the cycles that each alternative gets.
    fraction: float
    #: L95 with shadows minus L95 without.
    l95_ms: float
    #: V_D with shadows minus V_D without.
    violation_rate: float
    #: Effect of both differences on J.
    cost: float


def fraction_of(problem: Problem) -> ShadowFraction:
    """Return the share of the cycles that each alternative gets by ``problem.controller``.

    If the setting is `auto`, the result is the share by active candidate.
    """
    if problem.controller.shadow_fraction != AUTO:
        return problem.shadow_fraction
    tried = shadow_prices(problem)
    return FrozenDict({name: affordable(problem, prices) for name, prices in tried.items()})


def affordable(problem: Problem, prices: Sequence[ShadowPrice]) -> float:
    """Return the largest affordable share; 0 if all shares cost too much."""
    most = max(PART * problem.controller.min_improvement, LEAST)
    return next((one.fraction for one in prices if one.cost < most), 0.0)


def shadow_prices(problem: Problem) -> Mapping[str, Sequence[ShadowPrice]]:
    """Return, by candidate, the price of each share from the largest to the first affordable one.

    The realisation is the same with and without shadows. Results of simulations are kept (see
    `dwell.estimators.prices`).
    """
    most = problem.shadow_fraction
    tried = {
        name: [] if name in hindered(problem) else [ShadowPrice(most, 0.0, 0.0, 0.0)]
        for name in problem.candidates
    }
    for fraction in (most, *(share for share in SHARES if share < most)):
        left = [name for name, prices in tried.items() if not affordable(problem, prices)]
        if not left:
            break
        sent = {name: fraction if name in left else 0.0 for name in tried}
        alone = prices_of(problem, cycles=CYCLES)
        together = prices_of(problem, cycles=CYCLES, shadow_fraction=sent)
        for name in left:
            tried[name].append(_difference(problem, fraction, together[name], alone[name]))
    return tried


def _difference(problem: Problem, fraction: float, paid: Price, free: Price) -> ShadowPrice:
    """Return the price of a share: the difference between prices with and without shadows."""
    weights, targets = problem.objective.weights, problem.objective.targets
    l95_ms = paid.l95_ms - free.l95_ms
    violation_rate = paid.violation_rate - free.violation_rate
    cost = weights.latency * (l95_ms / targets.latency_ms) + weights.violations * violation_rate
    return ShadowPrice(fraction, l95_ms, violation_rate, cost)
