"""Replicate: adds a second copy of each cycle to the placement that another policy chooses.

A *base* policy decides among the candidates with one copy: it sees their estimates alone, and its
incumbent X is one of them. A candidate with replicas, one of them X, is a *pair* of X. In
every decision, after the base's, the cheapest pair P of X is compared with X:

* P replaces X, or X replaces P, if it is cheaper by more than Delta_min and the margin of the two
  estimates (`dwell.cost.margin`). J includes the switching term of the move.
* If at least `LATE` of the cycles miss although two copies run, both copies are late. Then P does
  not come into force, and a P in force leaves it, whatever its J.
* P comes into force, leaves it, or follows another pair of X only if N_min windows have passed
  since the last move of the cell. Moves of the base have its own rules. P stays in force over a
  move of the base from one of its members to the other.

A pair over a cap is not eligible, as in DTP. Without a pair of X the base decides alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Self

from dwell.cost import exceeds
from dwell.errors import PolicyError
from dwell.model.bounds import MIN_DWELL, MIN_IMPROVEMENT
from dwell.model.controller_settings import REPLICATE
from dwell.model.objective import Objective
from dwell.model.placement import Placement, Replicas, plain_candidates
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.dtp import DTP, cheapest
from dwell.policies.incumbent import PricingPolicy, Standing, check_name, check_parameter
from dwell.policies.protocol import MinimalPolicy
from dwell.policies.registry import by_name
from dwell.policies.user_policy import as_proposer

#: Share of missed cycles of a pair from which both copies are late.
LATE = 0.95


class _Chosen(NamedTuple):
    """The memory: the base's incumbent, and the base's state after its last decision."""

    single: str
    after: Any


class Replicate(PricingPolicy):
    """Adds a second copy of each cycle to the placement of a base policy, if it pays.

    Parameters
    ----------
    candidates, initial, objective
        As in `dwell.policies.DTP`.
    base : MinimalPolicy, optional
        Decides among the candidates with one copy; it is copied. DTP with the same parameters if
        None.
    min_dwell : int
        N_min, in calls of `decide`.
    min_improvement : float
        Delta_min, in units of J: a second copy that comes into force must save more, and a copy
        that leaves must cost more.

    Raises
    ------
    PolicyError
        If a parameter is out of its range, `initial` is no candidate, or candidates place
        different tasks.
    """

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
        base: MinimalPolicy | None = None,
        min_dwell: int = 3,
        min_improvement: float = 0.05,
    ) -> None:
        self.min_dwell = check_parameter("min_dwell", min_dwell, MIN_DWELL)
        self.min_improvement = check_parameter("min_improvement", min_improvement, MIN_IMPROVEMENT)
        super().__init__(candidates=candidates, initial=initial, objective=objective)
        if base is None:
            base = DTP(
                candidates=plain_candidates(self.candidates),
                initial=self.single,
                objective=objective,
                min_dwell=min_dwell,
                min_improvement=min_improvement,
            )
        self._base = as_proposer(base)
        self.guarded = self._base.guarded

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the policy with the parameters of ``problem.controller``."""
        settings = problem.controller
        if settings.replicate.base == REPLICATE:
            raise PolicyError(
                "controller.replicate.base is replicate itself; name another policy, as dtp"
            )
        return cls(
            candidates=problem.candidates,
            initial=problem.initial,
            objective=problem.objective,
            base=by_name(settings.replicate.base, _of_singles(problem)),
            min_dwell=problem.min_dwell_decisions,
            min_improvement=settings.min_improvement,
        )

    def __repr__(self) -> str:
        return f"Replicate(initial={self.initial!r}, base={self.base!r})"

    @property
    def base(self) -> object:
        """The policy that decides among the candidates with one copy."""
        return self._base.given

    @property
    def single(self) -> str:
        """The base's incumbent: the placement in force, or a member of the pair in force."""
        chosen: _Chosen = self._standing.memory
        return chosen.single

    def start(self, problem: Problem) -> None:
        """Reset the policy and its base."""
        super().start(problem)
        self._base.start(_of_singles(problem))

    def adopt(self, name: str) -> None:
        """Make `name` the incumbent with n_d = 0; the base continues from a member of a pair."""
        before = self.single
        super().adopt(name)
        single = _member(self.candidates, name, before)
        if single != before or single == name:
            self._base.adopt(single)
        self._standing = self._standing._replace(memory=_Chosen(single, None))

    def commit(self, after: Standing) -> None:
        """Set the state that `propose` returned."""
        super().commit(after)
        self._base.commit(after.memory.after)

    def _blank(self) -> _Chosen:
        return _Chosen(_member(self.candidates, self.initial), None)

    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, _Chosen]:
        """Let the base decide, then compare its placement with its pairs.

        `delta_j` is J(X) - J(P) of the cheapest pair, the base's where X has no eligible pair.
        """
        estimates = self._known(estimates)
        now, pricing = self.incumbent, self._pricing
        costs = pricing.estimated(estimates, now)
        # A pair in force has no metrics of its members.
        seen = observed if now == self.single else estimates[self.single]
        singles = {name: estimates[name] for name in plain_candidates(self.candidates)}
        choice, after = self._base.propose(observed=seen, estimates=singles, tentative=True)
        made = choice if isinstance(choice, Decision) else None
        single = check_name("the base's decision", made.name if made else str(choice), singles)
        chosen = _Chosen(single, after)
        pairs = [name for name in self.candidates if self._is_pair(name, single)]
        if now in (single, *pairs) and self._standing.dwell < self.min_dwell:
            return self._stay("dwell", costs), chosen
        eligible, within_caps = pricing.eligible(estimates)
        pairs = [name for name in pairs if name in eligible]
        best = self._pair_of(pairs, estimates, costs)
        delta_j = costs[single] - costs[best] if best else made.delta_j if made else 0.0
        if not best or not self._pays(best, single, observed, estimates, costs):
            best = single
        if best == now:
            return self._stay("hold" if within_caps else "infeasible", costs, delta_j), chosen
        reason = pricing.reason(best, costs, eligible, within_caps=within_caps)
        if made is not None and best == made.name and made.migrated:
            reason = made.reason
        return self._move(best, reason, costs, delta_j), chosen

    def _is_pair(self, name: str, single: str) -> bool:
        placement = self.candidates[name]
        return isinstance(placement, Replicas) and single in placement.members

    def _pair_of(
        self, pairs: list[str], estimates: Mapping[str, QoS], costs: Mapping[str, float]
    ) -> str:
        """Return the pair to compare with X: the cheapest; empty without a pair.

        A pair in force gives way only to one that is cheaper by Delta_min and their error.
        """
        best, now = cheapest(costs, pairs, self.incumbent), self.incumbent
        if now not in pairs or best == now:
            return best
        least = self.min_improvement + self._pricing.margin(estimates[best], estimates[now])
        return best if exceeds(costs[now] - costs[best], least) else now

    def _pays(
        self,
        pair: str,
        single: str,
        observed: QoS,
        estimates: Mapping[str, QoS],
        costs: Mapping[str, float],
    ) -> bool:
        """Return whether a pair of X is to be in force."""
        gain = costs[single] - costs[pair]
        least = self.min_improvement + self._pricing.margin(estimates[pair], estimates[single])
        if pair == self.incumbent:
            return observed.violation_rate < LATE and not exceeds(-gain, least)
        return estimates[pair].violation_rate < LATE and exceeds(gain, least)


def _member(candidates: Mapping[str, Placement], name: str, preferred: str = "") -> str:
    """Return a candidate, or a member of a pair: the preferred one, else the first."""
    placement = candidates[name]
    if not isinstance(placement, Replicas):
        return name
    return preferred if preferred in placement.members else placement.members[0]


def _of_singles(problem: Problem) -> Problem:
    """Return the problem of the base: its policy, and the candidates with one copy."""
    settings = problem.controller
    initial = _member(problem.candidates, problem.initial)
    settings = replace(settings, policy=settings.replicate.base, initial=initial)
    return replace(problem, candidates=problem.plain_candidates, controller=settings)
