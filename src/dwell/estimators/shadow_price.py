"""Shadow price: what sending shadows costs a candidate's own cycles, and which share that allows.

Where `shadow_fraction` is `auto`, every candidate gets the largest share of `SHARES` whose price
stays below `LEAST`, or below a part of Delta_min where that is more: shadows must not make a
placement look worse by what decides a move. The utilisation that shadows add is not in the price.
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

#: Shares below the largest one, which is `Problem.shadow_fraction`; then none.
SHARES = 0.02, 0.01, 0.005
#: Part of Delta_min that shadows may cost, and the J that they always may.
PART, LEAST = 0.2, 0.001
#: Cycles that a candidate is played for, with shadows and without.
CYCLES = 20_000


@dataclass(frozen=True, slots=True)
class ShadowPrice:
    """Price of sending shadows while a candidate is active.

    Parameters
    ----------
    fraction : float
        Share of the cycles that each alternative gets.
    l95_ms, violation_rate : float
        L95 and V_D with shadows, less those without.
    cost : float
        Their part of J.
    """

    fraction: float
    l95_ms: float
    violation_rate: float
    cost: float


def fraction_of(problem: Problem) -> ShadowFraction:
    """Return the share of the cycles that each alternative gets by ``problem.controller``.

    Returns
    -------
    float, or mapping of str to float
        By the active candidate where the share is `auto`.
    """
    if problem.controller.shadow_fraction != AUTO:
        return problem.shadow_fraction
    tried = shadow_prices(problem)
    return FrozenDict({name: affordable(problem, prices) for name, prices in tried.items()})


def affordable(problem: Problem, prices: Sequence[ShadowPrice]) -> float:
    """Return the largest share that costs little enough; 0 where none does."""
    most = max(PART * problem.controller.min_improvement, LEAST)
    return next((one.fraction for one in prices if one.cost < most), 0.0)


def shadow_prices(problem: Problem) -> Mapping[str, Sequence[ShadowPrice]]:
    """Return, by candidate, the price of each share from the largest to the first affordable one.

    With shadows and without, a candidate meets the same cycles. What has been played is kept (see
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
    """Return the price of a share: with shadows less without."""
    weights, targets = problem.objective.weights, problem.objective.targets
    l95_ms = paid.l95_ms - free.l95_ms
    violation_rate = paid.violation_rate - free.violation_rate
    cost = weights.latency * (l95_ms / targets.latency_ms) + weights.violations * violation_rate
    return ShadowPrice(fraction, l95_ms, violation_rate, cost)
