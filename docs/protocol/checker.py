"""Checker: every state that a small model can reach, and the shortest way to a wrong one."""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Generic, NamedTuple, TypeVar

State = TypeVar("State", bound=Hashable)


class Step(NamedTuple, Generic[State]):
    """What may happen next.

    Parameters
    ----------
    label : str
        What happens.
    state : State
        What it leads to.
    fault : bool
        Whether it is a fault: nothing that the cell relies on to recover.
    wrong : str
        What is wrong with the step itself; empty where nothing is.
    """

    label: str
    state: State
    fault: bool = False
    wrong: str = ""


@dataclass(frozen=True, slots=True)
class Rules:
    """Which rules of a model are in force: all but those that are left out."""

    without: frozenset[str] = frozenset()

    def holds(self, rule: str) -> bool:
        """Whether a rule is in force."""
        return rule not in self.without


class ViolationError(AssertionError):
    """Something that must never happen, and the shortest way to it."""

    def __init__(self, wrong: str, way: Iterable[str]) -> None:
        self.wrong, self.way = wrong, tuple(way)
        super().__init__("\n  ".join((wrong, *self.way)))


@dataclass(frozen=True, slots=True)
class Explored(Generic[State]):
    """All states, each with the steps that lead on from it."""

    steps: dict[State, list[Step[State]]]
    came_from: dict[State, tuple[State, str] | None]
    depth: int

    def way(self, state: State) -> list[str]:
        """Return the labels of the shortest way to a state."""
        found = []
        came = self.came_from[state]
        while came is not None:
            state, label = came
            found.append(label)
            came = self.came_from[state]
        return found[::-1]


@contextmanager
def _uncollected() -> Iterator[None]:
    """Keep the garbage collector from looking through all states again and again.

    They are tuples in no circles, and there is nothing in them to collect.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@_uncollected()
def explore(
    initial: State, successors: Callable[[State], Iterator[Step[State]]], *, most: int = 2_000_000
) -> Explored[State]:
    """Visit every state that can be reached, nearest first.

    Parameters
    ----------
    initial : State
    successors : callable
        Returns everything that may happen in a state.
    most : int
        States after which a model is taken for unbounded.

    Returns
    -------
    Explored

    Raises
    ------
    ViolationError
        At the first wrong step.
    MemoryError
        If there are more states than `most`.
    """
    explored: Explored[State] = Explored({}, {initial: None}, 0)
    waiting = deque([(initial, 0)])
    depth = 0
    while waiting:
        state, depth = waiting.popleft()
        steps = explored.steps[state] = list(successors(state))
        for step in steps:
            if step.wrong:
                raise ViolationError(step.wrong, (*explored.way(state), step.label))
            if step.state not in explored.came_from:
                explored.came_from[step.state] = state, step.label
                waiting.append((step.state, depth + 1))
        if len(explored.came_from) > most:
            raise MemoryError(f"more than {most} states")
    return Explored(explored.steps, explored.came_from, depth)


@_uncollected()
def stuck(explored: Explored[State], good: Callable[[State], bool]) -> list[State]:
    """Return the states from which no way without a fault leads to a good one.

    Where there are none, a cell that is treated fairly recovers once the faults are over.
    """
    back: dict[State, list[State]] = {state: [] for state in explored.steps}
    for state, steps in explored.steps.items():
        for step in steps:
            if not step.fault:
                back[step.state].append(state)
    saved = {state for state in explored.steps if good(state)}
    waiting = deque(saved)
    while waiting:
        for state in back[waiting.popleft()]:
            if state not in saved:
                saved.add(state)
                waiting.append(state)
    return [state for state in explored.steps if state not in saved]


def without(
    rule: str,
    initial: State,
    cases: Iterable[Callable[..., Iterator[Step[State]]]],
    good: Callable[[State], bool],
) -> ViolationError | None:
    """Return what goes wrong in any case of a model without one of its rules."""
    for successors in cases:
        try:
            found = explore(initial, partial(successors, rules=Rules(frozenset({rule}))))
        except ViolationError as violation:
            return violation
        if lost := stuck(found, good):
            return ViolationError("there is no way back", tuple(found.way(lost[0])))
    return None


def report(
    initial: State,
    cases: Sequence[Callable[..., Iterator[Step[State]]]],
    good: Callable[[State], bool],
    rules: Mapping[str, str],
) -> None:
    """Print what a model can do in each of its cases, and what goes wrong without each rule."""
    for successors in cases:
        found = explore(initial, successors)
        lost = len(stuck(found, good))
        print(f"{len(found.steps)} states, {found.depth} steps deep; from {lost} no way back")
    for rule, text in rules.items():
        wrong = without(rule, initial, cases, good)
        print(f"\nwithout {rule!r} ({text}): {wrong or 'nothing goes wrong'}")
