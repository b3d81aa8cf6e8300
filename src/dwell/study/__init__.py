"""Studies: many runs, and the statistics over their seeds."""

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
from dwell.study.intervals import Interval, mean_interval, median_interval, share_interval, under
from dwell.study.kept_bounds import keeps
from dwell.study.over_seeds import over_seeds, windows_behind
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
    "Comparison",
    "Contender",
    "Example",
    "Family",
    "Hindsight",
    "Interval",
    "PairedDifference",
    "PairedMedian",
    "Point",
    "Study",
    "StudyResult",
    "StudyRuns",
    "Validation",
    "canonical_demo",
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
    "windows_behind",
]
