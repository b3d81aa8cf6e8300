"""What-ifs: changes of a fleet's site that may serve more robots."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

from dwell.model import (
    AR1,
    Constant,
    Exponential,
    Gamma,
    LogNormal,
    Normal,
    Pipeline,
    Problem,
    Uniform,
    evolve,
)
from dwell.model.fleet import Fleet
from dwell.model.pipeline import LONGEST_DEADLINE
from dwell.study.capacity import Capacity, capacity_of

#: Extension of deadlines, ms, and speed-up of a resource.
LATER_MS, FASTER = 10.0, 1.25
#: Largest number of repetitions of a change.
MOST_OFTEN = 4
#: Parameters of a process with the unit of its values.
SCALED = ("value", "mean", "std", "low", "high", "min")
Scalable: TypeAlias = Constant | Uniform | Normal | LogNormal | Gamma | Exponential | AR1


@dataclass(frozen=True, slots=True)
class SiteChange:
    """A change that a site can make.

    Parameters
    ----------
    text : str
        ``a core more on E``.
    make : callable
        Returns the fleet after a number of repetitions of the change.
    repeats : bool
        Whether the change can be repeated.
    twins_of : str
        Shared node that each change duplicates; empty for none.
    """

    text: str
    make: Callable[[int], Fleet] = field(repr=False)
    repeats: bool = False
    twins_of: str = ""

    def capacity(self, count: int = 1, **settings: Any) -> Capacity:
        """Return the capacity of the fleet after the change (see `capacity_of`)."""
        twins = {self.twins_of: count} if self.twins_of else None
        return capacity_of(self.make(count), twins=twins, **settings)


@dataclass(frozen=True, slots=True)
class WhatIf:
    """A change of a fleet, and the capacity after it."""

    change: str
    capacity: Capacity

    def as_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        known = self.capacity.as_json()
        names = ("robots", "at_least", "interval", "limit_on", "phases", "policy", "reason")
        return {"change": self.change, **{name: known[name] for name in names}}


def changes_of(fleet: Fleet) -> Iterator[SiteChange]:
    """Yield the possible changes of a fleet's site, the cheapest first."""
    if fleet.phases != "even":
        yield SiteChange("phases evenly spread", lambda _: fleet.changed(phases="even"))
    cells = [entry.cell for entry in fleet.entries]
    pipelines = [cell.pipeline for cell in cells]
    if all(one.deadline_ms + LATER_MS <= _latest_ms(one) for one in pipelines):
        yield SiteChange(f"deadlines {LATER_MS:g} ms later", lambda _: _changed(fleet, _later))
    for name, resource in cells[0].fabric.resources.items():
        if resource.node not in fleet.shared:
            continue
        path = f"nodes.{resource.node}"
        if resource.kind:
            text, path = f"one {name} more", f"{path}.accelerators.{resource.kind}"
        else:
            text, path = f"a core more on {name}", f"{path}.cores"
        has = round(resource.capacity) if resource.kind else cells[0].fabric.nodes[name].cores

        def more(count: int, path: str = path, has: int = has) -> Fleet:
            return _changed(fleet, lambda cell: evolve(cell, {path: has + count}))

        yield SiteChange(text, more, repeats=True)
    for name in cells[0].fabric.resources:
        if cells[0].fabric.resources[name].node in fleet.shared and _uses(cells, name):
            yield SiteChange(f"{name} {FASTER:g} times as fast", partial(_with_fast, fleet, name))
    for node in fleet.shared:
        yield SiteChange(f"a second server like {node}", lambda _: fleet, True, node)
    first, policy = fleet.entries[0], fleet.policy_of(fleet.entries[0])
    for name, placement in first.cell.candidates.items():
        is_everywhere = all(name in cell.candidates for cell in cells)
        if is_everywhere and name != policy and {*placement.values()} & {*fleet.shared}:
            yield SiteChange(f"{name} instead of {policy}", partial(_under, fleet, name))


def served_by(fleet: Fleet, robots: int, **settings: Any) -> tuple[str, int] | None:
    """Return the first change that serves a number of robots, and its number of repetitions.

    The result is None if no change serves them within `MOST_OFTEN` repetitions.
    """
    for change in changes_of(fleet):
        for count in range(1, (MOST_OFTEN if change.repeats else 1) + 1):
            if change.capacity(count, **{**settings, "most": robots}).robots >= robots:
                return change.text, count
    return None


def _with_fast(fleet: Fleet, resource: str, _: int) -> Fleet:
    return _changed(fleet, partial(_fast, resource=resource))


def _under(fleet: Fleet, policy: str, _: int) -> Fleet:
    return fleet.changed(policy=policy)


def _changed(fleet: Fleet, change: Callable[[Problem], Problem]) -> Fleet:
    entries = tuple(replace(entry, cell=change(entry.cell)) for entry in fleet.entries)
    return replace(fleet, entries=entries)


def _latest_ms(pipeline: Pipeline) -> float:
    """Return the latest deadline to try: within the period, unless the deadline is beyond it."""
    beyond = pipeline.deadline_ms > pipeline.period_ms
    return pipeline.period_ms * (LONGEST_DEADLINE if beyond else 1)


def _later(cell: Problem) -> Problem:
    return evolve(cell, {"deadline_ms": cell.pipeline.deadline_ms + LATER_MS})


def _uses(cells: list[Problem], resource: str) -> bool:
    """Whether jobs run on a resource, and all their times can be scaled."""
    times = [
        of.exec_ms
        for cell in cells
        for task in cell.pipeline.tasks.values()
        for node, of in task.on.items()
        if of.resource(node) == resource
    ]
    return bool(times) and all(isinstance(one, Scalable) for one in times)


def _fast(cell: Problem, resource: str) -> Problem:
    changes = {
        f"tasks.{name}.on.{node}.exec_ms": _scaled(of.exec_ms, 1 / FASTER)
        for name, task in cell.pipeline.tasks.items()
        for node, of in task.on.items()
        if of.resource(node) == resource and isinstance(of.exec_ms, Scalable)
    }
    return evolve(cell, changes)


def _scaled(process: Scalable, factor: float) -> Scalable:
    """Return a process with all values multiplied by a factor."""
    values: dict[str, Any] = {
        name: value * factor for name, value in asdict(process).items() if name in SCALED
    }
    return replace(process, **values)
