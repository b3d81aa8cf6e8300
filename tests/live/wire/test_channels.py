"""What processes of all versions agree on: keys, permitted senders, connections and bytes.

``python -m tests.live.wire.test_channels`` writes the file again after an intended change.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import dwell
from dwell.live.trust.acl import access_control
from dwell.live.trust.permissions import senders, subjects
from dwell.live.wire.channels import CHANNELS
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import encode
from dwell.live.wire.wiring import roles, wire
from dwell.model import Problem
from tests.fuzz.targets import wholes
from tests.live.small_world import Bench, Counting, World, stateful
from tests.live.trust.rosters import roster_of

KEPT = Path(__file__).with_name("channels.json")
CELLS = "canonical", "cloud", "fan-in", "inner-loop", "live/cell"


def agreed() -> dict[str, Any]:
    """Return everything that another process of the cell relies on, as JSON values."""
    return {
        "cells": {name: _of_cell(dwell.load(f"examples/{name}.yaml")) for name in CELLS},
        "subscriptions": _subscriptions(),
        "bytes": [f"{type(one).__name__} {encode(one).hex()}" for one in wholes()],
    }


def _of_cell(problem: Problem) -> dict[str, Any]:
    may_put = subjects(problem, roster_of(problem))
    acl = access_control(roster_of(problem), f"dwell/{problem.name}", may_put)
    wires = wire(problem).wires if problem.live.hosts else ()
    return {
        "senders": {key: " ".join(sorted(who)) for key, who in sorted(senders(problem).items())},
        "access": sorted(
            f"{' '.join(rule['key_exprs'])} {rule['messages']}: {' '.join(one['subjects'])}"
            for one in acl["policies"]
            for rule in acl["rules"]
            if rule["id"] in one["rules"]
        ),
        "wires": [f"{one.session} {one.source} {one.target}" for one in wires],
    }


def _subscriptions() -> dict[str, str]:
    """Return the key expressions of every process of the canonical cell."""
    problem = stateful(dwell.load("examples/canonical.yaml"), "planning", 100)
    world = World(problem, policy="dtp", stages={"planning": Counting})
    members = {
        who: one.worker if isinstance(one, Bench) else one for who, one in world.roles.items()
    }
    return {
        who: " ".join(sorted(member.subscriptions()))  # type: ignore[attr-defined]
        for who, member in sorted(members.items())
    }


def test_a_change_of_the_wire_is_intended() -> None:
    assert agreed() == json.loads(KEPT.read_text())


def test_processes_subscribe_to_the_channels_of_their_kind() -> None:
    problem = dwell.load("examples/canonical.yaml")
    subscribed: dict[str, set[str]] = {role.kind: set() for role in roles(problem)}
    keys, found = Keys(problem.name), _subscriptions()
    for role in roles(problem):
        subscribed[role.kind] |= {keys.word(one) for one in found[role.who].split()}
    for kind, words in subscribed.items():
        expected = {word for word, channel in CHANNELS.items() if kind in channel.receivers}
        assert words - {"beat", "beats", "relay"} == expected, kind


if __name__ == "__main__":
    KEPT.write_text(json.dumps(agreed(), indent=1) + "\n")
