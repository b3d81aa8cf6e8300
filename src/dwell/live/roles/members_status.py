"""Status of a cell's processes: their beats, topics and certificates, and missing processes."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from msgspec.structs import asdict

from dwell.live.roles.health import silent_after_ns
from dwell.live.roles.role import REPEATED_NS, Pulse
from dwell.live.wire.keys import CONTROLLER
from dwell.live.wire.wiring import roles


def members_status(pulse: Pulse, now_ns: int) -> dict[str, Any]:
    """Return the status of a cell's processes, as plain values.

    ``topics``: rates of the topics that sources read. ``processes``: age and state of the last
    beat. ``certificates``: ends of the certificates in use, by node and for the controller.
    ``strangers``: rejected processes with the reason. ``silent``: processes without any beat.
    """
    place, strangers = pulse.place, pulse.strangers
    silent_ns = silent_after_ns(place.problem)
    beats = {who: (beat, age_ns) for who, beat, age_ns in pulse.detector.everybody(now_ns)}
    differ = {who: why for who, (why, at_ns) in strangers.items() if now_ns - at_ns < REPEATED_NS}
    known = beats.keys() | differ.keys() | {place.who}
    return {
        "topics": {
            who: {**asdict(beat.rates), "period_ms": place.period_ns / 1e6}
            for who, (beat, age_ns) in beats.items()
            if beat.rates is not None and age_ns <= silent_ns
        },
        "processes": {
            who: {
                "age_ms": round(age_ns / 1e6, 1),
                "heard": age_ns <= silent_ns,
                "ready": beat.ready and age_ns <= silent_ns,
                "note": beat.note,
            }
            for who, (beat, age_ns) in beats.items()
        },
        "certificates": _certificates(pulse, now_ns, silent_ns),
        "strangers": differ,
        "silent": [role.who for role in roles(place.problem) if role.who not in known],
    }


def _certificates(pulse: Pulse, now_ns: int, silent_ns: int) -> dict[str, dict[str, Any]]:
    """Return the ends of the certificates in use."""
    place = pulse.place
    if place.seals is None:
        return {}
    keyring = place.seals.keyring
    # Oldest certificate that a process of the node uses; silent processes count only if all
    # are silent.
    used = {CONTROLLER: (False, keyring.own.generation)}
    for _, beat, age_ns in pulse.detector.everybody(now_ns):
        found = age_ns > silent_ns, beat.generation
        used[beat.node] = min(used.get(beat.node, found), found)
    now, certificates = datetime.now(UTC), {}
    for name in (*place.problem.fabric.nodes, CONTROLLER):
        known = {one.generation: one for one in reversed(keyring.roster.of(name))}
        newest = max(known, default=0)
        if one := known.get(used.get(name, (True, newest))[1], known.get(newest)):
            certificates[name] = {
                "expires": one.expires,
                "days": round((one.ends - now).total_seconds() / 86_400, 6),
                "soon": now >= one.warns_from,
            }
    return certificates
