"""Permissions: the certificates that may put messages to each key of a cell.

All processes of a node share its certificate, so permissions distinguish nodes, the controller,
operators and observers. No certificate may put to a key that is not listed.
"""

from __future__ import annotations

from collections.abc import Collection

from dwell.live.trust.roster import Roster
from dwell.live.wire.keys import CONTROLLER, MAIN, SHADOW, TWICE, Keys
from dwell.live.wire.wiring import roles
from dwell.model import Problem


def senders(problem: Problem) -> dict[str, frozenset[str]]:
    """Return the permitted senders by key: names of nodes, and `CONTROLLER`.

    Keys for requests of operators and observers are missing, as cell files do not list people.
    """
    keys, pipeline = Keys(problem.name), problem.pipeline
    stamper, relay = problem.stamper_node, problem.relay_node
    first = next(task for name, task in pipeline.tasks.items() if not pipeline.inputs(name))
    everywhere = frozenset(node for task in pipeline.tasks.values() for node in task.on)
    by_key: dict[str, frozenset[str]] = {
        **_of_stages(problem, keys),
        keys.ended(): everywhere,
        keys.stamped(): frozenset([stamper]),
        keys.missed(): frozenset([stamper]),
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
        by_key[keys.load(node)] = by_key[keys.beats(node)] = frozenset([node])
    # Senders of messages that are sent twice may also send them to the relay.
    by_key |= {keys.relay(key): who for key, who in by_key.items() if keys.word(key) in TWICE}
    return by_key


def _of_stages(problem: Problem, keys: Keys) -> dict[str, frozenset[str]]:
    """Return the permitted senders, by key, of messages between stages and about their states."""
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
    """Return the subjects of a roster that may put messages, by key."""
    keys = Keys(problem.name)
    everybody = roster.subjects.values()
    # Skip subjects whose role in the roster differs from their role in the cell file.
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
