"""Parameters of Dwell's policies as plain numbers, for the kernel of the simulator.

The classes of `dwell.policies` and `dwell.estimators.profile` are the reference. The kernel
implements some of them a second time, and needs these numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from dwell.control.controller import Controller
from dwell.cost import GAIN_TOLERANCE, hamming, tier_nodes
from dwell.estimators import Profile
from dwell.model import Objective
from dwell.model.number_arrays import Floats
from dwell.policies import ATP, DTP, Cusum, LatencyFirst, Static


class PlainRule(NamedTuple):
    """A policy and an estimator in numbers; candidates and resources in the problem's order.

    Parameters
    ----------
    policy : str
        ``static``, ``latency_first``, ``dtp``, ``cusum`` or ``atp``.
    numbers : mapping of str to float
        Numbers of the policy, weights, targets and caps of its objective.
    options : mapping of str to float64 array, shape (candidates,)
        Expected metrics of each candidate, and whether its toggled task is on a robot.
    work : float64 array, shape (candidates, resources)
        Share of each resource that the cell's own work takes.
    switching : float64 array, shape (candidates, candidates)
        S of a move from one candidate (row) to another (column).
    tiers : tuple of str
        Tier of each resource in J: ``robot``, ``edge`` or ``cloud``; empty if it is not in J.
    """

    policy: str
    numbers: Mapping[str, float]
    options: Mapping[str, Floats]
    work: Floats
    switching: Floats
    tiers: tuple[str, ...]


def plain_rule(controller: Controller) -> PlainRule | None:
    """Return the rule of a controller before its first window; None if the kernel has no such rule.

    The kernel needs one of the policies in `_KNOWN` and the estimator `Profile`, subclasses
    excluded. The policy must use the candidates of the problem, and its objective, if any. The
    objective has neither ages nor a cap on misses, and links have no prices.
    """
    problem, policy, profile = controller.problem, controller.policy, controller.estimator
    called, numbers = _KNOWN.get(type(policy), ("", None))
    if numbers is None or type(profile) is not Profile:
        return None
    own: Any = policy
    if list(own.candidates.items()) != list(problem.candidates.items()):
        return None
    if own.objective not in (None, problem.objective) or problem.objective.beyond_cycles:
        return None
    if problem.fabric.has_prices:
        return None
    names, placed = list(problem.candidates), list(own.candidates.values())
    resources = list(problem.fabric.resources)
    known = {
        "l95_ms": profile.l95_ms,
        "uncut_ms": profile.uncut_l95_ms,
        "violation_rate": profile.violation_rate,
        "on_robot": _on_robot(own) if isinstance(own, ATP) else dict.fromkeys(names, 0.0),
    }
    tier_of = {
        name: tier
        for tier, members in tier_nodes(problem.objective)._asdict().items()
        for name in members
    }
    return PlainRule(
        policy=called,
        numbers={
            **numbers(own, names),
            **_objective(problem.objective),
            "gain_tolerance": GAIN_TOLERANCE,
            "is_priced": own.objective is not None,
            "incumbent": names.index(controller.course.placement),
            "previous": names.index(controller.course.previous),
            "dwell": controller.course.dwell,
        },
        options={name: np.array([by[one] for one in names]) for name, by in known.items()},
        work=np.array([[profile.own[name][one] for one in resources] for name in names]),
        switching=np.array([[hamming(b, a) for b in placed] for a in placed]),
        tiers=tuple(tier_of.get(one, "") for one in resources),
    )


def _objective(objective: Objective) -> dict[str, float]:
    weights, targets, caps = objective.weights, objective.targets, objective.caps
    apart = weights.cloud is not None and targets.cloud is not None
    return {
        "weight_latency": weights.latency,
        "weight_violations": weights.violations,
        "weight_robot": weights.robot,
        "weight_edge": weights.edge,
        "weight_cloud": weights.cloud or 0.0,
        "weight_switching": weights.switching,
        "target_ms": targets.latency_ms,
        "target_robot": targets.robot,
        "target_edge": targets.edge,
        # 0 if J has no term of the cloud.
        "target_cloud": (targets.cloud or 0.0) if apart else 0.0,
        "cap_ms": caps.latency_ms,
        "cap_utilisation": caps.utilisation,
    }


def _of_dtp(policy: DTP, names: list[str]) -> dict[str, float]:
    return {
        "min_dwell": policy.min_dwell,
        "min_improvement": policy.min_improvement,
        "escape": policy.escape,
    }


def _of_cusum(policy: Cusum, names: list[str]) -> dict[str, float]:
    return {"threshold": policy.threshold, "slack": policy.slack, "memory": policy.memory}


def _of_atp(policy: ATP, names: list[str]) -> dict[str, float]:
    return {
        "min_dwell": policy.min_dwell,
        "local": names.index(policy.local),
        "offload": names.index(policy.offload),
        "every_windows": policy.every_windows,
        "most_ms": policy.latency_ms,
        "most_robot": policy.robot,
        "most_outside": policy.edge,
        "outside_is_cloud": policy.on_cloud,
    }


def _on_robot(policy: ATP) -> dict[str, float]:
    tiers, task = policy.objective.tiers, policy.pair.task
    return {
        name: float(tiers.get(placement.first[task]) == "robot")
        for name, placement in policy.candidates.items()
    }


#: Name of each policy in the kernel, and the function that returns its numbers.
_KNOWN: dict[type, tuple[str, Callable[[Any, list[str]], dict[str, float]] | None]] = {
    Static: ("static", lambda policy, names: {}),
    LatencyFirst: ("latency_first", lambda policy, names: {}),
    DTP: ("dtp", _of_dtp),
    Cusum: ("cusum", _of_cusum),
    ATP: ("atp", _of_atp),
}
