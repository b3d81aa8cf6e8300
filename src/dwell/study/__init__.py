"""Studies: many runs, and the statistics over their seeds."""

from dwell.study.comparison import AIM, Comparison, Example, compare
from dwell.study.demo import canonical_demo, real_demo
from dwell.study.intervals import Interval

__all__ = ["AIM", "Comparison", "Example", "Interval", "canonical_demo", "compare", "real_demo"]
