"""The Controller: windows, estimator, policy and order, the same in both engines."""

from dwell.control.controller import ClosedWindow, Controller, LookedAt, Proposal
from dwell.control.course import Course
from dwell.control.guard import (
    CellGuard,
    Failures,
    FallbackRound,
    Guard,
    Presence,
    Probation,
    parts_of,
)
from dwell.control.plain_rule import plain_rule
from dwell.control.windows import (
    NO_AGE,
    age_l95_ms,
    age_missed,
    final_l95_ms,
    mean_age_ms,
    moved_shares,
    overtaken_cycles,
    reactions,
    seen_costs,
)
from dwell.estimators import Estimator, Evidence, Instants
from dwell.model.shadow_plan import ShadowPlan, shadow_stamps
from dwell.policies import MinimalPolicy

__all__ = [
    "NO_AGE",
    "CellGuard",
    "ClosedWindow",
    "Controller",
    "Course",
    "Estimator",
    "Evidence",
    "Failures",
    "FallbackRound",
    "Guard",
    "Instants",
    "LookedAt",
    "MinimalPolicy",
    "Presence",
    "Probation",
    "Proposal",
    "ShadowPlan",
    "age_l95_ms",
    "age_missed",
    "final_l95_ms",
    "mean_age_ms",
    "moved_shares",
    "overtaken_cycles",
    "parts_of",
    "plain_rule",
    "reactions",
    "seen_costs",
    "shadow_stamps",
]
