"""Ages of a chain or of cycles, from the record of a run; by the section "Chains" of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from dwell.model import Chain, Problem
from tests.reference.rates import Rates
from tests.reference.simulator import Result


@dataclass(frozen=True)
class Actuation:
    """A completion of a chain's last task, or of a cycle: its cycle, instant, and age."""

    cycle: int
    at_ns: int
    age_ns: int
    newest: int = -1

    @property
    def born_ns(self) -> int:
        """Release of its origin."""
        return self.at_ns - self.age_ns


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
        descent = rates.descent(taken, start, end, cycle)
        origin = min(descent, default=origin)
        newest = max(descent, default=-1)
        found.append(Actuation(cycle, at_ns, at_ns - release_ns[origin], newest))
    return found


def reaction_l95_ms(
    known: Sequence[Actuation], release_ns: Sequence[int], every: int, cycles: range
) -> float:
    """Return L95 of the reaction times that end at the actuations of some cycles."""
    found = []
    for release in range(0, len(release_ns), every):
        ends = next((one for one in known if one.newest > release), None)
        if ends is not None and ends.cycle in cycles:
            found.append(ends.at_ns - release_ns[release])
    found.sort()
    return found[math.ceil(0.95 * len(found)) - 1] / 1e6 if found else math.inf


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


def completions(result: Result, release_ns: Sequence[int]) -> list[Actuation]:
    """Return the completions of cycles, by instant, then by cycle."""
    found = [
        Actuation(k, release_ns[k] + cycle.latency_ns, cycle.latency_ns)
        for k, cycle in enumerate(result.cycles)
        if cycle.latency_ns is not None
    ]
    return sorted(found, key=lambda one: (one.at_ns, one.cycle))


def age_l95_ms(known: Sequence[Actuation], first: int, count: int, close_ns: int) -> float:
    """Return L95 of the ages of some cycles' actuations up to the close; infinite without any."""
    cycles = range(first, first + count)
    ages = sorted(one.age_ns for one in known if one.cycle in cycles and one.at_ns <= close_ns)
    return ages[math.ceil(0.95 * len(ages)) - 1] / 1e6 if ages else math.inf


def mean_age_ms(
    known: Sequence[Actuation], begin_ns: int, close_ns: int, run_begin_ns: int, most_ms: float
) -> float:
    """Return the mean over time of the age in effect, each age at most `most_ms`.

    A command that completes after the command of a newer cycle has no effect.
    """
    newest, born_ns, at_ns, area = -1, run_begin_ns, begin_ns, Fraction(0)
    for one in known:
        if one.at_ns > close_ns:
            break
        if one.cycle < newest:
            continue
        if one.at_ns > at_ns:
            area += grown(at_ns - born_ns, one.at_ns - born_ns, Fraction(most_ms * 1e6))
            at_ns = one.at_ns
        newest, born_ns = one.cycle, one.born_ns
    area += grown(at_ns - born_ns, close_ns - born_ns, Fraction(most_ms * 1e6))
    return float(area / (close_ns - begin_ns) / 10**6)


def grown(young: int, old: int, most: Fraction) -> Fraction:
    """Return the area under an age that grows, or under `most` where it is older."""
    if old <= most:
        return Fraction((young + old) * (old - young), 2)
    if young >= most:
        return most * (old - young)
    return (young + most) * (most - young) / 2 + most * (old - most)
