"""Policies: observation and estimates in, the decision for the next window out."""

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
