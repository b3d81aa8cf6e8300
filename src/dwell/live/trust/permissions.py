"""Permissions: whose certificate may put under which key of a cell.

All processes of a node share its certificate, so what is told apart here are nodes, the controller
and people. A key that is not listed is nobody's.
"""

from __future__ import annotations

from collections.abc import Collection

from dwell.live.trust.roster import Roster
from dwell.live.wire.keys import CONTROLLER, MAIN, SHADOW, TWICE, Keys
from dwell.live.wire.wiring import roles
from dwell.model import Problem


def senders(problem: Problem) -> dict[str, frozenset[str]]:
    """Return who may put, by key; the names are those of nodes, and `CONTROLLER`.

    Questions are missing: who may ask them is in nobody's cell file.
    """
    keys, pipeline = Keys(problem.name), problem.pipeline
    stamper, relay = problem.stamper_node, problem.relay_node
    first = next(task for name, task in pipeline.tasks.items() if not pipeline.inputs(name))
    everywhere = frozenset(node for task in pipeline.tasks.values() for node in task.on)
    by_key: dict[str, frozenset[str]] = {
        **_of_stages(problem, keys),
        keys.ended(): everywhere,
        keys.stamped(): frozenset([stamper]),
        keys.accepted(): frozenset([stamper]),
        keys.order(): frozenset([CONTROLLER]),
        keys.answer("*"): frozenset([CONTROLLER]),
        keys.carried(): frozenset([relay]),
        keys.gathered(): frozenset([relay]),
    }
    if problem.live.release == "frames":
        by_key[keys.frame()] = frozenset(first.on)
    for role in roles(problem):
        sender = CONTROLLER if role.kind == "controller" else role.node
        by_key[keys.beat(role.node, role.who)] = frozenset([sender])
    for node in problem.fabric.nodes:
        by_key[keys.load(node)] = frozenset([node])
    # What is sent twice may be handed to the relay by whoever may send it.
    by_key |= {keys.relay(key): who for key, who in by_key.items() if keys.word(key) in TWICE}
    return by_key


def _of_stages(problem: Problem, keys: Keys) -> dict[str, frozenset[str]]:
    """Return who may put stages' messages to one another, and messages about their states."""
    pipeline = problem.pipeline
    by_key: dict[str, frozenset[str]] = {}
    restored: set[str] = set()
    for name, task in pipeline.tasks.items():
        flows = pipeline.inputs(name)
        before = {node for flow in flows for node in pipeline.tasks[flow.source].on}
        sources = frozenset(before) if flows else frozenset([problem.stamper_node])
        for node in task.on:
            by_key[keys.inputs(name, node, MAIN)] = sources
            if flows:
                by_key[keys.inputs(name, node, SHADOW)] = sources
        if not pipeline.outputs(name):
            by_key[keys.command(name)] = frozenset(task.on)
            by_key[keys.done(name)] = frozenset(task.on)
        if len(task.on) > 1:
            restored.update(task.on)
            for node in task.on:
                by_key[keys.snapshot(name, node)] = frozenset([CONTROLLER])
                for source in set(task.on) - {node}:
                    by_key[keys.state(name, node, source)] = frozenset([source])
    if restored:
        by_key[keys.restored()] = frozenset(restored)
    return by_key


def subjects(problem: Problem, roster: Roster) -> dict[str, Collection[str]]:
    """Return who of a roster may put, by key."""
    keys = Keys(problem.name)
    everybody = roster.subjects.values()
    # The roster has to have each name in the role that the cell file takes it for.
    known = {
        one.name
        for one in everybody
        if one.role == ("controller" if one.name == CONTROLLER else "node")
    }
    by_key: dict[str, Collection[str]] = {
        key: names & known for key, names in senders(problem).items()
    }
    people = frozenset(one.name for one in everybody if one.role in ("controller", "operator"))
    by_key[keys.ask()] = people
    by_key[keys.look()] = people.union(one.name for one in everybody if one.role == "observer")
    return by_key
