"""The simulator: scenario to realisation, realisation through the kernels, kernels to a Run."""

from dwell.sim.engine import describe, simulate, simulate_realisation
from dwell.sim.random_draws import draw
from dwell.sim.realisation import LinkSegment, NodeChange, Phase, Realisation

__all__ = [
    "LinkSegment",
    "NodeChange",
    "Phase",
    "Realisation",
    "describe",
    "draw",
    "simulate",
    "simulate_realisation",
]
