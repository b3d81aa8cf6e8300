"""The Controller: what both engines hand closed windows to, and take orders from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from operator import add
from typing import NamedTuple

import numpy as np

from dwell.control.coordination import Asked, Coordination, Verdict, Wish
from dwell.control.course import Course
from dwell.control.watchdog import Doubts, Expected, SeenWindow, Watchdog
from dwell.control.windows import (
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
from dwell.model import Caps, Decision, FrozenDict, Objective, Problem, QoS
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
    """The cycles that a decision looks at.

    Parameters
    ----------
    window : int
        Window of the last of them; of a move of the guard's the one that it begins.
    last_cycle : int
        The last of them.
    cycles : int
        Their number; 0 for a move of the guard's.
    """

    window: int
    last_cycle: int
    cycles: int


@dataclass(slots=True)
class ClosedWindow:
    """A window as an engine hands it over.

    Parameters
    ----------
    latency_ns, release_ns : int64 array, shape (W,)
        Latency as known at the close (`NEVER_NS` where unfinished) and release of its cycles.
    close_ns : int
        Instant of the close.
    open_ns : int
        Release of its first cycle.
    core_ns : float64 array, shape (3, resources)
        Core-nanoseconds in the window: of all work, of the cell's own jobs, of its shadow jobs;
        of an accelerator, of its places. NaN where they were not measured.
    looked : LookedAt
        Its number, and its cycles as the record counts them.
    evidence : callable, optional
        Makes the window's `Evidence`, for estimators that learn from it.
    recent : ClosedWindow, optional
        Its cycles since the last decision, which estimators get; the window itself if None.
    """

    latency_ns: Ints
    release_ns: Ints
    close_ns: int
    open_ns: int
    core_ns: Floats
    looked: LookedAt
    evidence: Callable[[], Evidence] | None = None
    recent: ClosedWindow | None = None

    def __repr__(self) -> str:
        return f"<ClosedWindow of {len(self.latency_ns)} cycles>"


@dataclass(slots=True)
class Proposal:
    """What is decided on a window, until it is known what comes of it.

    Parameters
    ----------
    seen : tuple of float
        L95 (ms) and violation rate of the window, and its cost.
    looked : LookedAt
    decision : Decision
        The policy's.
    priced : tuple
        Metrics of the cycles and of the candidates, for the row of ``decisions``.
    after : object
        What the policy is once this counts (`dwell.policies.protocol.Proposer.commit`).
    verdict : Verdict, optional
        What the fleet says of it.
    wished : str
        What the policy has decided for, where `decision` is the fleet's in its place.
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
    """Windows in, orders out: aggregation, estimator and policy in one object.

    A window is decided on by `propose`, which changes nothing but what the estimator has learnt
    (and what an object of a user's does to itself, where no fallback of the guard's holds). What
    becomes of the proposal is told once, when it is known:

    ==========  ======================================  ========================================
    told by     when                                    the policy is
    ==========  ======================================  ========================================
    `commit`    it is carried out                       as after its decision
    `reject`    people or the stamper do otherwise      as after its decision, then told twice
                                                        where the cell is: no switching term
                                                        remains
    `hold`      it would leave the guard's fallback     as before; told where the cell is, so
                for what is not proven                  that one window alone pays for the move
    ==========  ======================================  ========================================

    Parameters
    ----------
    policy : policy, str, or None
        An object with `decide`, a policy's or candidate's name, a policy's with an estimator's
        (``cusum+corrected``), or None for the cell file's choice. The caller's object is copied,
        never changed.
    estimator : Estimator, str, or None
        An object with `estimate`, an estimator's name, or None for the cell file's choice. The
        caller's object is copied, never changed.
    coordination : Coordination, optional
        What is asked before the cell moves, where it is one of a fleet.

    Raises
    ------
    PolicyError
        If the policy is unknown or is no policy, or names another estimator than is given.
    ProblemError
        If the estimator is unknown, or wants more shadows than there are cycles.
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
        #: The cell, with the N_min that it has with this estimator.
        self.problem, self.coordination = problem, coordination
        #: Names of the policy and the estimator where these are classes of a user's own, else None.
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
        #: Share of the cycles that the estimator wants sent through each alternative, by the
        #: candidate that is active.
        self.shadow_fractions = _shadow_fractions(self._estimator, problem)
        initial = self._policy.initial
        known = isinstance(initial, str) and initial in problem.candidates
        #: Where the cell is, as far as is known here.
        self.course = Course(str(initial) if known else problem.initial)
        if coordination is not None:
            coordination.place(self.course.placement)
        #: The incumbent whose windows are compared with its estimates.
        self._watched, self._watchdog = "", Watchdog(problem.window_cycles)
        self._doubts = Doubts(problem.window_cycles)
        #: What was last seen under each candidate.
        self._seen_under: dict[str, QoS] = {}
        #: What the next decision looks at, as the engine counts.
        self.looked = LookedAt(0, problem.decide_cycles - 1, problem.decide_cycles)
        #: Rows of ``decisions``: `decision_columns`, then why it was not carried out, or None.
        self.decisions: list[tuple[object, ...]] = []
        resources = problem.fabric.resources.values()
        #: Names of the cell's resources: its nodes, then their accelerators.
        self.resources = tuple(one.name for one in resources)
        self._has_accelerators = any(one.kind for one in resources)
        self._names = tuple(problem.candidates)
        #: What a row has where nothing is known of the candidates.
        self._none: list[float | bool | None] = [None] * len(self._names)
        self._capacity = np.array([one.capacity for one in resources], float)
        self._pricing = Pricing(problem.candidates, problem.objective)
        self._deadline_ns = problem.pipeline.deadline_ns
        self._censor_ms = problem.censor_ms
        #: By which caps candidates are eligible: the policy's own, where it has any.
        self.objective: Objective = self._policy.objective or problem.objective
        #: Whether it has any.
        self.has_caps = self.objective.caps != Caps()

    def __repr__(self) -> str:
        policy, estimator = type(self.policy).__name__, type(self.estimator).__name__
        return (
            f"<Controller of {self.problem.name}: {policy}, {estimator}; at "
            f"{self.course.placement}, window {self.looked.window}>"
        )

    @property
    def policy(self) -> object:
        """The policy that decides: a copy of what was given."""
        return self._policy.given

    @property
    def estimator(self) -> object:
        """The estimator that is asked: a copy of what was given."""
        return self._estimator.given

    @property
    def features(self) -> tuple[Feature, ...]:
        """What ``decisions`` has that not every run's has."""
        has: dict[Feature, bool] = {
            "support": self.supports,
            "fleet": self.coordination is not None,
            "between": self.problem.decide_cycles < self.problem.window_cycles,
        }
        return tuple(feature for feature, there in has.items() if there)

    @cached_property
    def decision_columns(self) -> tuple[str, ...]:
        """Names of the columns of ``decisions``, but the last.

        J of every candidate (null where the policy prices none), what was estimated of it (L95 in
        ms, violation rate, their standard errors, utilisation of every resource), whether it is
        within the caps, by how much it is over them at most (null without caps), and where the
        estimator says it, how many samples stand behind the estimate and how old (windows) the
        newest is.
        """
        resources = self.problem.fabric.resources.values()
        return tuple(
            column.name
            for one in those_with(self.features, DECISIONS)
            if one.name != "refused"
            for column in columns_of(one.name, resources, self._names)
        )

    def described(self) -> dict[str, object]:
        """Policy, its parameters and estimator as the record of a run names them."""
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
        """Whether windows have to bring their evidence."""
        return self._estimator.learns

    @property
    def guarded(self) -> bool:
        """Whether a guard may move the cell: it has fallbacks, and the policy lets it.

        A policy whose attribute `guarded` is false is left alone, as is the placement that never
        moves.
        """
        return bool(self._policy.guarded and self.problem.controller.fallbacks)

    def propose(self, window: ClosedWindow) -> Proposal:
        """Look at a closed window and say what the cycles after it shall be placed on.

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
        return self.propose_on(*metrics, shares, recent)

    def _metrics(self, window: ClosedWindow) -> tuple[float, float, float]:
        """Return L95 as it could be known (ms), V_D, and L95 as caps are compared with it."""
        age_ns = window.close_ns - window.release_ns
        missed = int(missed_cycles(window.latency_ns, age_ns, self._deadline_ns))
        l95_ms, uncut_ms = seen_l95_ms(window.latency_ns, age_ns, self._censor_ms)
        return float(l95_ms), missed / len(age_ns), float(uncut_ms)

    def seen(self, window: ClosedWindow, names: Iterable[str]) -> tuple[float, float, float]:
        """Return L95 (ms), V_D and J of a window without a decision.

        Parameters
        ----------
        names : iterable of str
            Candidate of the cycle before it, then the candidates of its cycles.
        """
        placed = self.problem.candidates
        moved = sum(hamming(placed[b], placed[a]) for a, b in pairwise(names) if a != b)
        l95_ms, violation_rate, _ = self._metrics(window)
        busy = dict(zip(self.resources, self.utilisation(window)[0, :, None], strict=True))
        of = np.array([l95_ms]), np.array([violation_rate]), busy, np.array([moved])
        return l95_ms, violation_rate, float(seen_costs(self.problem, *of)[0])

    def propose_on(
        self,
        l95_ms: float,
        violation_rate: float,
        uncut_ms: float,
        shares: Floats,
        recent: Floats | None = None,
    ) -> Proposal:
        """Propose on a window that an engine has measured itself (see `propose`).

        Parameters
        ----------
        l95_ms, violation_rate, uncut_ms : float
            L95 as it could be known, V_D, and L95 as caps are compared with it.
        shares : float64 array, shape (3, resources) or (4, resources)
            Busy, own and shadow share of every resource, and that of other cells of a fleet; NaN
            where they were not measured.
        recent : float64 array, optional
            The same since the last decision, for the estimator; `shares` where None.
        """
        observed = self._observed(l95_ms, violation_rate, uncut_ms, shares)
        if recent is None:
            return self.propose_by(observed, self._own_shares(shares))
        since = self._observed(l95_ms, violation_rate, uncut_ms, recent)
        return self.propose_by(observed, self._own_shares(recent), since)

    def _observed(
        self, l95_ms: float, violation_rate: float, uncut_ms: float, shares: Floats
    ) -> QoS:
        """Return metrics with what was busy of each resource."""
        used = dict(zip(self.resources, shares[0].tolist(), strict=True))
        if self._has_accelerators:
            used = _measured(used)
        return QoS(l95_ms, violation_rate, FrozenDict(used), uncut_ms)

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
        """Propose on metrics that are already aggregated (see `propose_on`).

        Parameters
        ----------
        own : mapping of str to float
            Share of each resource that is not foreign, since the last decision.
        recent : QoS, optional
            Metrics with the utilisation since the last decision; `observed` where None.
        """
        course = self.course
        incumbent = course.placement
        # With the switching term of the decision that led to it.
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
        if not self._estimator.learns:
            # It knows no more of the incumbent than the window shows.
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
        """Return what was seen of candidates whose estimates are not what windows show.

        The incumbent is compared (see `dwell.control.watchdog`). A cell whose fleet knows what the
        others do is compared by the fleet: its estimates are those of the cell alone.
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
        played = Expected.of_estimate(estimate, deviations, self.problem.window_cycles)
        if self._watchdog.compare(seen, played):
            self._doubts.change(incumbent, last_cycle, trusts=self._watchdog.trusts)

    def _consider(
        self, proposal: Proposal, estimates: Mapping[str, QoS], coordination: Coordination
    ) -> None:
        """Have the fleet look at what the policy has decided."""
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
        """Have the estimator learn from a window, if it learns, before it is decided on."""
        if self._estimator.learns:
            with UserCall(self.estimator, "learn", self.looked.window):
                self._estimator.look(evidence())

    def utilisation(self, window: ClosedWindow) -> Floats:
        """Busy, own and shadow share of every resource, shape (3, resources)."""
        return utilisation(window.core_ns, self._capacity, window.close_ns - window.open_ns)

    # ------------------------------------------------------------- what becomes of a proposal

    def settle(self, proposal: Proposal, *, proven: str | None = None) -> str:
        """Carry a proposal out, unless the guard's fallback would be left for what is not proven.

        Parameters
        ----------
        proven : str, optional
            Candidate that enough probes have completed through.

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
        """Take note that a proposal has been carried out."""
        decision = proposal.decision
        if not proposal.wished:
            self._policy.commit(proposal.after)
        elif decision.migrated or self.course.previous != self.course.placement:
            # The fleet decides in its place, so that it has decided nothing.
            self._adopt(decision.name)
        self._record(proposal)
        if decision.migrated:
            self.course.move(decision.name, decision.dwell)
        else:
            self.course.stay(decision.dwell)

    def reject(self, proposal: Proposal, why: str | None = None) -> None:
        """Take note that a proposal is not carried out, and why, if that is to be recorded."""
        self._policy.commit(proposal.after)
        self._record(proposal, why)
        self._find(self.course.placement, proposal.decision.name)
        self.course.find(self.course.placement, by_guard=self.course.by_guard)

    def hold(self, proposal: Proposal, why: str | None = None) -> None:
        """Stay on the guard's fallback: what is proposed has not been proven.

        A decision that cannot be carried out has not been made: the policy is as it was, and says
        at the next close what it wants then. `Course.wanted` names it, and probes are to be sent
        through it.
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
            # Nothing has been decided since the guard moved; this window has paid for the move.
            self._adopt(course.placement)
        course.hold(wanted.name)

    def miss(self) -> None:
        """Take note of a decision that was not made, because the controller's node was down."""
        self.course.miss()

    def adopt(self, name: str, *, left: str | None = None) -> None:
        """Take note that the guard has moved the cell to a fallback (rules 5 and 6 of the guard).

        The fallback is the incumbent with n_d = 0, and the next window, which begins with the first
        cycle stamped with it, carries the switching term of the move. ``decisions`` has a row for
        it, with reason ``guard``.

        Parameters
        ----------
        name : str
            The fallback.
        left : str, optional
            Placement that held until then; the incumbent where None. They differ where an order
            was still under way: it is void.

        Raises
        ------
        PolicyError
            If one of them is no candidate.
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
        window, *cycles = self.looked
        fixed = (window, left, name, name != left, "guard", 0, None, *cycles, 0)
        priced = [None] * (len(self.decision_columns) - len(fixed))
        self.decisions.append((*fixed, *priced, None))

    def resume(self, name: str, *, fallback: bool = False) -> None:
        """Take note of where the cell is, though nothing here was decided.

        A person has moved it, or this controller takes over from another one. It counts as a
        decision to be there: n_d is 0, and nothing has been switched.

        Parameters
        ----------
        name : str
            Candidate.
        fallback : bool
            Whether that is the guard's own move.
        """
        self._find(name, self.course.placement)
        self.course.find(name, by_guard=fallback)
        if self.coordination is not None:
            self.coordination.place(name)

    def _find(self, name: str, believed: str) -> None:
        """Tell a policy that believes the cell elsewhere where it is."""
        if name != believed:
            # The second time there is no move to tell of, so that no switching term remains.
            self._adopt(name)
            self._adopt(name)

    def _adopt(self, name: str) -> None:
        """Report to the policy where the cell is."""
        with UserCall(self.policy, "adopt", self.looked.window):
            self._policy.adopt(name)

    def _record(self, proposal: Proposal, why: str | None = None) -> None:
        """Write a row of ``decisions``: a move that was not carried out is none."""
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
        """Return the metrics that a decision looked at, where no window has them."""
        if "between" not in self.features:
            return ()
        used = map(observed.utilisation.get, self.resources)
        return observed.l95_ms, observed.violation_rate, *used

    def _priced(self, decision: Decision, estimates: Mapping[str, QoS]) -> tuple[object, ...]:
        """Return what a row of ``decisions`` says of every candidate."""
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
            *[shares.get(name) for name in self.resources for shares in used],
            *self._capped(known),
            *self._supported(),
        )

    def _capped(self, known: Iterable[QoS]) -> list[float | bool | None]:
        """Whether candidates are within the caps, then by how much they are over them."""
        if not self.has_caps:
            return [*[True for _ in known], *self._none]
        excesses = [excess(estimate, self.objective) for estimate in known]
        return [*[over <= 0 for over in excesses], *excesses]

    @property
    def supports(self) -> bool:
        """Whether the estimator says how much stands behind its estimates."""
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
        """Bring what a policy returned into the form of a decision."""
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
    """Leave out what is NaN."""
    return {name: share for name, share in shares.items() if not math.isnan(share)}


def _without_estimator(
    name: str, estimator: Estimator | str | None, problem: Problem
) -> tuple[str, Estimator | str | None]:
    """Split ``cusum+corrected``; the estimator stays as it is where the name has none."""
    policy, named = problem.policy_and_estimator(name)
    if named is not None and estimator is not None and estimator != named:
        raise PolicyError(f"policy {name!r} names its estimator; leave the other one out")
    return policy, named or estimator


def _shadow_fractions(estimator: CellEstimator, problem: Problem) -> FrozenDict[str, float]:
    """Share of the cycles that an estimator wants sent through each alternative, by candidate.

    Raises
    ------
    ProblemError
        If it is no share, or all alternatives together would get more than all cycles.
    """
    who = f"shadow_fraction of {type(estimator.given).__name__}"
    fractions = by_candidate(estimator.shadow_fraction, problem.candidates)
    for fraction in fractions.values():
        SHADOW_FRACTION.check(who, fraction)
        message = too_many_shadows(fraction, len(problem.candidates))
        if message:
            raise ProblemError([Fault(who, message)])
    return FrozenDict({name: float(fraction) for name, fraction in fractions.items()})
