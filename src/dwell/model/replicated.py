"""Candidates that send each cycle through two copies, as a cell file declares them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Protocol

from dwell.errors import Fault
from dwell.model.bounds import Bound
from dwell.model.declaration import declared, key
from dwell.model.pipeline import Flow, Task

AFTER_MS = Bound(0)
#: Number of copies of a cycle.
COPIES = 2


@declared()
class Replicated:
    """A candidate that sends each cycle through two copies."""

    replicas: tuple[str, ...] = key(
        "Two other candidates; the first copy runs under the first.", tier="tuning"
    )
    after_ms: float = key(
        "Time after the release until messages go to the second copy, ms; at most D.",
        AFTER_MS,
        default=0.0,
    )


class Unknown(Protocol):
    """A check of a name."""

    def __call__(
        self, path: str, what: str, word: str, known: Collection[str], /
    ) -> Iterable[Fault]:
        """Yield the fault of an unknown name."""
        ...


def replica_faults(
    declared: Mapping[str, Replicated],
    candidates: Mapping[str, Mapping[str, str]],
    others: Iterable[str],
    tasks: Mapping[str, Task | None],
    flows: Iterable[Flow],
    unknown: Unknown,
) -> Iterator[Fault]:
    """Yield the faults of candidates with replicas; `others` are unreadable candidates."""
    known, edges = [*candidates, *others], list(flows)
    for name, one in declared.items():
        path = f"candidates.{name}.replicas"
        faults = list(_member_faults(path, one.replicas, declared, known, unknown))
        yield from faults
        members = [candidates[member] for member in one.replicas if member in candidates]
        if not faults and len(members) == COPIES:
            yield from _end_faults(path, one.replicas, members, tasks, edges)


def _member_faults(
    path: str,
    members: tuple[str, ...],
    declared: Mapping[str, Replicated],
    known: Collection[str],
    unknown: Unknown,
) -> Iterator[Fault]:
    if len(members) != COPIES or len(set(members)) != COPIES:
        shown = ", ".join(members) or "none"
        yield Fault(path, f"names {shown}; name exactly two different candidates")
    for index, member in enumerate(members):
        if member in declared:
            yield Fault(f"{path}[{index}]", f"{member} has replicas itself; name a plain candidate")
        else:
            yield from unknown(f"{path}[{index}]", "candidate", member, known)


def _end_faults(
    path: str,
    names: tuple[str, ...],
    members: list[Mapping[str, str]],
    tasks: Mapping[str, Task | None],
    flows: list[Flow],
) -> Iterator[Fault]:
    """Yield faults of two members that differ in no task, or at the ends of the pipeline."""
    doubled = [
        task for task in members[0] if members[0][task] != members[1].get(task, members[0][task])
    ]
    if not doubled:
        yield Fault(path, f"{' and '.join(names)} place no task differently; keep one of them")
    sources = [task for task in tasks if not any(flow.target == task for flow in flows)]
    sinks = [task for task in tasks if not any(flow.source == task for flow in flows)]
    for task in dict.fromkeys([*sources[:1], *sinks]):
        if task in doubled:
            where = " and ".join(member[task] for member in members)
            what = "a sink" if task in sinks else "the first source"
            yield Fault(
                path, f"{task} is {what} and would run on {where}; put it on one node in both"
            )
