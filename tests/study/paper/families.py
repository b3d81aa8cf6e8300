"""Families of comparisons made by hand, with the verdicts that a test wants."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.study.family import Family
from dwell.study.paired import PairedDifference

__all__ = ["make_family"]


def make_family(said: Mapping[str, str], *, metric: str = "violation_rate") -> Family:
    """Return a family in which each comparison has the verdict that it is given.

    Parameters
    ----------
    said : mapping of str to str
        ``lower`` (by 10 points), ``higher`` (by 10), ``same`` (a tight 0), or ``open``.
    metric : str
    """
    known = {
        "lower": PairedDifference(-0.1, -0.12, -0.08, -5.0, 1.0, 1e-9, 20),
        "higher": PairedDifference(0.1, 0.08, 0.12, 5.0, 0.0, 1e-9, 20),
        "same": PairedDifference(0.0, -0.001, 0.001, 0.0, 0.5, 1.0, 20),
        "open": PairedDifference(-0.02, -0.1, 0.06, -0.1, 0.6, 0.8, 20),
    }
    return Family("made by hand", metric, {name: known[one] for name, one in said.items()})
