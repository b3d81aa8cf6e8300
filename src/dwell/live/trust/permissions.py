"""Permissions: the certificates that may put messages to each key of a cell.

All processes of a node share its certificate, so permissions distinguish nodes, the controller,
operators and observers. No certificate may put to a key that is not listed.
"""

from __future__ import annotations

from collections.abc import Collection

from dwell.live.trust.roster import Roster
from dwell.live.wire import channels
from dwell.live.wire.channels import CHANNELS
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.model import Problem


def senders(problem: Problem) -> dict[str, frozenset[str]]:
    """Return the permitted senders by key: names of nodes, and `CONTROLLER`.

    Keys for requests of operators and observers are missing, as cell files do not list people.
    """
    keys, by_key = Keys(problem.name), dict[str, frozenset[str]]()
    for channel in CHANNELS.values():
        for chunks, names in channel.senders(problem):
            key = keys.of(channel, *chunks)
            # Senders of messages that are sent twice may also send them to the relay.
            for one in (key, keys.relay(key)) if channel.twice else (key,):
                by_key[one] = by_key.get(one, frozenset()).union(names)
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
    by_key[keys.of(channels.ASK)] = people
    by_key[keys.of(channels.LOOK)] = people.union(
        one.name for one in everybody if one.role == "observer"
    )
    return by_key
