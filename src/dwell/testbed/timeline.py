"""Timeline: what a scenario does to nodes and links, and when.

A change begins or ends one item of the scenario. What a node or link is like follows from all items
that are on, as in the simulator: threads add up, losses combine as independent, the lowest rate
counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Any

from dwell.errors import LiveError
from dwell.model import Constant, Link, LinkDisturbance, NodeDisturbance, Problem
from dwell.model.scenario import Disturbance
from dwell.testbed.conditions import Conditions

__all__ = ["Change", "changes_of", "is_down", "link_changes", "link_with", "threads_on"]


@dataclass(frozen=True, slots=True)
class Change:
    """Something that begins or ends in a scenario.

    Parameters
    ----------
    at_s : float
    index : int
        Of the item, in its scenario.
    item : Disturbance
    begins : bool
    """

    at_s: float
    index: int
    item: Disturbance
    begins: bool

    def made(self, on: Mapping[int, Disturbance]) -> dict[int, Disturbance]:
        """Return what is on after it, of what was on before; by index."""
        rest = {index: other for index, other in on.items() if index != self.index}
        return {**rest, self.index: self.item} if self.begins else rest


def changes_of(problem: Problem, scenario: str, *, outages: bool = False) -> list[Change]:
    """Return what a scenario's disturbances do, in the order of time.

    Parameters
    ----------
    problem : Problem
    scenario : str
    outages : bool
        Whether nodes and links can be made to be down.

    Raises
    ------
    ProblemError
        If there is no such scenario.
    LiveError
        If it has something that real links and CPUs cannot be made to do; all of it at once.
    """
    items = problem.scenario(scenario)
    faults = [fault for item in items for fault in _unplayable(item, outages=outages)]
    faults += _two_delays([item for item in items if isinstance(item, LinkDisturbance)])
    if faults:
        raise LiveError(f"scenario {scenario!r} cannot be played: {'; '.join(faults)}")
    found = []
    for index, item in enumerate(items):
        found.append(Change(item.at_s, index, item, begins=True))
        if item.end_s < math.inf:
            found.append(Change(item.end_s, index, item, begins=False))
    # What ends makes room for what begins at the same time.
    return sorted(found, key=lambda change: (change.at_s, change.begins))


def _unplayable(item: Disturbance, *, outages: bool) -> Iterable[str]:
    where = item.place
    if item.down and not outages:
        yield f"{where} cannot be taken down here"
    if item.episodes is not None:
        yield f"{where} is disturbed in `episodes`, which are drawn; use at_s and for_s"
    if item.ramp_s:
        yield f"{where} is disturbed along a ramp of {item.ramp_s:g} s; use at_s and for_s"


def _two_delays(items: Sequence[LinkDisturbance]) -> Iterable[str]:
    """Faults of links that would get two extra delays at a time: they have one process for them."""
    delays = [item for item in items if item.add_delay_ms is not None]
    for one, other in combinations(delays, 2):
        apart = one.end_s <= other.at_s or other.end_s <= one.at_s
        if one.link == other.link and not apart:
            yield f"{one.link} gets two extra delays at the same time; give it their sum"


def threads_on(node: str, on: Iterable[Disturbance]) -> int:
    """Return how many foreign threads a node has while some disturbances are on."""
    return sum(
        item.stress_threads
        for item in on
        if isinstance(item, NodeDisturbance) and item.node == node
    )


def is_down(where: str, on: Iterable[Disturbance]) -> bool:
    """Whether a node, or a link (``R1->E``), is down while some disturbances are on."""
    return any(item.down and item.place == where for item in on)


def link_with(link: Link, on: Iterable[Disturbance]) -> Conditions:
    """Return the conditions of a link while some disturbances are on; its outages are not in it."""
    rate_mbps, kept = link.rate_mbps, 1 - link.loss
    add_delay_ms = None
    for item in on:
        if isinstance(item, LinkDisturbance) and item.link == link.name:
            rate_mbps = min(rate_mbps, item.rate_mbps)
            kept *= 1 - item.loss
            add_delay_ms = item.add_delay_ms if item.add_delay_ms is not None else add_delay_ms
    return Conditions(
        delay_ms=link.delay_ms,
        add_delay_ms=Constant(0.0) if add_delay_ms is None else add_delay_ms,
        rate_mbps=rate_mbps,
        loss=max(1 - kept, 0.0) if kept < 1 else 0.0,
    )


def link_changes(
    link: Link, before: Iterable[Disturbance], on: Iterable[Disturbance]
) -> dict[str, Any]:
    """Return what changes of a link's `Conditions` when other disturbances are on than before.

    What stays is left out: a delay with a memory that is set anew begins anew.
    """
    old, new = link_with(link, before), link_with(link, on)
    pairs = ((item.name, getattr(old, item.name), getattr(new, item.name)) for item in fields(new))
    return {name: value for name, was, value in pairs if not _same(was, value)}


def _same(one: object, other: object) -> bool:
    comparable = isinstance(one, float | Constant)
    return one is other or (comparable and one == other)
