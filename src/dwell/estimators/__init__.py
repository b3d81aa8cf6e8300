"""Estimators: the QoS that every candidate would show, active or not."""

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
]
