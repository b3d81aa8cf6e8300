"""Whether a policy keeps its word in the windows where policies break.

The windows are what a controller could really show: the incumbent's estimate is what was
observed, and which candidate is the incumbent follows from the policy's own decisions.
"""

from __future__ import annotations

import copy
import math
import random
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, Any, get_args

from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS, Reason
from dwell.policies.protocol import MinimalPolicy

if TYPE_CHECKING:
    from _typeshed import TraceFunction

#: Lines of Python that one decision may execute before it counts as never ending.
MAX_LINES = 100_000

SHORT, LONG = 24, 300
WALK_SEED = 1

#: A window: the metrics of every candidate.
Window = Mapping[str, QoS]


@dataclass(frozen=True, slots=True)
class Situation:
    """Windows in a row, and the candidates that a guard moves the cell to, by window."""

    name: str
    windows: tuple[Window, ...]
    moves: Mapping[int, str] = field(default_factory=dict)


class _EndlessError(BaseException):
    """Raised inside a decision that has executed too many lines; no `except Exception` stops it."""


def check_policy(policy: MinimalPolicy, problem: Problem) -> tuple[str, ...]:
    """Run copies of a policy through awkward windows and say what it breaks.

    The windows: all metrics zero, every node saturated, latencies at their bound, every candidate
    over its caps, ties, an incumbent that is always the worst, hundreds of windows of a random
    walk, and a guard that moves the cell (where the policy has ``adopt``). In each of them it must

    * raise nothing, and return within `MAX_LINES` lines of Python;
    * return a candidate's name, or a Decision whose name, placement, reason and flag agree;
    * leave alone what it was given;
    * decide the same again after ``start`` (a fresh copy, where it has none).

    Parameters
    ----------
    policy : MinimalPolicy
        Left as it is; it must allow ``copy.deepcopy``.

    Returns
    -------
    tuple of str
        One sentence for each kind of fault, about its first occurrence; empty if there is none.

    Notes
    -----
    Lines are counted by ``sys.settrace``; a debugger or a coverage tool is suspended meanwhile.
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
    return tuple(check.faults.values())


class _Check:
    """The faults found so far in one policy, one of each kind."""

    def __init__(self, policy: MinimalPolicy, problem: Problem) -> None:
        self.policy = policy
        self.problem = problem
        self.placements = {name: dict(moves) for name, moves in problem.candidates.items()}
        self.faults: dict[str, str] = {}

    def note(self, kind: str, sentence: str) -> None:
        """Keep the first sentence of each kind."""
        self.faults.setdefault(kind, sentence)

    def play_twice(self, situation: Situation) -> None:
        """Play a situation, restart, play it again, and compare."""
        policy = copy.deepcopy(self.policy)
        first = self.play(policy, situation)
        if not hasattr(policy, "start"):
            policy = copy.deepcopy(self.policy)
        again = self.play(policy, situation)
        for window, (one, other) in enumerate(zip(first, again, strict=False)):
            if one != other and len(first) == len(situation.windows):
                self.note(
                    "restart",
                    f"the same windows gave other decisions after a restart, first in window "
                    f"{window} of {situation.name!r}: {other} instead of {one}; "
                    "start() must forget everything, and randomness needs a fixed seed",
                )
                return

    def play(self, policy: MinimalPolicy, situation: Situation) -> list[object]:
        """Return the decisions of one run, as far as it got."""
        decisions: list[object] = []
        start = getattr(policy, "start", None)
        if start is not None and not self.call("start", partial(start, self.problem), "a run"):
            return decisions
        incumbent = getattr(policy, "initial", None) or self.problem.initial
        if incumbent not in self.placements:
            self.note("initial", f"its initial is {incumbent!r}, {self.no_candidate()}")
            return decisions
        for index, window in enumerate(situation.windows):
            where = f"window {index} of {situation.name!r}"
            moved_to = situation.moves.get(index)
            adopt = getattr(policy, "adopt", None)
            if moved_to is not None and adopt is not None:
                incumbent = moved_to
                if not self.call("adopt", partial(adopt, incumbent), where):
                    return decisions
            outcome = self.decide(policy, window, incumbent, where)
            if outcome is None:
                return decisions
            name, decision = outcome
            decisions.append(decision)
            incumbent = name
        return decisions

    def decide(
        self, policy: MinimalPolicy, window: Window, incumbent: str, where: str
    ) -> tuple[str, object] | None:
        """Return the name decided and what can be compared, or None where it cannot go on."""
        observed, estimates = window[incumbent], dict(window)
        before = repr(estimates)
        answers: list[object] = []

        def act() -> None:
            answers.append(policy.decide(observed=observed, estimates=estimates))

        if not self.call("decide", act, where):
            return None
        if repr(estimates) != before:
            self.note("mutates", f"it changed the metrics it was given, in {where}")
            return None
        if {name: dict(moves) for name, moves in self.problem.candidates.items()} != (
            self.placements
        ):
            self.note("mutates", f"it changed the candidates of the problem, in {where}")
            return None
        return self.judge(answers[0], incumbent, where)

    def judge(self, answer: object, incumbent: str, where: str) -> tuple[str, object] | None:
        """Return the name decided and what can be compared, or None where there is no name."""
        name = answer.name if isinstance(answer, Decision) else answer
        if not isinstance(name, str):
            self.note(
                "answer",
                f"it returned {answer!r} in {where}; it must return a Decision, or the name of a "
                "candidate",
            )
            return None
        if name not in self.placements:
            self.note("answer", f"it chose {name!r} in {where}, {self.no_candidate()}")
            return None
        if not isinstance(answer, Decision):
            return name, name
        said = f"it returned a Decision for {name} in {where}"
        if not isinstance(answer.placement, Mapping) or (
            dict(answer.placement) != self.placements[name]
        ):
            self.note(
                "placement",
                f"{said} with another placement than that candidate's: {answer.placement!r}",
            )
        moves = name != incumbent
        if answer.migrated is not moves:
            self.note(
                "migrated",
                f"{said} with migrated={answer.migrated!r}, when {incumbent} was the incumbent",
            )
        self.judge_reason(answer, moves, said)
        self.judge_record(answer, said)
        costs = tuple((candidate, repr(value)) for candidate, value in answer.costs.items())
        record = (name, answer.migrated, answer.reason, answer.dwell, repr(answer.delta_j), costs)
        return name, record

    def judge_reason(self, decision: Decision, moves: bool, said: str) -> None:
        """Compare the reason with what the decision does."""
        reasons = get_args(Reason)
        if decision.reason not in reasons:
            known = ", ".join(reasons)
            self.note(
                "reason", f"{said} with reason {decision.reason!r}; it must be one of {known}"
            )
        elif (decision.reason in ("migrate", "capped")) > moves or moves > (
            decision.reason in ("migrate", "capped", "infeasible", "guard")
        ):
            verb = "migrates" if moves else "stays"
            self.note("reason", f"{said} that {verb}, with reason {decision.reason!r}")

    def judge_record(self, decision: Decision, said: str) -> None:
        """Check what is only recorded: dwell and costs."""
        dwell = decision.dwell
        if isinstance(dwell, bool) or not isinstance(dwell, int) or dwell < 0:
            self.note("dwell", f"{said} with dwell {dwell!r}; it must be a whole number from 0")
        for candidate, value in decision.costs.items():
            if candidate not in self.placements or not math.isfinite(value):
                self.note(
                    "costs",
                    f"{said} with the cost {value!r} for {candidate!r}; costs are finite and for "
                    "candidates only",
                )

    def call(self, method: str, act: Callable[[], object], where: str) -> bool:
        """Return whether a call came back; note it where it did not."""
        try:
            with _bounded(MAX_LINES):
                act()
        except _EndlessError:
            self.note(
                "endless", f"{method}() did not return within {MAX_LINES} lines of work in {where}"
            )
            return False
        except Exception as error:
            self.note(f"raises {method}", f"{method}() raised {error!r} in {where}")
            return False
        return True

    def no_candidate(self) -> str:
        return f"which is no candidate (candidates: {', '.join(self.placements)})"


@contextmanager
def _bounded(lines: int) -> Iterator[None]:
    """Raise _EndlessError inside the block once it has executed more than `lines` lines."""
    executed = 0

    def trace(frame: FrameType, event: str, argument: Any) -> TraceFunction:
        nonlocal executed
        if event == "line":
            executed += 1
            if executed > lines:
                raise _EndlessError
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


def _situations(problem: Problem) -> Iterator[Situation]:
    """Yield the awkward windows for a problem's candidates and resources."""
    names = list(problem.candidates)
    resources = list(problem.fabric.resources)
    deadline, bound = problem.pipeline.deadline_ms, problem.censor_ms
    caps = problem.objective.caps

    def qos(l95_ms: float, violation_rate: float, used: float) -> QoS:
        return QoS(l95_ms, violation_rate, dict.fromkeys(resources, used))

    def alike(l95_ms: float, violation_rate: float, used: float) -> Window:
        return dict.fromkeys(names, qos(l95_ms, violation_rate, used))

    def best(winner: str) -> Window:
        good, bad = qos(0.5 * deadline, 0.0, 0.2), qos(3 * deadline, 1.0, 0.9)
        return {name: good if name == winner else bad for name in names}

    over_ms = 2 * caps.latency_ms if math.isfinite(caps.latency_ms) else bound
    over = 2 * caps.utilisation if math.isfinite(caps.utilisation) else 1.0
    turns = tuple(best(names[k % len(names)]) for k in range(SHORT))
    yield Situation("all metrics zero", (alike(0.0, 0.0, 0.0),) * SHORT)
    yield Situation("every node saturated", (alike(0.8 * deadline, 0.0, 1.0),) * SHORT)
    yield Situation("latencies at their bound", (alike(bound, 1.0, 0.5),) * SHORT)
    yield Situation("every candidate over its caps", (alike(over_ms, 1.0, over),) * SHORT)
    yield Situation("ties", (alike(0.8 * deadline, 0.02, 0.4),) * SHORT)
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
            window[name] = QoS(l95_ms, rate, used[name])
        yield window
