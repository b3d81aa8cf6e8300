"""Values put into a cell's document at dotted paths, and settings into a problem."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from dwell.cellfile.document_faults import Faults, Step, dotted
from dwell.cellfile.rendering import as_read
from dwell.errors import Fault, ProblemError
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.model.semantics import nearest

#: Where the settings of a policy are: what they change is drawn nowhere.
SETTINGS = ("controller.", "objective.")

# Sections whose keys are names; what a path adds to one of them would not be connected to the rest.
NAMED = ("nodes", "tasks", "scales", "candidates", "scenarios")

INDEX = re.compile(r"\[(\d{1,9})\]")
KEY = re.compile(r"[^.\[\]]+")


def steps_of(path: str, document: object) -> tuple[Step, ...]:
    """Split a path into its steps.

    Parameters
    ----------
    path : str
        As ``links[0].delay_ms``. A name may hold a dot: the longest key that the document has is
        taken.
    document : object
        The cell's, as it is in the file.

    Raises
    ------
    ProblemError
        If it is no path, or leads where the document has nothing and may have nothing.
    """
    steps: list[Step] = []
    here, rest = document, path
    while rest or not steps:
        step, rest = _first(rest, here if isinstance(here, Mapping) else (), path)
        _require_place(step, steps, here, path)
        steps.append(step)
        if isinstance(here, Mapping):
            here = here.get(step, {})
        elif isinstance(here, list) and isinstance(step, int):
            here = here[step]
    return tuple(steps)


def _first(rest: str, keys: Iterable[object], path: str) -> tuple[Step, str]:
    """Take the first step off a path."""
    match = INDEX.match(rest)
    if match is not None:
        return int(match[1]), _after(rest[match.end() :], path)
    texts = [key for key in keys if isinstance(key, str)]
    known = [key for key in texts if re.match(rf"{re.escape(key)}(?=[.\[]|$)", rest)]
    key = max(known, key=len, default="")
    if not key:
        match = KEY.match(rest)
        if match is None:
            raise _fault(path, "not a path; write it as `links[0].delay_ms`")
        key = match[0]
    return key, _after(rest[len(key) :], path)


def _after(rest: str, path: str) -> str:
    if rest == "." or (rest and rest[0] not in ".["):
        raise _fault(path, "not a path; write it as `links[0].delay_ms`")
    return rest.removeprefix(".")


def _require_place(step: Step, before: list[Step], here: object, path: str) -> None:
    """Refuse a step that leads nowhere."""
    where = dotted(before) or "the cell"
    if isinstance(here, list):
        if not isinstance(step, int):
            raise _fault(path, f"{where} is a list; take one of its items, as `{where}[0]`")
        if step >= len(here):
            has = f"{len(here)} items, from [0]" if here else "no items"
            raise _fault(path, f"there is no {where}[{step}]; {where} has {has}")
    elif isinstance(step, int):
        raise _fault(path, f"{where} is no list; it has no item [{step}]")
    elif not isinstance(here, Mapping):
        raise _fault(path, f"{where} is {as_read(here)}; it has no key {step!r}")
    elif len(before) == 1 and before[0] in NAMED and step not in here:
        hint = nearest(step, [str(key) for key in here])
        raise _fault(path, f"the cell's {before[0]} have no {step!r}; {hint}")


def _fault(path: str, message: str) -> ProblemError:
    return ProblemError([Fault(path, message)])


def put(document: Any, steps: tuple[Step, ...], value: object) -> Any:
    """Return a document with a value at a place; the given one is not changed.

    Mappings on the way are made where there are none (see `steps_of`).
    """
    if not steps:
        return value
    step, *rest = steps
    if isinstance(step, int):
        items = list(document)
        items[step] = put(items[step], tuple(rest), value)
        return items
    return {**document, step: put(document.get(step, {}), tuple(rest), value)}


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
    from dwell.cellfile.assembly import Assembly
    from dwell.cellfile.cell_form import CELL
    from dwell.cellfile.structure import read_structure

    faults = Faults()
    document = to_document(problem)
    for path, value in settings.items():
        if not path.startswith(SETTINGS):
            begin = " or ".join(f"`{name}`" for name in SETTINGS)
            faults.add(path, f"not a setting; those of a policy begin with {begin}")
            continue
        steps = faults.attempt("", steps_of, path, document)
        if steps is not None:
            document = put(document, steps, value)
    if faults:
        raise faults.error()
    # Without its traces, which take time to read and which no setting depends on.
    other = Assembly(read_structure(document, faults, CELL), {}, faults).problem(problem.name)
    return replace(problem, objective=other.objective, controller=other.controller)
