"""Values put into a cell's document at dotted paths, and settings into a problem."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dwell.cellfile.document_faults import Faults
from dwell.errors import ProblemError
from dwell.model import Problem, evolve
from dwell.model.dotted_paths import Step
from dwell.model.fabric import accelerator_tiers

#: Prefixes of a policy's settings, which change no random number.
SETTINGS = ("controller.", "objective.")
#: The counted accelerators follow from the counted tiers.
TIERS, ACCELERATORS = "objective.tiers", "objective.accelerators"


def put(document: Any, steps: tuple[Step, ...], value: object) -> Any:
    """Return a document with a value at a place; the given one is not changed.

    Missing mappings on the way are made (see `steps_of`).
    """
    if not steps:
        return value
    step, *rest = steps
    if isinstance(step, int):
        items = list(document)
        items[step] = put(items[step], tuple(rest), value)
        return items
    # Another value here comes from a path that begins this path, which is a reported fault.
    inner = document if isinstance(document, Mapping) else {}
    return {**inner, step: put(inner.get(step, {}), tuple(rest), value)}


def with_settings(problem: Problem, settings: Mapping[str, object]) -> Problem:
    """Return a problem with other settings of its controller and objective.

    Everything that is drawn stays as it is: both problems play the same realisations.

    Parameters
    ----------
    settings : mapping of str to object
        Values as in a cell file by their paths, which begin with one of `SETTINGS`:
        ``{"controller.min_dwell": 1, "objective.weights.switching": 0.5}``.

    Raises
    ------
    ProblemError
        With every fault found; a path that begins with something else is one.
    """
    faults = Faults()
    for path in settings:
        if not path.startswith(SETTINGS):
            begin = " or ".join(f"`{name}`" for name in SETTINGS)
            faults.add(path, f"not a setting; settings of a policy begin with {begin}")
    changes = dict(settings)
    if TIERS in changes or ACCELERATORS in changes:
        counts = changes.get(ACCELERATORS, bool(problem.objective.accelerators))
        tiers: Any = changes.get(TIERS, problem.objective.tiers)
        changes[ACCELERATORS] = accelerator_tiers(problem.fabric.nodes, tiers) if counts else {}
    if not faults:
        try:
            return _registered(evolve(problem, changes))
        except ProblemError as error:
            together = error
    # Each change alone reports its own faults.
    for path, value in changes.items():
        if path.startswith(SETTINGS):
            faults.attempt("", evolve, problem, {path: value})
    raise faults.error() if faults else together


def _registered(problem: Problem) -> Problem:
    """Return a problem whose policy and estimator are known."""
    from dwell.cellfile.assembly import unregistered

    faults = unregistered(problem.parts, problem.name)
    if faults:
        raise ProblemError(faults)
    return problem
