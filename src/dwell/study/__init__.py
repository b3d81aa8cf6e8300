"""Studies: many runs, and the statistics over their seeds."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

# Not when it is asked for: the name is that of the module, too.
from dwell.study.over_seeds import over_seeds, windows_behind

if TYPE_CHECKING:
    from dwell.study.capacity import Capacity, CapacityPoint, Limiting, capacity_of, what_ifs
    from dwell.study.comparison import AIM, Comparison, compare
    from dwell.study.demo import (
        canonical_demo,
        longest_run,
        real_demo,
        stored_deadlines,
        tenants_demo,
    )
    from dwell.study.family import SAME_RUN, UNTOLD, Family, same_run, untold
    from dwell.study.hindsight import Hindsight
    from dwell.study.intervals import (
        Interval,
        mean_interval,
        median_interval,
        share_interval,
        under,
    )
    from dwell.study.kept_bounds import keeps
    from dwell.study.pairs import PairedDifference, PairedMedian, paired_difference, paired_median
    from dwell.study.player import Example
    from dwell.study.predictions import paper_predictions
    from dwell.study.results import StudyRuns
    from dwell.study.runner import StudyResult, run_study
    from dwell.study.study import Contender, Point, Study, load_study
    from dwell.study.study_folder import open_study
    from dwell.study.validation import Validation, validate

__all__ = [
    "AIM",
    "SAME_RUN",
    "UNTOLD",
    "Capacity",
    "CapacityPoint",
    "Comparison",
    "Contender",
    "Example",
    "Family",
    "Hindsight",
    "Interval",
    "Limiting",
    "PairedDifference",
    "PairedMedian",
    "Point",
    "Study",
    "StudyResult",
    "StudyRuns",
    "Validation",
    "canonical_demo",
    "capacity_of",
    "compare",
    "keeps",
    "load_study",
    "longest_run",
    "mean_interval",
    "median_interval",
    "open_study",
    "over_seeds",
    "paired_difference",
    "paired_median",
    "paper_predictions",
    "real_demo",
    "run_study",
    "same_run",
    "share_interval",
    "stored_deadlines",
    "tenants_demo",
    "under",
    "untold",
    "validate",
    "what_ifs",
    "windows_behind",
]

_HOME = {
    name: module
    for module, names in {
        "comparison": ("AIM", "Comparison", "compare"),
        "family": ("SAME_RUN", "UNTOLD", "Family", "same_run", "untold"),
        "capacity": ("Capacity", "CapacityPoint", "Limiting", "capacity_of", "what_ifs"),
        "study": ("Contender", "Point", "Study", "load_study"),
        "player": ("Example",),
        "hindsight": ("Hindsight",),
        "intervals": ("Interval", "mean_interval", "median_interval", "share_interval", "under"),
        "pairs": ("PairedDifference", "PairedMedian", "paired_difference", "paired_median"),
        "runner": ("StudyResult", "run_study"),
        "results": ("StudyRuns",),
        "validation": ("Validation", "validate"),
        "demo": ("canonical_demo", "longest_run", "real_demo", "stored_deadlines", "tenants_demo"),
        "kept_bounds": ("keeps",),
        "study_folder": ("open_study",),
        "predictions": ("paper_predictions",),
    }.items()
    for name in names
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: a worker plays, and needs no statistics (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module 'dwell.study' has no attribute {name!r}")
    return getattr(import_module(f"dwell.study.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
