"""Policies by the names that a cell file and the command line use."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from dwell.errors import PolicyError
from dwell.model.meaning import nearest_of
from dwell.model.problem import Problem
from dwell.policies.atp import ATP
from dwell.policies.atp_thresholds import ATPThresholds, Pair, find_pairs
from dwell.policies.cusum import Cusum
from dwell.policies.dtp import DTP
from dwell.policies.latency_first import LatencyFirst
from dwell.policies.protocol import Policy
from dwell.policies.static import Static
from dwell.policies.work_function import WorkFunction

__all__ = ["REGISTRY", "by_name"]

Toggled = TypeVar("Toggled", bound=ATPThresholds)


def by_name(name: str, problem: Problem) -> Policy:
    """Make a policy with the parameters of ``problem.controller``.

    Parameters
    ----------
    name : str
        A policy's name, or a candidate's for the placement that never moves.
    problem : Problem

    Raises
    ------
    PolicyError
        If there is none of that name (the message lists the known ones), or the problem has no
        candidates that the policy could work with.
    """
    if name in REGISTRY:
        return REGISTRY[name](problem)
    if name in problem.candidates:
        return Static(candidates=problem.candidates, initial=name, objective=problem.objective)
    known = [*REGISTRY, *problem.candidates]
    raise PolicyError(f"unknown policy {name!r}; {nearest_of(name, known, 'policies')}")


def _dtp(problem: Problem) -> DTP:
    return DTP(
        candidates=problem.candidates,
        initial=problem.initial,
        objective=problem.objective,
        min_dwell=problem.controller.min_dwell,
        min_improvement=problem.controller.min_improvement,
        escape=problem.controller.escape,
    )


def _toggled(kind: type[Toggled], problem: Problem) -> Toggled:
    """Make a policy that toggles one task: the heaviest, of pairs with the initial candidate."""
    pairs = find_pairs(problem.candidates, problem.objective.tiers)

    def robot_time_ms(pair: Pair) -> float:
        task = problem.pipeline.tasks[pair.task]
        on_robot = task.on[problem.candidates[pair.local][pair.task]]
        scale = 1.0 if task.scale is None else problem.pipeline.scales[task.scale].expectation
        return on_robot.exec_ms.expectation * scale

    # The heaviest stage is the one worth offloading; max() keeps the first of equals.
    pair = max(
        pairs,
        key=lambda pair: (problem.initial in pair[:2], robot_time_ms(pair)),
        default=None,
    )
    return kind(
        candidates=problem.candidates,
        initial=problem.initial,
        objective=problem.objective,
        local=pair.local if pair else None,
        offload=pair.offload if pair else None,
        min_dwell=problem.controller.min_dwell,
    )


def _atp(problem: Problem) -> ATP:
    return _toggled(ATP, problem)


def _atp_thresholds(problem: Problem) -> ATPThresholds:
    return _toggled(ATPThresholds, problem)


def _latency_first(problem: Problem) -> LatencyFirst:
    return LatencyFirst(
        candidates=problem.candidates, initial=problem.initial, objective=problem.objective
    )


def _work_function(problem: Problem) -> WorkFunction:
    return WorkFunction(
        candidates=problem.candidates, initial=problem.initial, objective=problem.objective
    )


def _cusum(problem: Problem) -> Cusum:
    return Cusum(
        candidates=problem.candidates,
        initial=problem.initial,
        objective=problem.objective,
        slack=problem.controller.min_improvement,
    )


#: Makers by name; the same names as ``dwell.model.problem.POLICIES``.
REGISTRY: dict[str, Callable[[Problem], Policy]] = {
    "dtp": _dtp,
    "atp": _atp,
    "atp-thresholds": _atp_thresholds,
    "latency-first": _latency_first,
    "work-function": _work_function,
    "cusum": _cusum,
}
