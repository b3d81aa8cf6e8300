"""Estimators by the names that a cell file uses."""

from __future__ import annotations

from collections.abc import Callable

from dwell.errors import ProblemError
from dwell.estimators.corrected import Corrected
from dwell.estimators.profile import Profile
from dwell.estimators.protocol import Estimator
from dwell.estimators.scaling import Scaling
from dwell.estimators.shadow import Shadow
from dwell.model.meaning import nearest
from dwell.model.problem import Problem

__all__ = ["REGISTRY", "by_name"]

#: Makers by name; the same names as ``dwell.model.problem.ESTIMATORS``.
REGISTRY: dict[str, Callable[[Problem], Estimator]] = {
    "profile": Profile,
    "shadow": Shadow,
    "scaling": Scaling,
    "corrected": Corrected,
}


def by_name(name: str, problem: Problem) -> Estimator:
    """Make an estimator for a problem.

    Raises
    ------
    ProblemError
        If there is none of that name; the message lists the known ones.
    """
    if name not in REGISTRY:
        known = ", ".join(REGISTRY)
        raise ProblemError(
            f"unknown estimator {name!r}; {nearest(name, REGISTRY)} (estimators here: {known})"
        )
    return REGISTRY[name](problem)
