"""Origins: cycles from which jobs and messages descend, in cells with sampled flows or chains."""

from __future__ import annotations

from collections.abc import Iterable

from dwell.live.wire.messages import Completion, Header, Hop, Origin, RatedHop
from dwell.model import FrozenDict


def origins_of(header: Header) -> tuple[Origin, ...]:
    """Return the cycles from which a message descends; none in a cell without origins."""
    sender = header.hops[-1] if header.hops else None
    return sender.origins if isinstance(sender, RatedHop) else ()


def cycles_of(header: Header) -> FrozenDict[str, int]:
    """Return the oldest cycle from which a message descends, by task (`Message.origins`)."""
    return FrozenDict({one.task: one.cycle for one in origins_of(header)})


def joint_origins(headers: Iterable[Header]) -> dict[str, Origin]:
    """Return the oldest and newest cycle from which messages descend, by task."""
    joint: dict[str, Origin] = {}
    for header in headers:
        for one in origins_of(header):
            known = joint.setdefault(one.task, one)
            oldest = one if one.released_ns < known.released_ns else known
            newest = max(one.newest, known.newest)
            joint[one.task] = Origin(one.task, oldest.cycle, oldest.released_ns, newest)
    return joint


def origin_of(hop: Hop | None, task: str) -> Origin | None:
    """Return the cycles of a task from which a job descends, or None."""
    origins = hop.origins if isinstance(hop, RatedHop) else ()
    return next((one for one in origins if one.task == task), None)


def last_job(done: Completion, task: str) -> RatedHop | None:
    """Return the job of a task in a report, or None."""
    jobs = (hop for hop in done.hops if hop.task == task and hop.ended_ns >= 0)
    return next((hop for hop in jobs if isinstance(hop, RatedHop)), None)
