"""Twins: further servers like a shared node of a fleet."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from dwell.model import Fabric, Placement, Problem
from dwell.model.fleet import Fleet, FleetEntry


def with_twins(fleet: Fleet, node: str, count: int) -> Fleet:
    """Return a fleet with more servers like a shared node; its cells use them in turn.

    In the candidates of each cell, the cell's server replaces the node. A twin has the node's
    links.
    """
    entries: list[FleetEntry] = []
    for entry in fleet.entries:
        for _ in range(entry.count):
            turn = len(entries) % (count + 1)
            entries.append(replace(entry, cell=_at(entry.cell, node, count, turn), count=1))
    twins = (_name(node, turn) for turn in range(1, count + 1))
    return replace(fleet, entries=tuple(entries), shared=(*fleet.shared, *twins))


def _name(node: str, turn: int) -> str:
    return f"{node}-{turn + 1}" if turn else node


@lru_cache(maxsize=64)
def _at(cell: Problem, node: str, count: int, turn: int) -> Problem:
    """Return a cell that uses one of the twins where it used the node."""
    twins = [_name(node, place) for place in range(1, count + 1)]
    fabric, pipeline, objective = cell.fabric, cell.pipeline, cell.objective
    nodes = {**fabric.nodes, **{name: replace(fabric.nodes[node], name=name) for name in twins}}
    links = dict(fabric.links)
    for link in fabric.links.values():
        for name in twins:
            source = name if link.source == node else link.source
            target = name if link.target == node else link.target
            twin = replace(link, source=source, target=target)
            links.setdefault(twin.name, twin)
    tasks = {
        name: replace(task, on={**task.on, **dict.fromkeys(twins, task.on[node])})
        if node in task.on
        else task
        for name, task in pipeline.tasks.items()
    }
    own = _name(node, turn)
    candidates = {
        name: Placement({task: own if at == node else at for task, at in placed.first.items()})
        for name, placed in cell.candidates.items()
    }
    tiers = {**objective.tiers}
    if node in tiers:
        tiers |= dict.fromkeys(twins, tiers[node])
    return replace(
        cell,
        name=_name(cell.name, turn),
        fabric=Fabric(nodes, links),
        pipeline=replace(pipeline, tasks=tasks),
        candidates=candidates,
        objective=replace(objective, tiers=tiers),
    )
