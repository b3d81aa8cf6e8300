"""What evidence shows as cancelled, by the section "Replicas" of the page."""

from __future__ import annotations

import math

from dwell.model import Flow, Problem, Replicas
from tests.reference.replicas import second
from tests.reference.simulator import ITSELF, JobResult, Look, Result


class Cancelled:
    """Which jobs and messages of a cycle evidence shows as cancelled, by a look."""

    def __init__(
        self, problem: Problem, look: Look, result: Result, cycle: int, release_ns: int
    ) -> None:
        self.problem, self.look, self.result, self.cycle = problem, look, result, cycle
        self.release_ns = release_ns
        placed = problem.candidates[result.stamps[cycle][0]]
        self.placed = placed if isinstance(placed, Replicas) else None
        self.names = {second(task): task for task in problem.pipeline.tasks}
        sinks = [task for task in problem.pipeline.tasks if not problem.pipeline.outputs(task)]
        ends = [self.job(sink) for sink in sinks]
        self.is_done = all(job is not None and job.outcome == "done" for job in ends)

    def job(self, row: str) -> JobResult | None:
        """Return what is known of a job."""
        return self.look.known.get((ITSELF, self.cycle, row))

    def has_job(self, row: str) -> bool:
        """Whether a cycle may have a job: common tasks have no second copy."""
        if self.placed is None or row not in self.names:
            return True
        return self.names[row] in self.placed.doubled

    def is_cancelled(self, row: str) -> bool:
        """Whether a job of a cycle that is done has neither completed nor been lost."""
        job = self.job(row)
        return (
            self.placed is not None and self.is_done and (job is None or job.outcome == "in_flight")
        )

    def message(self, flow: Flow, source: str, target: str) -> tuple[bool, bool]:
        """Return whether the evidence of a message matters, and whether it is cancelled."""
        if self.placed is None or not self.is_done:
            return True, False
        doubled = self.placed.doubled
        if source in self.names and {flow.source, flow.target}.isdisjoint(doubled):
            return False, False
        if (ITSELF, self.cycle, source, target) in self.look.arrived:
            return True, False
        is_second = source in self.names
        copy = self.placed.copies[is_second]
        here, there = copy[flow.source], copy[flow.target]
        job = self.job(source if flow.source in doubled else flow.source)
        if here == there or job is None or job.outcome != "done" or job.end_ns is None:
            return False, False
        if self.problem.fabric.links[f"{here}->{there}"].retransmit_ms is not None and any(
            (ITSELF, later, source, target) in self.look.arrived
            for later in range(self.cycle + 1, self.look.last + 1)
        ):
            return True, True
        heard = self.result.heard.get((self.cycle, here), math.inf)
        due = self.release_ns + round(self.placed.after_ms * 1e6)
        if is_second and flow.source not in doubled and job.end_ns < due:
            return True, heard <= due  # it is held
        return True, heard < job.end_ns
