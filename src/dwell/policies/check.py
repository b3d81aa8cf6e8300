"""Test a policy on windows where policies often fail.

A controller could produce all of these windows: the incumbent's estimate equals the observation,
and the incumbent follows from the policy's own decisions.
"""

from __future__ import annotations

import copy
import math
import random
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import Any, NoReturn

from dwell.model.frozen import FrozenDict
from dwell.model.placement import Nodes
from dwell.model.problem import Problem
from dwell.model.qos import REASONS, Decision, QoS
from dwell.policies.protocol import MinimalPolicy

#: CPU time of one call, in seconds, above which the call counts as endless.
LIMIT_S = 5.0

SHORT, LONG = 24, 300
WALK_SEED = 1

#: A window: the metrics of every candidate.
Window = Mapping[str, QoS]


@dataclass(frozen=True, slots=True)
class Situation:
    """A sequence of windows, and the candidates that a guard moves the cell to, by window."""

    name: str
    windows: tuple[Window, ...]
    moves: Mapping[int, str] = field(default_factory=dict)


class _BrokenOffError(Exception):
    """A recorded fault ends the run."""


class _EndlessError(BaseException):
    """Raised inside a call that does not return; no `except Exception` stops it."""


def check_policy(policy: MinimalPolicy, problem: Problem) -> tuple[str, ...]:
    """Run copies of a policy through difficult windows and return the rules that it breaks.

    The windows: all metrics zero, every node saturated, latencies at their bound, every candidate
    over its caps, ties, a different best candidate in each window, estimates with large errors,
    hundreds of windows of a random walk, and a guard that moves the cell (if the policy has
    ``adopt``). In each of them the policy must

    * raise nothing, and return within `LIMIT_S` of CPU time;
    * return a candidate's name, or a Decision whose name, placement, reason and flag agree;
    * leave its arguments unchanged;
    * repeat its decisions after ``start`` (or as a new copy, if it has no ``start``).

    Parameters
    ----------
    policy : MinimalPolicy
        Left as it is; it must allow ``copy.deepcopy``.

    Returns
    -------
    tuple of str
        One sentence per kind of fault, about its first occurrence; empty if the policy passes.

    Notes
    -----
    The limit is a timer of the main thread (``signal.ITIMER_VIRTUAL``). Other threads have no
    limit: there, a policy that never returns blocks the caller.
    """
    if not callable(getattr(policy, "decide", None)):
        return ("it has no method decide(*, observed, estimates)",)
    try:
        copy.deepcopy(policy)
    except Exception as error:
        return (f"it cannot be copied: copy.deepcopy raised {error!r}",)
    check = _Check(policy, problem)
    for situation in _situations(problem):
        check.play_twice(situation)
        if "endless" in check.faults:
            break
    return tuple(check.faults.values())


class _Check:
    """The first fault of each kind found in one policy."""

    def __init__(self, policy: MinimalPolicy, problem: Problem) -> None:
        self.policy = policy
        self.problem = problem
        self.placements = _placements(problem)
        self.no_candidate = f"which is no candidate (candidates: {', '.join(self.placements)})"
        self.faults: dict[str, str] = {}

    def note(self, kind: str, sentence: str) -> None:
        """Record a fault, unless one of its kind is known."""
        self.faults.setdefault(kind, sentence)

    def stop(self, kind: str, sentence: str) -> NoReturn:
        """Record a fault and end the run."""
        self.note(kind, sentence)
        raise _BrokenOffError

    def play_twice(self, situation: Situation) -> None:
        """Run a situation twice, with a restart in between, and compare the decisions."""
        policy = copy.deepcopy(self.policy)
        first = self.play(policy, situation)
        if len(first) < len(situation.windows):
            return
        if not hasattr(policy, "start"):
            policy = copy.deepcopy(self.policy)
        again = self.play(policy, situation)
        for window, (one, other) in enumerate(zip(first, again, strict=False)):
            if one != other:
                self.note(
                    "restart",
                    f"the same windows gave other decisions after a restart, first in window "
                    f"{window} of {situation.name!r}: {other} instead of {one}; "
                    "start() must forget everything, and randomness needs a fixed seed",
                )
                return

    def play(self, policy: Any, situation: Situation) -> list[str]:
        """Return the decisions of one run, up to the first fault that ends it."""
        decisions: list[str] = []
        with suppress(_BrokenOffError):
            if start := getattr(policy, "start", None):
                self.call("start", "a run", start, self.problem)
            incumbent = getattr(policy, "initial", None) or self.problem.initial
            if incumbent not in self.placements:
                self.stop("initial", f"its initial is {incumbent!r}, {self.no_candidate}")
            adopt = getattr(policy, "adopt", None)
            for index, window in enumerate(situation.windows):
                where = f"window {index} of {situation.name!r}"
                if index in situation.moves and adopt is not None:
                    incumbent = situation.moves[index]
                    self.call("adopt", where, adopt, incumbent)
                answer = self.decide(policy, window, incumbent, where)
                incumbent = self.judge(answer, incumbent, where)
                decisions.append(str(answer))
        return decisions

    def decide(self, policy: Any, window: Window, incumbent: str, where: str) -> object:
        """Return the policy's decision on a window."""
        observed, estimates = window[incumbent], FrozenDict(window)
        before = repr(estimates)
        answer = self.call("decide", where, policy.decide, observed=observed, estimates=estimates)
        if repr(estimates) != before:
            self.stop("mutates", f"it changed the metrics it was given, in {where}")
        if _placements(self.problem) != self.placements:
            self.stop("mutates", f"it changed the candidates of the problem, in {where}")
        return answer

    def judge(self, answer: object, incumbent: str, where: str) -> str:
        """Return the name of the chosen candidate, after recording faults of the decision."""
        name = answer.name if isinstance(answer, Decision) else answer
        if not isinstance(name, str):
            self.stop(
                "answer",
                f"it returned {answer!r} in {where}; it must return a Decision, or the name of a "
                "candidate",
            )
        if name not in self.placements:
            self.stop("answer", f"it chose {name!r} in {where}, {self.no_candidate}")
        if isinstance(answer, Decision):
            for kind, fault in _contradictions(answer, incumbent, self.placements):
                self.note(kind, f"it returned a Decision for {name} in {where} {fault}")
        return name

    def call(
        self, name: str, where: str, method: Callable[..., object], *args: object, **named: object
    ) -> object:
        """Return what a method of the policy returns."""
        try:
            with _limited(LIMIT_S):
                return method(*args, **named)
        except _EndlessError:
            self.stop("endless", f"{name}() did not return within {LIMIT_S:g} s of CPU in {where}")
        except Exception as error:
            self.stop(f"raises {name}", f"{name}() raised {error!r} in {where}")


def _placements(problem: Problem) -> dict[str, dict[str, Nodes]]:
    return {name: dict(moves) for name, moves in problem.candidates.items()}


def _contradictions(
    decision: Decision, incumbent: str, placements: Mapping[str, Mapping[str, Nodes]]
) -> Iterator[tuple[str, str]]:
    """Yield the kind and the description of each contradiction within a decision."""
    placement, reason, dwell = decision.placement, decision.reason, decision.dwell
    if not isinstance(placement, Mapping) or dict(placement) != placements[decision.name]:
        yield "placement", f"with another placement than that candidate's: {placement!r}"
    moves = decision.name != incumbent
    if decision.migrated is not moves:
        yield (
            "migrated",
            f"with migrated={decision.migrated!r}, when {incumbent} was the incumbent",
        )
    fitting = ("migrate", "capped") if moves else ("dwell", "hold")
    if reason not in REASONS:
        yield "reason", f"with reason {reason!r}; it must be one of {', '.join(REASONS)}"
    elif reason not in (*fitting, "infeasible", "guard"):
        yield "reason", f"that {'migrates' if moves else 'stays'}, with reason {reason!r}"
    if isinstance(dwell, bool) or not isinstance(dwell, int) or dwell < 0:
        yield "dwell", f"with dwell {dwell!r}; it must be a whole number from 0"
    for candidate, value in decision.costs.items():
        if candidate not in placements or not math.isfinite(value):
            yield (
                "costs",
                f"with the cost {value!r} for {candidate!r}; costs are finite and for candidates "
                "only",
            )


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise _EndlessError inside the block once it has used this much CPU time."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise _EndlessError

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def _situations(problem: Problem) -> Iterator[Situation]:
    """Yield the difficult windows for a problem's candidates and resources."""
    names = list(problem.candidates)
    deadline, bound = problem.pipeline.deadline_ms, problem.censor_ms
    caps = problem.objective.caps

    def qos(l95_ms: float, violation_rate: float, used: float) -> QoS:
        return _qos(problem, l95_ms, violation_rate, dict.fromkeys(problem.fabric.resources, used))

    def alike(l95_ms: float, violation_rate: float, used: float) -> tuple[Window, ...]:
        return (dict.fromkeys(names, qos(l95_ms, violation_rate, used)),) * SHORT

    good, bad = qos(0.5 * deadline, 0.0, 0.2), qos(3 * deadline, 1.0, 0.9)
    best = [{name: good if name == winner else bad for name in names} for winner in names]
    turns = tuple(best[k % len(names)] for k in range(SHORT))
    over_ms = 2 * caps.latency_ms if math.isfinite(caps.latency_ms) else bound
    over = 2 * caps.utilisation if math.isfinite(caps.utilisation) else 1.0
    yield Situation("all metrics zero", alike(0.0, 0.0, 0.0))
    yield Situation("every node saturated", alike(0.8 * deadline, 0.0, 1.0))
    yield Situation("latencies at their bound", alike(bound, 1.0, 0.5))
    yield Situation("every candidate over its caps", alike(over_ms, 1.0, over))
    yield Situation("ties", alike(0.8 * deadline, 0.02, 0.4))
    yield Situation("another candidate is the best in every window", turns)
    yield Situation("estimates with large errors", tuple(map(_uncertain, turns)))
    yield Situation("a random walk", tuple(_walk(problem, LONG)))
    moves = {k: names[k // 3 % len(names)] for k in range(0, SHORT, 3)}
    yield Situation("a guard moves the cell", turns, moves)


def _uncertain(window: Window) -> Window:
    return {
        name: replace(qos, error=(qos.l95_ms, qos.violation_rate)) for name, qos in window.items()
    }


def _walk(problem: Problem, windows: int) -> Iterator[Window]:
    """Yield windows whose metrics drift, each candidate's on its own."""
    rng = random.Random(WALK_SEED)  # noqa: S311 - a fixed sequence is the point
    names, resources = list(problem.candidates), list(problem.fabric.resources)
    logs = dict.fromkeys(names, 0.0)
    used = {name: dict.fromkeys(resources, 0.5) for name in names}
    for _ in range(windows):
        window = {}
        for name in names:
            logs[name] = 0.95 * logs[name] + rng.gauss(0, 0.2)
            for one in resources:
                used[name][one] = min(1.0, max(0.0, used[name][one] + rng.gauss(0, 0.1)))
            l95_ms = min(problem.pipeline.deadline_ms * math.exp(logs[name]), problem.censor_ms)
            rate = min(1.0, max(0.0, rng.gauss(0.3 * logs[name], 0.1)))
            window[name] = _qos(problem, l95_ms, rate, used[name])
        yield window


def _qos(problem: Problem, l95_ms: float, rate: float, used: Mapping[str, float]) -> QoS:
    """Return a QoS with a mean age, a price and a share of misses, if the objective has them."""
    objective = problem.objective
    return QoS(
        l95_ms,
        rate,
        used,
        age_ms=l95_ms if objective.weighs_age else None,
        misses=rate if objective.caps.misses is not None else None,
        price_per_hour=max(used.values()) if objective.weighs_price else None,
    )
