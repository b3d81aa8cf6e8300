"""Cycles with two copies (live protocol, Replicas) as a model: `python -m docs.protocol.copies`.

A sender sends each cycle to a first copy, and holds its message to the second one. Both copies meet
at a task with a state, whose command a gate applies. Messages may be lost or doubled, and overtake
each other. The task at which they meet may start again. In one cycle the inputs of the second node
are forked, because it gets a state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from docs.protocol.checker import Rules, Step, report

#: What can be left out.
RULES = {
    "first": "the later message of a cycle is dropped where the copies meet",
    "gate": "a command that is not newer than the newest one is dropped",
    "sent": "a held message is sent when its hold ends",
    "heard": "a held message is dropped only if the completion of its cycle has arrived",
    "fork": "no message is dropped in a cycle whose inputs are forked",
}


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may happen.

    Parameters
    ----------
    cycles : int
        Cycles that are stamped.
    faults : int
        Messages that are lost or doubled, and restarts of the task at which copies meet.
    forked : int
        Cycle whose inputs are forked.
    """

    cycles: int = 3
    faults: int = 2
    forked: int = 1


ALL, LIMITS = Rules(), Limits()
CASES = (Limits(),)


class Copies(NamedTuple):
    """One cycle.

    Parameters
    ----------
    first, second : str
        Message of each copy: ``held``, ``sent``, ``in``, ``lost`` or ``dropped``.
    counted : int
        How many times its input counts in the state of the task at which the copies meet.
    """

    first: str = "sent"
    second: str = "held"
    counted: int = 0


class State(NamedTuple):
    """Everything; `joined` is the newest cycle that the task knows, `applied` the actuator's."""

    cycles: tuple[Copies, ...] = ()
    joined: int = -1
    applied: int = -1
    faults: int = 0


def initial() -> State:
    """Return the state in which a cell begins."""
    return State()


def good(state: State) -> bool:
    """Whether the last cycle is applied, or a fault has lost both of its messages."""
    last = state.cycles[-1] if len(state.cycles) == LIMITS.cycles else None
    if last is None:
        return False
    return state.applied == len(state.cycles) - 1 or last[:2] == ("lost", "lost")


def successors(state: State, rules: Rules = ALL, limits: Limits = LIMITS) -> Iterator[Step[State]]:
    """Return everything that may happen next."""
    if len(state.cycles) < limits.cycles:
        stamped = state._replace(cycles=(*state.cycles, Copies()))
        yield Step(f"cycle {len(state.cycles)} is stamped", stamped)
    for number, one in enumerate(state.cycles):
        yield from _holding(state, rules, limits, number)
        for copy in ("first", "second"):
            message = getattr(one, copy)
            if message == "sent":
                arrived = _with(state, number, **{copy: "in"})
                yield _meet(arrived, rules, number, f"the {copy} message of {number} arrives")
            if state.faults == limits.faults:
                continue
            struck = state._replace(faults=state.faults + 1)
            if message == "sent":
                lost = _with(struck, number, **{copy: "lost"})
                yield Step(f"the {copy} message of {number} is lost", lost, fault=True)
            if message == "in":
                yield _meet(struck, rules, number, f"the {copy} message of {number} arrives again")
    if state.faults < limits.faults and state.joined >= 0:
        # Its state is lost, too.
        cycles = tuple(one._replace(counted=0) for one in state.cycles)
        again = state._replace(cycles=cycles, joined=-1, faults=state.faults + 1)
        yield Step("the task starts again", again, fault=True)


def _with(state: State, number: int, **changes: str) -> State:
    """Return the state with one cycle changed."""
    cycles = list(state.cycles)
    cycles[number] = cycles[number]._replace(**changes)  # type: ignore[arg-type]
    return state._replace(cycles=tuple(cycles))


def _holding(state: State, rules: Rules, limits: Limits, number: int) -> Iterator[Step[State]]:
    """What may happen to a held message."""
    if state.cycles[number].second != "held":
        return
    sent = _with(state, number, second="sent" if rules.holds("sent") else "dropped")
    yield Step(f"the hold of {number} ends", sent)
    is_forked = number == limits.forked
    is_done = state.applied >= number or not rules.holds("heard")
    if is_done and not (is_forked and rules.holds("fork")):
        wrong = "a state lacks an input" if is_forked else ""
        dropped = _with(state, number, second="dropped")
        yield Step(f"the held message of {number} is dropped", dropped, wrong=wrong)


def _meet(state: State, rules: Rules, number: int, label: str) -> Step[State]:
    """A message arrives where the copies meet."""
    if number <= state.joined and rules.holds("first"):
        return Step(label, state)
    cycles = list(state.cycles)
    cycles[number] = cycles[number]._replace(counted=cycles[number].counted + 1)
    wrong = "an input counts twice in a state" if cycles[number].counted > 1 else ""
    passes = number > state.applied or not rules.holds("gate")
    if passes and number <= state.applied:
        wrong = wrong or "a command comes twice, or after a later one"
    applied = number if passes else state.applied
    joined = max(state.joined, number)
    after = state._replace(cycles=tuple(cycles), joined=joined, applied=applied)
    return Step(label, after, wrong=wrong)


if __name__ == "__main__":
    report(initial(), [partial(successors, limits=limits) for limits in CASES], good, RULES)
