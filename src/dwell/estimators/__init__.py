"""Estimators: the QoS that every candidate would show, active or not."""

from dwell.estimators.profile import Profile
from dwell.estimators.protocol import Estimator
from dwell.estimators.registry import by_name

__all__ = ["Estimator", "Profile", "by_name"]
