"""Studies: many runs, and the statistics over their seeds."""

from dwell.study.comparison import AIM, Comparison, Example, compare
from dwell.study.demo import canonical_demo, real_demo, tenants_demo
from dwell.study.engine import StudyResult, run_study
from dwell.study.family import Family
from dwell.study.intervals import Interval, under
from dwell.study.paired import PairedDifference, PairedMedian, paired_difference, paired_median
from dwell.study.sensitivity import Parameter, sobol_design, sobol_indices, sobol_pairs
from dwell.study.study import Contender, Point, Study, load_study
from dwell.study.validation import Validation, validate

__all__ = [
    "AIM",
    "Comparison",
    "Contender",
    "Example",
    "Family",
    "Interval",
    "PairedDifference",
    "PairedMedian",
    "Parameter",
    "Point",
    "Study",
    "StudyResult",
    "Validation",
    "canonical_demo",
    "compare",
    "load_study",
    "paired_difference",
    "paired_median",
    "real_demo",
    "run_study",
    "sobol_design",
    "sobol_indices",
    "sobol_pairs",
    "tenants_demo",
    "under",
    "validate",
]
