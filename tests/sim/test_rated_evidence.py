"""Evidence of slow tasks: each job and message counts at one decision, also after a move."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from dwell import simulate
from dwell.cellfile.cell import from_document
from dwell.estimators import Evidence
from dwell.estimators.measured import Message, Meter, Site
from dwell.model import Problem, QoS
from dwell.record import Run
from tests.sim.test_rates import CAMERA, document

UP = Message("camera", "detect", "R->E")
CYCLES = 400


class Counting:
    """An estimator that counts the values of a meter, and expects the same of all candidates."""

    def start(self, problem: Problem) -> None:
        """Begin with a new meter."""
        self.names, self.meter = tuple(problem.candidates), Meter(problem)
        self.times: dict[object, list[float]] = {}

    def __deepcopy__(self, memo: object) -> Counting:
        return self

    def learn(self, evidence: Evidence) -> None:
        """Add the times of all parts."""
        for part, values in self.meter.times(evidence).items():
            self.times.setdefault(part, []).extend(values.tolist())

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Expect the observed values."""
        return dict.fromkeys(self.names, observed)


class MoveOnce:
    """A policy that moves from HERE to THERE at its second decision."""

    def __init__(self) -> None:
        self.calls = 0

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Move once."""
        self.calls += 1
        return "THERE" if self.calls > 1 else "HERE"


def cell(decides: int, lead: int, **changes: Any) -> Problem:
    """Return the control loop; the camera's pictures begin to be lost at 1 s."""
    made = document(window_cycles=40, warmup_windows=0, **changes)
    made["tasks"]["detect"]["on"] = {"R": {"exec_ms": 36}, "E": {"exec_ms": 36}}
    made["candidates"] = {"HERE": {"detect": "R"}, "THERE": {"detect": "E"}}
    made["scenarios"] = {"lossy": [{"link": "R->E", "at_s": 1, "loss": 0.5}]}
    made["controller"] = {"decide_cycles": decides, "order_lead_cycles": lead, "initial": "HERE"}
    return from_document(made)


def counted(problem: Problem) -> tuple[Run, dict[object, list[float]]]:
    """Simulate 400 cycles, and return the times that the estimator has counted."""
    estimator = Counting()
    windows = CYCLES // problem.window_cycles
    asked: dict[str, Any] = {"scenario": "lossy", "seed": 1, "windows": windows, "jobs": True}
    return simulate(problem, policy=MoveOnce(), estimator=estimator, **asked), estimator.times


@pytest.mark.parametrize("lead", [0, 3, 5, 9])
@pytest.mark.parametrize("decides", [1, 5, 9, 10, 11, 15, 20, 39])
def test_each_lost_message_of_a_slow_task_counts_once(decides: int, lead: int) -> None:
    run, times = counted(cell(decides, lead))
    placed = run.cycles["placement"].cast(str).to_list()
    moved = placed.index("THERE")
    arrived = set(run.jobs.filter(run.jobs["task"] == "detect")["cycle"].to_list())
    # Two intervals after its release, and at the next decision, a message is known to be lost.
    known = [k for k in range(0, CYCLES - 2 * CAMERA - decides - 2, CAMERA) if k >= moved]
    lost = sum(k not in arrived for k in known)
    assert lost > 5
    further = sum(k not in arrived for k in range(known[-1] + CAMERA, CYCLES, CAMERA))
    found = sum(map(math.isinf, times[UP]))
    assert lost <= found <= lost + further


@pytest.mark.parametrize("decides", [1, 7, 10, 30])
def test_each_job_of_a_slow_task_counts_once(decides: int) -> None:
    run, times = counted(cell(decides, 3))
    jobs = run.jobs.filter(run.jobs["task"] == "detect", run.jobs["end_ns"].is_not_null())
    for node in ("R", "E"):
        mine = jobs.filter(jobs["node"] == node)
        taken = ((mine["end_ns"] - mine["ready_ns"]) / 1e6).to_list()
        found = times[Site("detect", node)]
        # The last jobs may end after the last decision.
        assert len(taken) - decides // CAMERA - 2 <= len(found) <= len(taken)
        assert np.array(found) == pytest.approx(taken[: len(found)])
