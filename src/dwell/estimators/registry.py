"""Estimators by the names that a cell file and the command line use.

`REGISTRY` is the only list of the built-in estimators. A class is imported when an estimator is
made. Another package adds an estimator with an entry point of the group ``dwell.estimators``. A
user's class needs no entry: its name is ``package.module:Class``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

from dwell.errors import ProblemError, RunError
from dwell.model.bounds import CLASS_PATH
from dwell.model.controller_settings import USUAL_DWELL
from dwell.model.entry_points import class_named, names_with
from dwell.model.semantics import nearest_of
from dwell.model.user_classes import make_user_class, user_class

if TYPE_CHECKING:
    from dwell.estimators.protocol import Estimator
    from dwell.model.problem import Problem

#: Group of the entry points by which other packages add estimators.
GROUP = "dwell.estimators"


@dataclass(frozen=True, slots=True)
class EstimatorEntry:
    """A built-in estimator.

    Parameters
    ----------
    path : str
        ``module:Class``; the class takes the problem.
    sentence : str
        Predicate of a sentence whose subject is the estimator, for the legend of a report.
    style : int
        Index, from 0, of the marker and dashes of policies with this estimator in figures.
    shadows : bool
        Whether it sends shadow jobs through inactive candidates.
    """

    path: str
    sentence: str
    style: int
    shadows: bool = False


#: Built-in estimators by name, in the order of messages.
REGISTRY: Mapping[str, EstimatorEntry] = MappingProxyType(
    {
        "profile": EstimatorEntry(
            "dwell.estimators.profile:Profile",
            "prices what is not active by a static profile, as if nothing disturbed it; only "
            "the utilisation follows what is seen. This is how we read the paper's static "
            "profiling.",
            style=1,
        ),
        "shadow": EstimatorEntry(
            "dwell.estimators.shadow:Shadow",
            "sends some cycles through the other placements as well, and plays all of them with "
            "what these copies and active jobs showed to be other than in the profile. The copies "
            "cost compute time and bandwidth, which are paid for here.",
            style=2,
            shadows=True,
        ),
        "scaling": EstimatorEntry(
            "dwell.estimators.scaling:Scaling",
            "plays the other placements with what the active one shows: a task that takes more "
            "than in the profile takes as many times as much elsewhere, or what a known ratio of "
            "the nodes' compute times says.",
            style=3,
        ),
        "corrected": EstimatorEntry(
            "dwell.estimators.corrected:Corrected",
            "keeps the times of every task on every node and of every message on every link, "
            "begins with the profile's, corrects them by what active and shadow jobs reveal, "
            "forgets that with age, and plays the placements with them. It is ours.",
            style=0,
            shadows=True,
        ),
    }
)


def names() -> tuple[str, ...]:
    """Return the names of all estimators: built-in, then from installed packages, sorted."""
    return names_with(REGISTRY, GROUP)


def shadowing() -> frozenset[str]:
    """Return the names of the built-in estimators that send shadow jobs."""
    return frozenset(name for name, entry in REGISTRY.items() if entry.shadows)


def by_name(name: str, problem: Problem) -> Estimator:
    """Make an estimator for a problem.

    Parameters
    ----------
    name : str
        An estimator's name, or ``package.module:Class`` (see `dwell.model.user_classes`).

    Raises
    ------
    ProblemError
        If the name is unknown (the message lists the known names), or the package or class cannot
        be imported or made.
    """
    if CLASS_PATH.holds(name):
        own = make_user_class(name, problem, "estimate", "estimator", ProblemError)
        return cast("Estimator", own)
    kind = _class_of(name, problem)
    make = getattr(kind, "from_problem", None)
    return cast("Estimator", kind(problem) if make is None else make(problem))


def _class_of(name: str, problem: Problem) -> Any:
    """Import the class of an estimator."""
    if CLASS_PATH.holds(name):
        return user_class(name, problem.folder, "estimator", ProblemError)
    path = REGISTRY[name].path if name in REGISTRY else None
    kind = class_named(name, path, GROUP, "estimator", ProblemError)
    if kind is None:
        raise ProblemError(f"unknown estimator {name!r}; {nearest_of(name, names(), 'estimators')}")
    return kind


def resolved(problem: Problem, estimator: Estimator | str) -> Problem:
    """Return the problem with the N_min that it has with an estimator.

    If the cell sets no N_min, it is 0 for an estimator class with a true ``states_errors``: the
    margin of its standard errors already prevents moves by chance.

    Raises
    ------
    ProblemError
        As `by_name`.
    """
    settings = problem.controller
    if settings.min_dwell is not None:
        return problem
    kind = _class_of(estimator, problem) if isinstance(estimator, str) else type(estimator)
    # A user's class needs no base class.
    least = 0 if getattr(kind, "states_errors", False) is True else USUAL_DWELL
    return replace(problem, controller=replace(settings, min_dwell=least))


def name_in_run(meta: Mapping[str, Any]) -> str:
    """Return the name of the estimator that a run had.

    Parameters
    ----------
    meta : mapping
        Metadata of the run; ``estimator`` is a name, or the name of a class.

    Raises
    ------
    RunError
        If the name is unknown.
    """
    told = str(meta.get("estimator"))
    classes = {entry.path.partition(":")[2]: name for name, entry in REGISTRY.items()}
    name = classes.get(told, told)
    if name not in REGISTRY and not CLASS_PATH.holds(name):
        raise RunError(f"estimator {told!r} is not known (here: {', '.join(REGISTRY)})")
    return name
