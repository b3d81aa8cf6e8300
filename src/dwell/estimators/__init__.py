"""Estimators: the QoS that every candidate would show, active or not."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dwell.estimators.cell_warnings import unplayed, warnings_of
    from dwell.estimators.corrected import Corrected
    from dwell.estimators.evidence import Evidence, Instants
    from dwell.estimators.profile import Profile
    from dwell.estimators.protocol import Estimator, Learner, Support
    from dwell.estimators.registry import by_name
    from dwell.estimators.scaling import Scaling
    from dwell.estimators.shadow import Shadow

__all__ = [
    "Corrected",
    "Estimator",
    "Evidence",
    "Instants",
    "Learner",
    "Profile",
    "Scaling",
    "Shadow",
    "Support",
    "by_name",
    "unplayed",
    "warnings_of",
]

_HOME = {
    "Corrected": "dwell.estimators.corrected",
    "Estimator": "dwell.estimators.protocol",
    "Evidence": "dwell.estimators.evidence",
    "Instants": "dwell.estimators.evidence",
    "Learner": "dwell.estimators.protocol",
    "Profile": "dwell.estimators.profile",
    "Scaling": "dwell.estimators.scaling",
    "Shadow": "dwell.estimators.shadow",
    "Support": "dwell.estimators.protocol",
    "by_name": "dwell.estimators.registry",
    "warnings_of": "dwell.estimators.cell_warnings",
    "unplayed": "dwell.estimators.cell_warnings",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that the registry loads without the classes (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module 'dwell.estimators' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
