"""The simulator: samples realisations and simulates them under policies."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dwell.kernels.random_draws import Drawing as Drawing
from dwell.kernels.random_draws import draw
from dwell.kernels.realisation import LinkSegment, NodeChange, NodeChanges, Phase, Realisation

if TYPE_CHECKING:
    from dwell.sim.engine import describe, simulate, simulate_realisation

__all__ = [
    "LinkSegment",
    "NodeChange",
    "NodeChanges",
    "Phase",
    "Realisation",
    "describe",
    "draw",
    "simulate",
    "simulate_realisation",
]


def __getattr__(name: str) -> Any:
    """Import the engine at the first access (PEP 562); sampling does not need it."""
    if name not in __all__:
        raise AttributeError(f"module 'dwell.sim' has no attribute {name!r}")
    return getattr(import_module("dwell.sim.engine"), name)
