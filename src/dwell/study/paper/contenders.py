"""The contenders of the chapters: placements that never move, and policies with their beliefs."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model import Problem
from dwell.study.study import Contender

__all__ = ["PAPERS_DTP", "believing", "statics"]

#: DTP as we read the paper's: with the estimator it calls static profiling.
PAPERS_DTP = "dtp+profile"


def believing(
    policy: str, estimator: str, settings: Mapping[str, object] | None = None, *, name: str = ""
) -> Contender:
    """Return a policy with an estimator, called ``dtp+corrected`` unless it is given a name."""
    return Contender(name or f"{policy}+{estimator}", policy, estimator, settings or {})


def statics(problem: Problem) -> tuple[Contender, ...]:
    """Return every candidate's placement, which never moves."""
    return tuple(Contender(name, name) for name in problem.candidates)
