"""Policies: observation and estimates in, the decision for the next window out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dwell.policies.atp import ATP
    from dwell.policies.atp_thresholds import ATPThresholds
    from dwell.policies.check import check_policy
    from dwell.policies.cusum import Cusum
    from dwell.policies.dtp import DTP
    from dwell.policies.latency_first import LatencyFirst
    from dwell.policies.parameters import parameters_of
    from dwell.policies.protocol import MinimalPolicy, Policy
    from dwell.policies.registry import by_name
    from dwell.policies.static import Static
    from dwell.policies.work_function import WorkFunction

__all__ = [
    "ATP",
    "DTP",
    "ATPThresholds",
    "Cusum",
    "LatencyFirst",
    "MinimalPolicy",
    "Policy",
    "Static",
    "WorkFunction",
    "by_name",
    "check_policy",
    "parameters_of",
]

_HOME = {
    "ATP": "dwell.policies.atp",
    "ATPThresholds": "dwell.policies.atp_thresholds",
    "check_policy": "dwell.policies.check",
    "Cusum": "dwell.policies.cusum",
    "DTP": "dwell.policies.dtp",
    "LatencyFirst": "dwell.policies.latency_first",
    "parameters_of": "dwell.policies.parameters",
    "MinimalPolicy": "dwell.policies.protocol",
    "Policy": "dwell.policies.protocol",
    "by_name": "dwell.policies.registry",
    "Static": "dwell.policies.static",
    "WorkFunction": "dwell.policies.work_function",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that the registry loads without the classes (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module 'dwell.policies' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
