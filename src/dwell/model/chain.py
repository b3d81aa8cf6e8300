"""Chains: from a task whose data an actuation descends from, to the task that acts on it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from dwell.errors import Fault
from dwell.model.bounds import Bound
from dwell.model.declaration import declared, key
from dwell.model.instants import NEVER_NS
from dwell.model.task_rates import Edge

MAX_AGE_MS = Bound(0, above=True)


@declared()
class Chain:
    """A chain of tasks, whose data age is measured at each completion of its last task."""

    source: str = key("Task from whose releases the age counts.", named="from")
    target: str = key("Task behind it, whose completions are the actuations.", named="to")
    max_age_ms: float = key(
        "Age at an actuation beyond which its cycle has missed, ms; the guard watches it, too.",
        MAX_AGE_MS,
        default=math.inf,
        usual="none",
    )

    @property
    def is_bounded(self) -> bool:
        """Whether the chain has a bound on its age."""
        return math.isfinite(self.max_age_ms)

    @property
    def max_age_ns(self) -> int:
        """Bound on the age in whole nanoseconds, `NEVER_NS` for none."""
        age_ns = self.max_age_ms * 1e6
        return round(age_ns) if age_ns < NEVER_NS else NEVER_NS


class ChainPatience(NamedTuple):
    """Bound on the age of a chain's newest origin, ns, and the cycles between two origins."""

    patience_ns: int
    every: int


def chain_faults(
    chains: Mapping[str, Chain], tasks: Iterable[str], flows: Iterable[Edge]
) -> Iterator[Fault]:
    """Yield the faults of chains between known tasks that no flows connect."""
    known, all_flows = {*tasks}, list(flows)
    for name, chain in chains.items():
        if not {chain.source, chain.target} <= known:
            continue
        if chain.target not in behind(chain.source, all_flows):
            yield Fault(
                f"chains.{name}",
                f"no flows lead from {chain.source} to {chain.target}; name a task behind "
                f"{chain.source} as `to`",
            )


def behind(task: str, flows: Iterable[Edge]) -> set[str]:
    """Return the tasks that flows lead to from a task, the task itself excluded."""
    found, new, known = set[str](), {task}, list(flows)
    while new:
        new = {flow.target for flow in known if flow.source in new} - found
        found |= new
    return found
