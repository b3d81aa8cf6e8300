"""Access control of a Zenoh session: permitted senders by key and name in the certificate.

Only listed messages are permitted, and only from subjects that are not revoked. Zenoh checks the
certificate of the process at the other end of a connection, and drops other messages without a
report to the sender.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

from dwell.live.trust.roster import Roster

#: Zenoh's `access_control`.
AccessControl: TypeAlias = dict[str, Any]


def access_control(
    roster: Roster, root: str, may_put: Mapping[str, Iterable[str]]
) -> AccessControl:
    """Return the settings of a session's access control.

    Each subject of the roster may receive all messages below `root`, the prefix of the cell's keys.
    `may_put` gives the permitted senders of each key expression; names outside the roster are
    ignored.
    """
    below = f"{root}/**"
    rules: list[dict[str, Any]] = [
        _rule("hear", [below], ["declare_subscriber"], ["ingress", "egress"]),
        _rule("send", [below], ["put"], ["egress"]),
    ]
    policies: list[dict[str, Any]] = []
    everybody = [subject.common_name for subject in roster.certificates]
    if everybody:
        policies.append({"rules": ["hear", "send"], "subjects": everybody})
    # Keys with the same senders share a rule.
    together: dict[frozenset[str], list[str]] = {}
    for expression, names in may_put.items():
        allowed = frozenset(names)
        known = (subject for subject in roster.certificates if subject.name in allowed)
        senders = frozenset(subject.common_name for subject in known)
        if senders:
            together.setdefault(senders, []).append(expression)
    for number, (senders, expressions) in enumerate(together.items()):
        rules.append(_rule(f"put {number}", sorted(expressions), ["put"], ["ingress"]))
        policies.append({"rules": [f"put {number}"], "subjects": sorted(senders)})
    subjects = [{"id": name, "cert_common_names": [name]} for name in everybody]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, keys: list[str], messages: list[str], flows: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": keys,
    }
