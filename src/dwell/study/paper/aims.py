"""The aim of an adaptive policy, scenario by scenario, and what it is missed by.

In every dynamic scenario, with a real estimator paid for,

* the cost is at most 10 % over the reference in hindsight;
* V_D is under 5 % wherever the reference's is;
* there are no more migrations than DTP's.

A criterion is met, or missed, only where the interval over seeds says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.study.comparison import AIM
from dwell.study.intervals import Interval, mean_interval, share_interval, under
from dwell.study.paper.contrasts import interval, values
from dwell.study.reference import CLAIRVOYANT, CLAIRVOYANT_DWELL

if TYPE_CHECKING:
    import polars as pl

__all__ = [
    "OVER_REFERENCE",
    "Aim",
    "Parts",
    "Said",
    "best_static_regret",
    "judge",
    "parts_of",
    "reference_rates",
]

Floats: TypeAlias = NDArray[np.float64]
Said: TypeAlias = Literal["met", "missed", "not shown", "not asked"]

#: What a policy may cost beyond the reference.
OVER_REFERENCE = 0.10


@dataclass(frozen=True, slots=True)
class Aim:
    """How a policy stands to the aim in a scenario.

    Parameters
    ----------
    regret : Interval
        Cost over the reference, as a share.
    rate : Interval
        V_D.
    reference_rate : Interval
        V_D of the reference.
    more_moves : mapping of str to Interval
        Migrations less those of each DTP, by its name.
    cost_said, rate_said, moves_said : {"met", "missed", "not shown", "not asked"}
        ``not asked``: the reference is not shown to be under 5 %, or there is no DTP to compare to.
    """

    regret: Interval
    rate: Interval
    reference_rate: Interval
    more_moves: Mapping[str, Interval]
    cost_said: Said
    rate_said: Said
    moves_said: Said

    @property
    def said(self) -> tuple[Said, Said, Said]:
        """Cost, V_D, migrations."""
        return self.cost_said, self.rate_said, self.moves_said

    @property
    def reached(self) -> bool:
        """Whether all that is asked is met."""
        return all(one in ("met", "not asked") for one in self.said)

    @property
    def missed(self) -> bool:
        """Whether something is shown to be missed."""
        return "missed" in self.said


@dataclass(frozen=True, slots=True)
class Parts:
    """What regret is made of.

    Parameters
    ----------
    rule : Interval
        Regret of the same rule that is told one window late what every candidate cost.
    estimate : Interval
        What the real estimator adds to it, seed by seed; negative where it does better.
    """

    rule: Interval
    estimate: Interval

    @property
    def larger(self) -> str:
        """Which of them costs more."""
        return "rule and lag" if self.rule.value >= self.estimate.value else "estimate"


def judge(
    runs: pl.DataFrame, scenario: str, name: str, *, candidates: Sequence[str], dtp: Sequence[str]
) -> Aim:
    """Hold a policy against the aim in a scenario.

    Parameters
    ----------
    runs : DataFrame
        With references.
    scenario, name : str
        The policy's.
    candidates : sequence of str
        Policies that never move; the reference may be one of them.
    dtp : sequence of str
        Policies than which it shall not migrate more; itself left out.
    """
    mine = {"scenario": scenario, "policy": name}
    regret = interval(runs, "regret", mine)
    rates = values(runs, "violation_rate", mine)
    reference = reference_rates(runs, scenario, candidates)
    moves = values(runs, "migrations", mine)
    more = {
        other: mean_interval(
            moves - values(runs, "migrations", {"scenario": scenario, "policy": other})
        )
        for other in dtp
        if other != name
    }
    asked = under(reference, AIM) == "under"
    return Aim(
        regret=regret,
        rate=interval(runs, "violation_rate", mine),
        reference_rate=share_interval(reference),
        more_moves=more,
        cost_said=_at_most(regret, OVER_REFERENCE),
        rate_said=_under(rates) if asked else "not asked",
        moves_said=_none_more(list(more.values())),
    )


def parts_of(runs: pl.DataFrame, scenario: str, name: str, hindsight: str) -> Parts:
    """Part regret into what the rule makes of it and what the estimate does.

    Parameters
    ----------
    runs : DataFrame
    scenario, name : str
    hindsight : str
        The same policy told one window late what every candidate cost.
    """
    mine, told = (
        values(runs, "regret", {"scenario": scenario, "policy": policy})
        for policy in (name, hindsight)
    )
    return Parts(mean_interval(told), mean_interval(mine - told))


def reference_rates(runs: pl.DataFrame, scenario: str, candidates: Sequence[str]) -> Floats:
    """V_D of the reference, one a seed: of the cheapest candidate or clairvoyant sequence."""
    names = (*candidates, CLAIRVOYANT, CLAIRVOYANT_DWELL)
    costs, rates = (
        np.stack([values(runs, column, {"scenario": scenario, "policy": name}) for name in names])
        for column in ("cost", "violation_rate")
    )
    cheapest = costs.argmin(axis=0)
    found: Floats = rates[cheapest, np.arange(rates.shape[1])]
    return found


def best_static_regret(runs: pl.DataFrame, scenario: str, candidates: Sequence[str]) -> Floats:
    """Regret of the best static placement in hindsight, one a seed."""
    regrets = [
        values(runs, "regret", {"scenario": scenario, "policy": name}) for name in candidates
    ]
    found: Floats = np.min(regrets, axis=0)
    return found


def _at_most(known: Interval, bound: float) -> Said:
    if known.high <= bound:
        return "met"
    return "missed" if known.low > bound else "not shown"


def _under(rates: Floats) -> Said:
    said = under(rates, AIM)
    return "met" if said == "under" else "missed" if said == "over" else "not shown"


def _none_more(more: Sequence[Interval]) -> Said:
    if not more:
        return "not asked"
    if any(one.low > 0 for one in more):
        return "missed"
    known = not any(math.isnan(one.high) for one in more)
    return "met" if known and all(one.high <= 0 for one in more) else "not shown"
