"""Estimators by the names that a cell file uses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from dwell.errors import ProblemError, RunError
from dwell.estimators.corrected import Corrected
from dwell.estimators.profile import Profile
from dwell.estimators.protocol import Estimator
from dwell.estimators.scaling import Scaling
from dwell.estimators.shadow import Shadow
from dwell.model.problem import Problem
from dwell.model.semantics import nearest_of

__all__ = ["REGISTRY", "by_name", "name_in_run"]

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
        hint = nearest_of(name, REGISTRY, "estimators")
        raise ProblemError(f"unknown estimator {name!r}; {hint}")
    return REGISTRY[name](problem)


def name_in_run(meta: Mapping[str, Any]) -> str:
    """Return the name of the estimator that a run had; the profile where it does not say.

    Parameters
    ----------
    meta : mapping
        Of the run: ``estimator`` is a name, or the class of one.

    Raises
    ------
    RunError
        If it is none of these.
    """
    told = str(meta.get("estimator") or "profile")
    names = {getattr(maker, "__name__", name): name for name, maker in REGISTRY.items()}
    name = names.get(told, told)
    if name not in REGISTRY:
        raise RunError(f"estimator {told!r} is not known (here: {', '.join(REGISTRY)})")
    return name
