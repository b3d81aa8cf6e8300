"""Checker: every state that a small model can reach, and the shortest way to a wrong one."""

from __future__ import annotations

import gc
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
    """All states, numbered from the nearest on.

    Numbers are what makes a million steps quick: to look a state up takes its whole content.

    Parameters
    ----------
    numbers : dict
        The number of each state.
    came_from : list
        By number, the first way to a state: the number of the state before, and the step's label.
    leads_to : list
        By number, the states that steps without a fault lead to.
    depths : list of int
        By number, the steps of the shortest way.
    """

    numbers: dict[State, int]
    came_from: list[tuple[int, str] | None]
    leads_to: list[list[int]]
    depths: list[int]

    def way(self, number: int) -> list[str]:
        """Return the labels of the shortest way to a state."""
        found = []
        came = self.came_from[number]
        while came is not None:
            number, label = came
            found.append(label)
            came = self.came_from[number]
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
    explored: Explored[State] = Explored({initial: 0}, [None], [], [0])
    numbers, came_from, depths = explored.numbers, explored.came_from, explored.depths
    states = [initial]
    # New states are appended meanwhile.
    for number, state in enumerate(states):
        leads_to: list[int] = []
        for step in successors(state):
            if step.wrong:
                raise ViolationError(step.wrong, (*explored.way(number), step.label))
            after = numbers.setdefault(step.state, len(states))
            if after == len(states):
                states.append(step.state)
                came_from.append((number, step.label))
                depths.append(depths[number] + 1)
            if not step.fault:
                leads_to.append(after)
        explored.leads_to.append(leads_to)
        if len(states) > most:
            raise MemoryError(f"more than {most} states")
    return explored


@_uncollected()
def stuck(explored: Explored[State], good: Callable[[State], bool]) -> list[State]:
    """Return the states from which no way without a fault leads to a good one.

    Where there are none, a cell that is treated fairly recovers once the faults are over.
    """
    back: list[list[int]] = [[] for _ in explored.leads_to]
    for number, leads_to in enumerate(explored.leads_to):
        for after in leads_to:
            back[after].append(number)
    saved = [good(state) for state in explored.numbers]
    waiting = [number for number, is_saved in enumerate(saved) if is_saved]
    while waiting:
        for number in back[waiting.pop()]:
            if not saved[number]:
                saved[number] = True
                waiting.append(number)
    return [state for state, is_saved in zip(explored.numbers, saved, strict=True) if not is_saved]


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
            return ViolationError("there is no way back", tuple(found.way(found.numbers[lost[0]])))
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
        deep = found.depths[-1]
        print(f"{len(found.numbers)} states, {deep} steps deep; from {lost} no way back")
    for rule, text in rules.items():
        wrong = without(rule, initial, cases, good)
        print(f"\nwithout {rule!r} ({text}): {wrong or 'nothing goes wrong'}")
