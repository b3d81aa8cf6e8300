"""Ages of a chain, from the record of a run; by the section "Chains" of the page."""

from __future__ import annotations

from dataclasses import dataclass

from dwell.model import Problem
from tests.reference.rates import Rates
from tests.reference.simulator import Result


@dataclass(frozen=True)
class Actuation:
    """A completion of a chain's last task: its cycle, instant, and age."""

    cycle: int
    at_ns: int
    age_ns: int


def descent(problem: Problem, result: Result, start: str, task: str, cycle: int) -> set[int]:
    """Return the cycles of `start` from which a job descends."""
    if task == start:
        return {cycle}
    rates, found = Rates(problem.pipeline), set[int]()
    for flow in rates.waited_inputs(task):
        found |= descent(problem, result, start, flow.source, cycle)
    for source, taken in result.jobs[cycle, task].taken.items():
        found |= descent(problem, result, start, source, taken)
    return found


def actuations(
    problem: Problem, result: Result, release_ns: list[int], start: str, end: str
) -> list[Actuation]:
    """Return the actuations of the chain from `start` to `end`, by instant, then by cycle."""
    done = sorted(
        (job.end_ns, cycle)
        for (cycle, task), job in result.jobs.items()
        if task == end and job.outcome == "done" and job.end_ns is not None
    )
    found: list[Actuation] = []
    origin = 0
    for at_ns, cycle in done:
        origin = min(descent(problem, result, start, end, cycle), default=origin)
        found.append(Actuation(cycle, at_ns, at_ns - release_ns[origin]))
    return found
