"""Ages of a chain, from the record of a run; by the section "Chains" of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from dwell.model import Chain, Problem
from tests.reference.rates import Rates
from tests.reference.simulator import Result


@dataclass(frozen=True)
class Actuation:
    """A completion of a chain's last task: its cycle, instant, and age."""

    cycle: int
    at_ns: int
    age_ns: int


def actuations(
    problem: Problem, result: Result, release_ns: list[int], start: str, end: str
) -> list[Actuation]:
    """Return the actuations of the chain from `start` to `end`, by instant, then by cycle."""
    done = sorted(
        (job.end_ns, cycle)
        for (cycle, task), job in result.jobs.items()
        if task == end and job.outcome == "done" and job.end_ns is not None
    )
    rates = Rates(problem.pipeline)
    found: list[Actuation] = []
    origin = 0

    def taken(cycle: int, task: str) -> Mapping[str, int]:
        return result.jobs[cycle, task].taken

    for at_ns, cycle in done:
        origin = min(rates.descent(taken, start, end, cycle), default=origin)
        found.append(Actuation(cycle, at_ns, at_ns - release_ns[origin]))
    return found


def bound_ns(chain: Chain) -> float:
    """Return the bound on a chain's age, infinite without one."""
    return chain.max_age_ms if math.isinf(chain.max_age_ms) else round(chain.max_age_ms * 1e6)


def over_age(problem: Problem, result: Result, release_ns: list[int]) -> dict[int, int]:
    """Return the cycles whose age at an actuation of a chain is over its bound, and that instant.

    By section "Chains": the first such instant counts.
    """
    found: dict[int, int] = {}
    for chain in problem.pipeline.chains.values():
        for one in actuations(problem, result, release_ns, chain.source, chain.target):
            if one.age_ns > bound_ns(chain):
                found[one.cycle] = min(one.at_ns, found.get(one.cycle, one.at_ns))
    return found
