"""Access control of a Zenoh session: who may put what to it, by the names in certificates.

Nothing is allowed that is not listed, and nobody who has been revoked is. Zenoh looks at the
certificate of the process at the other end of a connection; a message that may not pass is dropped
without a word to its sender.
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

    Every subject of the roster may hear what is put under the root, and be sent it.

    Parameters
    ----------
    root : str
        Beginning of all keys of the cell.
    may_put : mapping of str to iterable of str
        By key expression: names of the subjects who may put there. Those that the roster does not
        have are left out.
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
    # Keys of the same senders share a rule.
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
