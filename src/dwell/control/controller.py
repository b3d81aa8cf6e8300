"""The Controller: what both engines hand closed windows to, and take orders from."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.control.windows import missed_cycles, seen_l95_ns, utilisation
from dwell.cost import cost, hamming, price, tier_nodes
from dwell.errors import PolicyError
from dwell.estimators import Estimator, Profile
from dwell.estimators import by_name as estimator_by_name
from dwell.model import Decision, FrozenDict, Problem, QoS
from dwell.policies import MinimalPolicy, Static
from dwell.policies import by_name as policy_by_name

__all__ = ["ClosedWindow", "Controller", "Log", "static_columns"]

Ints: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]


@dataclass(slots=True)
class ClosedWindow:
    """One window as an engine hands it over, or many of them as rows.

    Parameters
    ----------
    latency_ns, release_ns : int64 array, shape (W,) or (windows, W)
        Latency as known at the close (`NEVER_NS` where unfinished) and release of its cycles.
    close_ns : int, or int64 array of shape (windows, 1)
        Instant of the close.
    open_ns : int, or int64 array of shape (windows, 1)
        Release of its first cycle.
    busy_ns, own_ns : float64 array, shape (nodes,) or (windows, nodes)
        Core-nanoseconds in the window: all work, and that of the cell's own jobs.
    """

    latency_ns: Ints
    release_ns: Ints
    close_ns: Ints | int
    open_ns: Ints | int
    busy_ns: Floats
    own_ns: Floats


@dataclass(slots=True)
class Log:
    """What the controller saw and decided, column by column; one entry a window.

    A window whose close the controller did not see (its node was down) has NaN metrics and no
    decision.
    """

    incumbent: list[str] = field(default_factory=list)
    seen_l95_ms: list[float] = field(default_factory=list)
    seen_violation_rate: list[float] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)
    decisions: list[Decision | None] = field(default_factory=list)
    estimates: list[Mapping[str, QoS]] = field(default_factory=list)


class Controller:
    """Windows in, orders out: aggregation, estimator and policy in one object.

    Parameters
    ----------
    problem : Problem
    policy : policy, str, or None
        An object with `decide`, a policy's or candidate's name, or None for the cell file's
        choice. The caller's object is copied, never changed.
    estimator : Estimator, str, or None
        Likewise.

    Raises
    ------
    PolicyError
        If the policy is unknown or is no policy.
    """

    def __init__(
        self,
        problem: Problem,
        policy: MinimalPolicy | str | None = None,
        estimator: Estimator | str | None = None,
    ) -> None:
        self.problem = problem
        self.policy = _prepared_policy(policy, problem)
        if estimator is None or isinstance(estimator, str):
            name = estimator or problem.controller.estimator
            self.estimator = estimator_by_name(name, problem)
        else:
            self.estimator = copy.deepcopy(estimator)
        initial = getattr(self.policy, "initial", None)
        self.incumbent: str = initial if initial in problem.candidates else problem.initial
        self.previous = self.incumbent
        self.dwell = 0
        self.nodes = tuple(problem.fabric.nodes)
        self.log = Log()
        self._cores = np.array([node.cores for node in problem.fabric.nodes.values()], float)
        self._deadline_ns = round(problem.pipeline.deadline_ms * 1e6)
        self._censor_ns = round(problem.censor_ms * 1e6)

    @property
    def never_moves(self) -> bool:
        """Whether all windows may be closed at once, because nothing decided in one matters."""
        return type(self.policy) is Static and type(self.estimator) is Profile

    def close(self, window: ClosedWindow) -> str:
        """Look at a closed window and decide the placement of the cycles after it.

        Returns
        -------
        str
            Name of the candidate; the incumbent's where nothing moves.

        Raises
        ------
        PolicyError
            If the policy returns neither a decision nor a candidate's name.
        """
        age_ns = window.close_ns - window.release_ns
        missed = int(missed_cycles(window.latency_ns, age_ns, self._deadline_ns))
        l95_ms = int(seen_l95_ns(window.latency_ns, age_ns, self._censor_ns)) / 1e6
        used = self.utilisation(window).tolist()
        span_ns = window.close_ns - window.open_ns
        own = utilisation(window.own_ns, self._cores, span_ns).tolist()
        return self.decide(
            QoS(l95_ms, missed / len(age_ns), FrozenDict(zip(self.nodes, used, strict=True))),
            dict(zip(self.nodes, own, strict=True)),
        )

    def utilisation(self, window: ClosedWindow) -> Floats:
        """Busy share of every node's cores, shape (..., nodes)."""
        return utilisation(window.busy_ns, self._cores, window.close_ns - window.open_ns)

    def decide(self, observed: QoS, own: Mapping[str, float]) -> str:
        """Decide on metrics that are already aggregated (see `close`)."""
        incumbent = self.incumbent
        candidates = self.problem.candidates
        measured = cost(
            observed, candidates[incumbent], candidates[self.previous], self.problem.objective
        )
        estimates = dict(self.estimator.estimate(observed=observed, incumbent=incumbent, own=own))
        estimates[incumbent] = observed
        decision = self._checked(self.policy.decide(observed=observed, estimates=estimates))
        log = self.log
        log.incumbent.append(incumbent)
        log.seen_l95_ms.append(observed.l95_ms)
        log.seen_violation_rate.append(observed.violation_rate)
        log.cost.append(measured)
        log.decisions.append(decision)
        log.estimates.append(estimates)
        self.previous = incumbent
        self.incumbent = decision.name
        self.dwell = decision.dwell
        return decision.name

    def miss(self) -> None:
        """Record a window whose close the controller did not see, because its node was down."""
        log = self.log
        log.incumbent.append(self.incumbent)
        log.seen_l95_ms.append(math.nan)
        log.seen_violation_rate.append(math.nan)
        log.cost.append(math.nan)
        log.decisions.append(None)
        log.estimates.append({})
        self.previous = self.incumbent

    def _checked(self, decision: Decision | str) -> Decision:
        """Bring what a policy returned into the form of a decision."""
        candidates = self.problem.candidates
        who = type(self.policy).__name__
        name = decision.name if isinstance(decision, Decision) else decision
        if not isinstance(name, str) or name not in candidates:
            raise PolicyError(
                f"{who}.decide returned {decision!r} at window {len(self.log.decisions)}; "
                f"it must be a Decision or a candidate's name: {', '.join(candidates)}"
            )
        if isinstance(decision, Decision):
            if decision.placement != candidates[name] or decision.migrated != (
                name != self.incumbent
            ):
                raise PolicyError(
                    f"{who}.decide returned a decision for {name!r} at window "
                    f"{len(self.log.decisions)} whose placement or `migrated` contradicts its "
                    f"name (incumbent: {self.incumbent!r})"
                )
            return decision
        migrated = name != self.incumbent
        return Decision(
            placement=candidates[name],
            name=name,
            migrated=migrated,
            reason="migrate" if migrated else "hold",
            dwell=0 if migrated else self.dwell + 1,
        )


def _prepared_policy(policy: MinimalPolicy | str | None, problem: Problem) -> MinimalPolicy:
    """Return a started copy of a policy."""
    if policy is None or isinstance(policy, str):
        prepared: MinimalPolicy = policy_by_name(policy or problem.controller.policy, problem)
    else:
        if not callable(getattr(policy, "decide", None)):
            raise PolicyError(
                f"{policy!r} is no policy: it has no method decide(observed=..., estimates=...)"
            )
        prepared = copy.deepcopy(policy)
    start = getattr(prepared, "start", None)
    if start is not None:
        start(problem)
    return prepared


def static_columns(
    controller: Controller, window: ClosedWindow
) -> tuple[dict[str, Floats], dict[str, dict[str, Floats]]]:
    """Metrics, costs and estimates of all windows of a run that never moves, in one go.

    Bit for bit what `Controller.close` gives window by window (tested).

    Parameters
    ----------
    controller : Controller
        With `never_moves`.
    window : ClosedWindow
        All windows as rows.

    Returns
    -------
    seen : dict of str to float64 array, shape (windows,)
        ``l95_ms``, ``violation_rate``, ``cost`` and ``u_<node>``.
    estimated : dict of candidate to dict of str to float64 array
        ``l95_ms``, ``violation_rate`` and ``j``.
    """
    problem, name = controller.problem, controller.incumbent
    age_ns = window.close_ns - window.release_ns
    missed = missed_cycles(window.latency_ns, age_ns, controller._deadline_ns)
    span_ns = window.close_ns - window.open_ns
    used = controller.utilisation(window)
    own = utilisation(window.own_ns, controller._cores, span_ns)
    seen = {
        "l95_ms": seen_l95_ns(window.latency_ns, age_ns, controller._censor_ns) / 1e6,
        "violation_rate": missed / age_ns.shape[-1],
    }
    by_node = {node: used[:, i] for i, node in enumerate(controller.nodes)}
    seen["cost"] = _priced(problem, seen["l95_ms"], seen["violation_rate"], by_node, 0.0)
    foreign = np.maximum(used - own, 0.0)
    estimator = controller.estimator
    assert isinstance(estimator, Profile)
    estimated: dict[str, dict[str, Floats]] = {}
    for candidate, placement in problem.candidates.items():
        l95_ms, violation_rate, busy = seen["l95_ms"], seen["violation_rate"], by_node
        if candidate != name:
            l95_ms = np.full(len(used), estimator.l95_ms[candidate])
            violation_rate = np.full(len(used), estimator.violation_rate[candidate])
            work = estimator.own[candidate]
            busy = {
                node: np.minimum(foreign[:, i] + work[node], 1.0)
                for i, node in enumerate(controller.nodes)
            }
        switching = hamming(placement, problem.candidates[name])
        estimated[candidate] = {
            "l95_ms": l95_ms,
            "violation_rate": violation_rate,
            "j": _priced(problem, l95_ms, violation_rate, busy, switching),
        }
    seen.update({f"u_{node}": values for node, values in by_node.items()})
    return seen, estimated


def _priced(
    problem: Problem,
    l95_ms: Floats,
    violation_rate: Floats,
    by_node: Mapping[str, Floats],
    switching: float,
) -> Floats:
    tiers = [
        np.maximum.reduce([by_node[node] for node in nodes]) if nodes else np.zeros_like(l95_ms)
        for nodes in tier_nodes(problem.objective)
    ]
    return price(l95_ms, violation_rate, tiers[0], tiers[1], tiers[2], switching, problem.objective)
