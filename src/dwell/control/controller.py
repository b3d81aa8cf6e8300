"""The Controller: both engines pass it their windows and carry out its orders."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from operator import add
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.control.coordination import Asked, Coordination, Verdict, Wish
from dwell.control.course import Course
from dwell.control.watchdog import Doubts, Expected, SeenWindow, Watchdog
from dwell.control.windows import (
    age_l95_ms,
    missed_cycles,
    seen_costs,
    seen_l95_ms,
    utilisation,
)
from dwell.cost import excess, hamming
from dwell.errors import Fault, MetricError, PolicyError, ProblemError
from dwell.estimators import Estimator, Evidence
from dwell.estimators import by_name as estimator_by_name
from dwell.estimators.protocol import CellEstimator
from dwell.estimators.registry import resolved
from dwell.estimators.user_estimator import as_started
from dwell.model import Caps, Decision, FrozenDict, Objective, Problem, QoS, Reason
from dwell.model.bounds import CLASS_PATH
from dwell.model.controller_settings import SHADOW_FRACTION
from dwell.model.number_arrays import Floats, Ints
from dwell.model.qos import NO_ERROR
from dwell.model.semantics import too_many_shadows
from dwell.model.shadow_plan import by_candidate
from dwell.model.table_columns import DECISIONS, Feature, columns_of, those_with
from dwell.model.user_classes import UserCall
from dwell.policies import MinimalPolicy, parameters_of
from dwell.policies import by_name as policy_by_name
from dwell.policies.pricing import Pricing
from dwell.policies.registry import estimator_of
from dwell.policies.user_policy import as_proposer


class LookedAt(NamedTuple):
    """The cycles that a decision is based on.

    Parameters
    ----------
    window : int
        Window of the last cycle. For a move of the guard, the window that the move begins.
    last_cycle : int
        The last cycle.
    cycles : int
        Number of cycles; 0 for a move of the guard.
    """

    window: int
    last_cycle: int
    cycles: int


@dataclass(slots=True)
class ClosedWindow:
    """A window at its end, as an engine passes it to the controller.

    Parameters
    ----------
    latency_ns, release_ns : int64 array, shape (W,)
        Latency of each cycle at the end of the window (`NEVER_NS` if unfinished), and its release.
    close_ns : int
        End of the window.
    open_ns : int
        Release of the first cycle.
    core_ns : float64 array, shape (3, resources)
        Busy core-nanoseconds in the window (for an accelerator, place-nanoseconds): all work, the
        cell's own jobs, its shadow jobs. NaN if not measured.
    looked : LookedAt
        Number of the window, and its cycles as the record counts them.
    evidence : callable, optional
        Makes the window's `Evidence` for estimators that learn.
    recent : ClosedWindow, optional
        The window's cycles since the last decision, for the estimator; None for the whole window.
    over_age : bool array, shape (W,), optional
        Whether the data of each cycle's actuation were older than a chain's `max_age_ms`.
    ages_ns : int64 array, shape (n,), optional
        Data age at each cycle's actuation of the chain `objective.latency`, `NO_AGE` where it is
        unknown; None without such a chain.
    age_ms : float, optional
        Mean age of the newest command, if J weighs it.
    """

    latency_ns: Ints
    release_ns: Ints
    close_ns: int
    open_ns: int
    core_ns: Floats
    looked: LookedAt
    evidence: Callable[[], Evidence] | None = None
    recent: ClosedWindow | None = None
    over_age: NDArray[np.bool_] | None = None
    ages_ns: Ints | None = None
    age_ms: float | None = None

    def __repr__(self) -> str:
        return f"<ClosedWindow of {len(self.latency_ns)} cycles>"


@dataclass(slots=True)
class Proposal:
    """A decision on a window before it is carried out, rejected or held.

    Parameters
    ----------
    seen : tuple of float
        L95 (ms), violation rate and cost of the window.
    looked : LookedAt
    decision : Decision
        Decision of the policy, or of the fleet if that differs.
    priced : tuple
        Metrics of the cycles and of the candidates, for the row of ``decisions``.
    after : object
        State of the policy after the decision (`dwell.policies.protocol.Proposer.commit`).
    verdict : Verdict, optional
        The fleet's verdict on the decision.
    wished : str
        Candidate of the policy if the fleet has chosen another one, else empty.
    """

    seen: tuple[float, float, float]
    looked: LookedAt
    decision: Decision
    priced: tuple[object, ...]
    after: object
    verdict: Verdict | None = None
    wished: str = ""

    def __repr__(self) -> str:
        return f"<Proposal: {self.decision.reason}, {self.decision.name}>"


class Controller:
    """Aggregates windows, estimates the candidates, and decides by the policy.

    `propose` decides on a window. It changes the state of the estimator, but never of a policy of
    Dwell. A user's policy may change its own state, except in a fleet and on a fallback of the
    guard. The engine then calls one of three methods, once per proposal:

    ==========  ======================================  ========================================
    method      use                                     state of the policy
    ==========  ======================================  ========================================
    `commit`    the proposal is carried out             after its decision
    `reject`    a person or the stamper overrides it    after its decision, then corrected to the
                                                        actual placement without a switching term
    `hold`      it would leave the guard's fallback     before its decision; the first window after
                for an unproven candidate               the guard's move has the switching term
    ==========  ======================================  ========================================

    Parameters
    ----------
    policy : policy, str, or None
        An object with `decide`; the name of a policy, of a candidate, or of a policy and an
        estimator (``cusum+corrected``); None for the policy of the cell file. An object is copied
        and never changed.
    estimator : Estimator, str, or None
        An object with `estimate`; the name of an estimator; None for the estimator of the cell
        file. An object is copied and never changed.
    coordination : Coordination, optional
        Coordination of the moves of a fleet, for a cell that belongs to one.

    Raises
    ------
    PolicyError
        If the policy is unknown or invalid, or names another estimator than `estimator`.
    ProblemError
        If the estimator is unknown, or its shadows would exceed the number of cycles.
    """

    def __init__(
        self,
        problem: Problem,
        policy: MinimalPolicy | str | None = None,
        estimator: Estimator | str | None = None,
        coordination: Coordination | None = None,
    ) -> None:
        if isinstance(policy, str):
            policy, estimator = _without_estimator(policy, estimator, problem)
        policy = policy or problem.controller.policy
        estimator = estimator or estimator_of(problem, policy)
        problem = resolved(problem, estimator)
        #: The cell, with N_min for this estimator.
        self.problem, self.coordination = problem, coordination
        #: Class paths of the policy and the estimator if a user wrote them, else None.
        self._own = tuple(one if CLASS_PATH.holds(one) else None for one in (policy, estimator))
        decider = policy_by_name(policy, problem) if isinstance(policy, str) else policy
        with UserCall(decider, "start"):
            self._policy = as_proposer(decider)
            self._policy.start(problem)
        made = estimator_by_name(estimator, problem) if isinstance(estimator, str) else estimator
        with UserCall(made, "start"):
            self._estimator = as_started(made, problem, copied=made is estimator)
        if coordination is not None:
            coordination.meet(self._estimator)
        #: By active candidate, the share of cycles with a shadow through each alternative.
        self.shadow_fractions = _shadow_fractions(self._estimator, problem)
        initial = self._policy.initial
        known = isinstance(initial, str) and initial in problem.candidates
        #: Placement of the cell, as far as the controller knows.
        self.course = Course(str(initial) if known else problem.initial)
        if coordination is not None:
            coordination.place(self.course.placement)
        #: The incumbent whose windows are compared with its estimates.
        self._watched, self._watchdog = "", Watchdog(problem.window_cycles)
        self._doubts = Doubts(problem.window_cycles)
        #: Last measured metrics under each candidate.
        self._seen_under: dict[str, QoS] = {}
        #: Cycles of the current decision, as the engine counts them.
        self.looked = LookedAt(0, problem.decide_cycles - 1, problem.decide_cycles)
        #: Rows of ``decisions``: `decision_columns`, then the reason of a refusal, or None.
        self.decisions: list[tuple[object, ...]] = []
        resources = problem.fabric.resources.values()
        #: Names of the cell's resources: its nodes, then their accelerators.
        self.resources = tuple(one.name for one in resources)
        self._has_accelerators = any(one.kind for one in resources)
        self._names = tuple(problem.candidates)
        #: Values of a row for candidates without a known value.
        self._none: list[float | bool | None] = [None] * len(self._names)
        self._capacity = np.array([one.capacity for one in resources], float)
        self._pricing = Pricing(problem.candidates, problem.objective)
        self._deadline_ns = problem.pipeline.deadline_ns
        #: Whether decisions are more frequent than windows.
        self._has_looks = problem.decides_within_windows
        self._censor_ms = problem.censor_ms
        #: The policy's objective, else the cell's; its caps decide which candidates are eligible.
        self.objective: Objective = self._policy.objective or problem.objective
        #: Whether the objective has caps.
        self.has_caps = self.objective.caps != Caps()

    def __repr__(self) -> str:
        policy, estimator = type(self.policy).__name__, type(self.estimator).__name__
        return (
            f"<Controller of {self.problem.name}: {policy}, {estimator}; at "
            f"{self.course.placement}, window {self.looked.window}>"
        )

    @property
    def policy(self) -> object:
        """The policy: a copy if the caller passed an object."""
        return self._policy.given

    @property
    def estimator(self) -> object:
        """The estimator: a copy if the caller passed an object."""
        return self._estimator.given

    @property
    def features(self) -> tuple[Feature, ...]:
        """Optional groups of columns that ``decisions`` has in this run."""
        has: dict[Feature, bool] = {
            "support": self.supports,
            "fleet": self.coordination is not None,
            "between": self._has_looks,
            "age": self.problem.objective.weighs_age,
            "price": self.problem.fabric.has_prices,
            "misses": self.objective.caps.misses is not None,
        }
        return tuple(feature for feature, there in has.items() if there)

    @cached_property
    def decision_columns(self) -> tuple[str, ...]:
        """Names of the columns of ``decisions``, except the last.

        Each candidate has columns for J (null if the policy has no prices) and its estimates: L95
        (ms), violation rate, their standard errors, and the utilisation of every resource. Further
        columns are whether it is within the caps and the largest excess over a cap (null without
        caps). Some estimators add the number of samples and the age of the newest one (windows).
        """
        resources = self.problem.fabric.resources.values()
        return tuple(
            column.name
            for one in those_with(self.features, DECISIONS)
            if one.name != "refused"
            for column in columns_of(one.name, resources, self._names)
        )

    def described(self) -> dict[str, object]:
        """Return the policy, its parameters and the estimator for the record of a run."""
        policy = self.policy
        own_policy, own_estimator = self._own
        known = type(policy).__repr__ is not object.__repr__
        return {
            "policy": own_policy or (repr(policy) if known else type(policy).__name__),
            "parameters": parameters_of(policy),
            "estimator": own_estimator or type(self.estimator).__name__,
            "shadow_fractions": dict(self.shadow_fractions),
        }

    @property
    def sends_shadows(self) -> bool:
        """Whether the estimator wants shadows under any candidate."""
        return any(self.shadow_fractions.values())

    @property
    def learns(self) -> bool:
        """Whether windows need their evidence."""
        return self._estimator.learns

    @property
    def guarded(self) -> bool:
        """Whether a guard may move the cell: it has fallbacks, and the policy is `guarded`.

        A fixed placement is not guarded.
        """
        return bool(self._policy.guarded and self.problem.controller.fallbacks)

    def propose(self, window: ClosedWindow) -> Proposal:
        """Propose the placement of the next cycles, from a window at its end.

        Raises
        ------
        PolicyError
            If the policy returns neither a decision nor a candidate's name.
        """
        self.looked = window.looked
        metrics, shares = self._metrics(window), self.utilisation(window)
        evidence = (window.recent or window).evidence
        if evidence is not None:
            self.learn(evidence)
        recent = None if window.recent is None else self.utilisation(window.recent)
        return self.propose_on(*metrics, shares, recent, window.age_ms)

    def _metrics(self, window: ClosedWindow) -> tuple[float, float, float]:
        """Return L95 known at the end of the window (ms), V_D, and L95 for caps (ms)."""
        age_ns = window.close_ns - window.release_ns
        missed = int(missed_cycles(window.latency_ns, age_ns, self._deadline_ns, window.over_age))
        if window.ages_ns is None:
            l95_ms, uncut_ms = seen_l95_ms(window.latency_ns, age_ns, self._censor_ms)
        else:
            uncut_ms = age_l95_ms(window.ages_ns[None])[0]
            l95_ms = np.minimum(uncut_ms, self._censor_ms)
        return float(l95_ms), missed / len(age_ns), float(uncut_ms)

    def seen(self, window: ClosedWindow, names: Iterable[str]) -> tuple[float, float, float]:
        """Return L95 (ms), V_D and J of a window without a decision.

        Parameters
        ----------
        names : iterable of str
            Candidate of the cycle before the window, then the candidates of its cycles.
        """
        placed = self.problem.candidates
        moved = sum(hamming(placed[b], placed[a]) for a, b in pairwise(names) if a != b)
        l95_ms, violation_rate, _ = self._metrics(window)
        busy = dict(zip(self.resources, self.utilisation(window)[0, :, None], strict=True))
        of = np.array([l95_ms]), np.array([violation_rate]), busy, np.array([moved])
        age_ms = window.age_ms or 0.0
        return l95_ms, violation_rate, float(seen_costs(self.problem, *of, age_ms)[0])

    def propose_on(
        self,
        l95_ms: float,
        violation_rate: float,
        uncut_ms: float,
        shares: Floats,
        recent: Floats | None = None,
        age_ms: float | None = None,
        price_per_hour: float | None = None,
    ) -> Proposal:
        """Propose from the metrics of a window that the engine has computed (see `propose`).

        Parameters
        ----------
        l95_ms, violation_rate, uncut_ms : float
            L95 known at the end of the window, V_D, and L95 for caps.
        shares : float64 array, shape (3, resources) or (4, resources)
            Busy, own and shadow share of every resource, and optionally the share of the fleet's
            other cells; NaN if not measured.
        recent : float64 array, optional
            The same shares since the last decision, for the estimator; None for `shares`.
        age_ms : float, optional
            Mean age of the newest command; needed if J weighs it.
        price_per_hour : float, optional
            Price of transmitted bytes; needed if J weighs it.
        """
        seen = l95_ms, violation_rate, uncut_ms, age_ms, price_per_hour
        observed = self._observed(*seen, shares)
        if recent is None:
            return self.propose_by(observed, self._own_shares(shares))
        since = self._observed(*seen, recent)
        return self.propose_by(observed, self._own_shares(recent), since)

    def _observed(
        self,
        l95_ms: float,
        violation_rate: float,
        uncut_ms: float,
        age_ms: float | None,
        price_per_hour: float | None,
        shares: Floats,
    ) -> QoS:
        """Return the metrics with the busy share of each resource."""
        used = dict(zip(self.resources, shares[0].tolist(), strict=True))
        if self._has_accelerators:
            used = _measured(used)
        known = l95_ms, violation_rate, FrozenDict(used), uncut_ms
        return QoS(*known, age_ms=age_ms, price_per_hour=price_per_hour)

    def _own_shares(self, shares: Floats) -> dict[str, float]:
        """Return the share of each resource that is not foreign."""
        _, own, shadow, *others = shares.tolist()
        # Neither the cell's jobs nor its shadow jobs are foreign.
        mine = dict(zip(self.resources, map(add, own, shadow), strict=True))
        if others and self.coordination is not None and self.coordination.knows_others:
            mine = {name: mine[name] + share for name, share in zip(mine, *others, strict=True)}
        return _measured(mine) if self._has_accelerators else mine

    def propose_by(
        self, observed: QoS, own: Mapping[str, float], recent: QoS | None = None
    ) -> Proposal:
        """Propose from aggregated metrics (see `propose_on`).

        Parameters
        ----------
        own : mapping of str to float
            Share of each resource that is not foreign, since the last decision.
        recent : QoS, optional
            Metrics with the utilisation since the last decision; None for `observed`.
        """
        course = self.course
        incumbent = course.placement
        # Includes the switching term of the last decision.
        measured = self._pricing.cost(observed, incumbent, course.previous)
        estimates = self._estimates(observed, own, recent or observed)
        with UserCall(self.policy, "decide", self.looked.window):
            decision, after = self._policy.propose(
                observed=observed,
                estimates=estimates,
                tentative=course.by_guard or self.coordination is not None,
            )
        decision = self._checked(decision)
        seen = observed.l95_ms, observed.violation_rate, measured
        priced = (*self._looked_at(observed), *self._priced(decision, estimates))
        proposal = Proposal(seen, self.looked, decision, priced, after)
        if self.coordination is not None:
            self._consider(proposal, estimates, self.coordination)
        return proposal

    def _estimates(
        self, observed: QoS, own: Mapping[str, float], recent: QoS
    ) -> FrozenDict[str, QoS]:
        """Estimate every candidate; a policy cannot change the estimates that are recorded."""
        incumbent = self.course.placement
        with UserCall(self.estimator, "estimate", self.looked.window):
            known = self._estimator.estimate(observed=recent, incumbent=incumbent, own=own)
            estimates = dict(known)
        if self.objective.caps.misses is not None and isinstance(estimates.get(incumbent), QoS):
            # A window has too few stretches for the cap.
            observed = replace(observed, misses=estimates[incumbent].misses)
        if not self._estimator.learns:
            # Without learning, the window is the best estimate of the incumbent.
            estimates[incumbent] = observed
        else:
            estimates |= self._doubted(observed, estimates)
        missing = [one for one in self._names if not isinstance(estimates.get(one), QoS)]
        if missing:
            who, window = type(self.estimator).__name__, self.looked.window
            raise MetricError(
                f"{who}.estimate returned no QoS for {missing[0]} at window {window}; it must "
                f"return one for each of {', '.join(self._names)}"
            )
        return FrozenDict(estimates)

    def _doubted(self, observed: QoS, estimates: Mapping[str, QoS]) -> Mapping[str, QoS]:
        """Return the last measured metrics of candidates whose estimates contradict their windows.

        The watchdog compares the incumbent (see `dwell.control.watchdog`). If the fleet knows the
        other cells, the fleet compares instead, because these estimates are for the cell alone.
        """
        incumbent, (_, last_cycle, cycles) = self.course.placement, self.looked
        self._seen_under[incumbent] = observed
        doubted = self._doubts.at(last_cycle)
        if self.coordination is not None and self.coordination.knows_others:
            self._watched = ""
            return {name: self._seen_under[name] for name in doubted - {incumbent}}
        if self._watched != incumbent:
            self._watched, whole = incumbent, self.problem.window_cycles
            self._watchdog = Watchdog(whole, last_cycle - cycles, trusts=incumbent not in doubted)
        self._watch(observed, estimates)
        if not self._watchdog.trusts:
            self._doubts.go_on(incumbent, last_cycle)
        return {name: self._seen_under[name] for name in self._doubts.at(last_cycle)}

    def _watch(self, observed: QoS, estimates: Mapping[str, QoS]) -> None:
        """Compare the incumbent's window with its estimate, if it can be compared."""
        incumbent, (_, last_cycle, cycles) = self.course.placement, self.looked
        seen = SeenWindow(observed.l95_ms, observed.violation_rate, last_cycle, cycles)
        estimate = estimates.get(incumbent)
        if not isinstance(estimate, QoS) or not self._watchdog.is_due(seen):
            return
        deviations = self._estimator.deviations(incumbent)
        if deviations is None:
            return
        played = Expected.of_estimate(estimate, deviations, self.problem.due_cycles)
        if self._watchdog.compare(seen, played):
            self._doubts.change(incumbent, last_cycle, trusts=self._watchdog.trusts)

    def _consider(
        self, proposal: Proposal, estimates: Mapping[str, QoS], coordination: Coordination
    ) -> None:
        """Pass the policy's decision to the fleet, and apply its verdict to the proposal."""
        decision, incumbent = proposal.decision, self.course.placement
        by_price = self._policy.by_price
        seen = SeenWindow(*proposal.seen[:2], *proposal.looked[1:])
        of_cell = self._estimator, by_price, seen, self._doubts, self.course.by_guard
        wish = Wish(decision, estimates, incumbent, *of_cell)
        verdict = coordination.consider(wish)
        proposal.verdict, name = verdict, verdict.name
        if name != decision.name:
            migrated = name != incumbent
            proposal.wished = decision.name
            proposal.decision = replace(
                decision,
                placement=self.problem.candidates[name],
                name=name,
                migrated=migrated,
                reason="migrate" if migrated else decision.reason,
                dwell=0 if migrated else self.course.dwell,
            )

    def learn(self, evidence: Callable[[], Evidence]) -> None:
        """Pass the evidence of a window to an estimator that learns, before the decision."""
        if self._estimator.learns:
            with UserCall(self.estimator, "learn", self.looked.window):
                self._estimator.look(evidence())

    def utilisation(self, window: ClosedWindow) -> Floats:
        """Return the busy, own and shadow share of every resource, shape (3, resources)."""
        return utilisation(window.core_ns, self._capacity, window.close_ns - window.open_ns)

    # ------------------------------------------------------------- outcome of a proposal

    def settle(self, proposal: Proposal, *, proven: str | None = None) -> str:
        """Carry out a proposal, unless it leaves the guard's fallback for an unproven candidate.

        Parameters
        ----------
        proven : str, optional
            Candidate through which enough probes have completed.

        Returns
        -------
        str
            Candidate of the cycles that follow.
        """
        if self.course.leaves_unproven(proposal.decision.name, proven):
            self.hold(proposal)
        else:
            self.commit(proposal)
        return self.course.placement

    def commit(self, proposal: Proposal) -> None:
        """Record that a proposal has been carried out."""
        decision = proposal.decision
        if not proposal.wished:
            self._policy.commit(proposal.after)
        elif decision.migrated or self.course.previous != self.course.placement:
            # The fleet has replaced the policy's decision, which therefore does not count.
            self._adopt(decision.name)
        self._record(proposal)
        if decision.migrated:
            self.course.move(decision.name, decision.dwell)
        else:
            self.course.stay(decision.dwell)

    def reject(self, proposal: Proposal, why: str | None = None) -> None:
        """Record that a proposal is not carried out, with an optional reason."""
        self._policy.commit(proposal.after)
        self._record(proposal, why)
        self._find(self.course.placement, proposal.decision.name)
        self.course.find(self.course.placement, by_guard=self.course.by_guard)

    def hold(self, proposal: Proposal, why: str | None = None) -> None:
        """Stay on the guard's fallback, because the proposed candidate is not proven.

        The policy keeps its state from before the decision, and decides again at the end of the
        next window. `Course.wanted` names the candidate, for the probes.
        """
        course, wanted = self.course, proposal.decision
        proposal.decision = replace(
            wanted,
            placement=self.problem.candidates[course.placement],
            name=course.placement,
            migrated=False,
            reason="guard",
            dwell=course.dwell,
        )
        self._record(proposal, why)
        if course.previous != course.placement:
            # First window since the guard's move: it has the switching term, later ones do not.
            self._adopt(course.placement)
        course.hold(wanted.name)

    def miss(self) -> None:
        """Record a window without a decision, because the controller's node was down."""
        self.course.miss()

    def adopt(self, name: str, *, left: str | None = None) -> None:
        """Record that the guard has moved the cell to a fallback (rules 5 and 6 of the guard).

        The fallback becomes the incumbent with n_d = 0. The next window begins with the first cycle
        on the fallback, and its cost includes the switching term of the move. ``decisions`` gets a
        row with reason ``guard``.

        Parameters
        ----------
        name : str
            The fallback.
        left : str, optional
            Placement before the move; None for the incumbent. The two differ if an order had not
            taken effect yet; this order is void.

        Raises
        ------
        PolicyError
            If `name` or `left` is not a candidate.
        """
        left = self.course.placement if left is None else left
        for who in (name, left):
            if who not in self.problem.candidates:
                raise PolicyError(
                    f"the guard cannot have moved the cell from {left!r} to {name!r}: {who!r} is "
                    f"no candidate (candidates here: {', '.join(self.problem.candidates)})"
                )
        if left != self.course.placement:
            self._adopt(left)
        self._adopt(name)
        self.course.fall(name, left)
        if self.coordination is not None:
            self.coordination.place(name)
        self._record_move(left, name, "guard")

    def resume(self, name: str, *, fallback: bool = False, moved_by: Reason | None = None) -> None:
        """Record the placement of the cell after a move that this controller did not decide.

        A person has moved the cell, or this controller takes over from another. n_d becomes 0,
        and the cost of the next window has no switching term.

        Parameters
        ----------
        name : str
            Candidate.
        fallback : bool
            Whether the guard has made the move.
        moved_by : {"pinned", "drained", "ordered"}, optional
            Reason of a move that ``decisions`` gets a row of; None for a takeover.
        """
        left = self.course.placement
        self._find(name, left)
        self.course.find(name, by_guard=fallback)
        if self.coordination is not None:
            self.coordination.place(name)
        if moved_by is not None:
            self._record_move(left, name, moved_by)

    def _record_move(self, left: str, name: str, reason: Reason) -> None:
        """Append a row to ``decisions`` for a move that no proposal made."""
        window, *cycles = self.looked
        fixed = (window, left, name, name != left, reason, 0, None, *cycles, 0)
        priced = [None] * (len(self.decision_columns) - len(fixed))
        self.decisions.append((*fixed, *priced, None))

    def _find(self, name: str, believed: str) -> None:
        """Report the placement of the cell to a policy that assumes another placement."""
        if name != believed:
            # The second report has no move, and thus removes the switching term.
            self._adopt(name)
            self._adopt(name)

    def _adopt(self, name: str) -> None:
        """Report the placement of the cell to the policy."""
        with UserCall(self.policy, "adopt", self.looked.window):
            self._policy.adopt(name)

    def _record(self, proposal: Proposal, why: str | None = None) -> None:
        """Append a row to ``decisions``; a refused move becomes a stay with the refusal."""
        decision, incumbent = proposal.decision, self.course.placement
        name, migrated = decision.name, decision.migrated
        if why is not None and migrated:
            why, name, migrated = f"{name}: {why}", incumbent, False
        asked: Asked | tuple[()] = ()
        if proposal.verdict is not None:
            asked = proposal.verdict.asked
            if why is None and proposal.verdict.why is not None:
                why = f"{proposal.wished or incumbent}: {proposal.verdict.why}"
        window, *cycles = proposal.looked
        dwell_cycles = decision.dwell * self.problem.decide_cycles
        dwell = dwell_cycles // self.problem.window_cycles
        fixed = (window, incumbent, name, migrated, decision.reason, dwell, decision.delta_j)
        self.decisions.append((*fixed, *cycles, dwell_cycles, *proposal.priced, *asked, why))

    def _looked_at(self, observed: QoS) -> tuple[float | None, ...]:
        """Return the metrics of a decision, if a window can have several, and its weighed terms."""
        further = (observed.age_ms,) if self.problem.objective.weighs_age else ()
        if self.problem.fabric.has_prices:
            further = (*further, observed.price_per_hour)
        if not self._has_looks:
            return further
        used = map(observed.utilisation.get, self.resources)
        return observed.l95_ms, observed.violation_rate, *used, *further

    def _priced(self, decision: Decision, estimates: Mapping[str, QoS]) -> tuple[object, ...]:
        """Return the values of all candidates for a row of ``decisions``."""
        names, costs = self._names, decision.costs
        known = [estimates[name] for name in names]
        errors = [estimate.error or NO_ERROR for estimate in known]
        used = [estimate.utilisation for estimate in known]
        return (
            *(map(costs.get, names) if costs else self._none),
            *[estimate.l95_ms for estimate in known],
            *[estimate.violation_rate for estimate in known],
            *[l95_ms for l95_ms, _ in errors],
            *[violation_rate for _, violation_rate in errors],
            *([estimate.age_ms for estimate in known] if self.problem.objective.weighs_age else ()),
            *([one.price_per_hour for one in known] if self.problem.fabric.has_prices else ()),
            *([estimate.misses for estimate in known] if self.objective.caps.misses else ()),
            *[shares.get(name) for name in self.resources for shares in used],
            *self._capped(known),
            *self._supported(),
        )

    def _capped(self, known: Iterable[QoS]) -> list[float | bool | None]:
        """Return whether each candidate is within the caps, then the largest excess of each."""
        if not self.has_caps:
            return [*[True for _ in known], *self._none]
        excesses = [excess(estimate, self.objective) for estimate in known]
        return [*[over <= 0 for over in excesses], *excesses]

    @property
    def supports(self) -> bool:
        """Whether the estimator reports the samples behind its estimates."""
        return self._estimator.supports

    def _supported(self) -> list[float]:
        if not self._estimator.supports:
            return []
        with UserCall(self.estimator, "support", self.looked.window):
            support = self._estimator.support()
        behind = [support[name] for name in self._names if name in support]
        if len(behind) < len(self._names):
            who, known = type(self.estimator).__name__, ", ".join(support) or "nothing"
            raise MetricError(
                f"{who}.support says something of {known}; it must of each of "
                f"{', '.join(self._names)}"
            )
        return [known.samples for known in behind] + [known.age_windows for known in behind]

    def _checked(self, decision: Decision | str) -> Decision:
        """Return a policy's result as a `Decision`, and raise if it is invalid."""
        candidates = self.problem.candidates
        who = type(self.policy).__name__
        name = decision.name if isinstance(decision, Decision) else decision
        if not isinstance(name, str) or name not in candidates:
            raise PolicyError(
                f"{who}.decide returned {decision!r} at window {self.looked.window}; "
                f"it must be a Decision or a candidate's name: {', '.join(candidates)}"
            )
        if isinstance(decision, Decision):
            if decision.placement != candidates[name] or decision.migrated != (
                name != self.course.placement
            ):
                raise PolicyError(
                    f"{who}.decide returned a decision for {name!r} at window "
                    f"{self.looked.window} whose placement or `migrated` contradicts its "
                    f"name (incumbent: {self.course.placement!r}; a policy that remembers it needs "
                    "adopt(name), by which it is told of moves of the guard)"
                )
            return decision
        migrated = name != self.course.placement
        return Decision(
            placement=candidates[name],
            name=name,
            migrated=migrated,
            reason="migrate" if migrated else "hold",
            dwell=0 if migrated else self.course.dwell + 1,
        )


def _measured(shares: Mapping[str, float]) -> dict[str, float]:
    """Return the shares that are not NaN."""
    return {name: share for name, share in shares.items() if not math.isnan(share)}


def _without_estimator(
    name: str, estimator: Estimator | str | None, problem: Problem
) -> tuple[str, Estimator | str | None]:
    """Split ``cusum+corrected``; keep `estimator` if the name has none."""
    policy, named = problem.policy_and_estimator(name)
    if named is not None and estimator is not None and estimator != named:
        raise PolicyError(f"policy {name!r} names its estimator; leave the other one out")
    return policy, named or estimator


def _shadow_fractions(estimator: CellEstimator, problem: Problem) -> FrozenDict[str, float]:
    """Return, by active candidate, the share of cycles with a shadow through each alternative.

    Raises
    ------
    ProblemError
        If a value is not a share, or the shares of all alternatives add up to more than 1.
    """
    who = f"shadow_fraction of {type(estimator.given).__name__}"
    fractions = by_candidate(estimator.shadow_fraction, problem.candidates)
    for fraction in fractions.values():
        SHADOW_FRACTION.check(who, fraction)
        message = too_many_shadows(fraction, len(problem.plain_candidates))
        if message:
            raise ProblemError([Fault(who, message)])
    return FrozenDict({name: float(fraction) for name, fraction in fractions.items()})
