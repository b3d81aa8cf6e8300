"""A cell with the paper's candidates in which a chapter takes a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from dwell.model import LinkDisturbance, NodeDisturbance, Normal, Problem, Servo
from dwell.model.servo import MovingTarget
from dwell.study.paper import Scale
from tests.study.cell import make_problem

__all__ = ["SCALE", "make_cell"]

SCALE = Scale.tiny()

Disturbances = tuple[NodeDisturbance | LinkDisturbance, ...]

SCENARIOS: Mapping[str, Disturbances] = {
    "robot-cpu-stress": (NodeDisturbance("R1", stress_threads=4),),
    "network-impairment": (LinkDisturbance("R1", "E", add_delay_ms=Normal(25.0, 5.0)),),
    "step": (NodeDisturbance("R1", at_s=1.0, for_s=2.0, stress_threads=4),),
    "flapping": (LinkDisturbance("R1", "R2", at_s=1.0, for_s=2.0, add_delay_ms=Normal(25.0, 5.0)),),
}


def make_cell(*scenarios: str) -> Problem:
    """Return a small cell with some of the paper's scenarios beside baseline, made short."""
    problem = make_problem(window_cycles=10, warmup_windows=2)
    return replace(
        problem,
        scenarios={name: SCENARIOS[name] for name in scenarios},
        servo=Servo("integrator", 4.0, MovingTarget(40.0, 1.6)),
    )
