"""Paths: dotted names of places in a cell file, as ``links[0].delay_ms``."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from typing import TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import as_read
from dwell.model.semantics import nearest

Step: TypeAlias = str | int

# Sections whose keys are names; a path cannot add a name, which nothing else would refer to.
NAMED = ("nodes", "tasks", "scales", "candidates", "scenarios")

INDEX = re.compile(r"\[(\d{1,9})\]")
KEY = re.compile(r"[^.\[\]]+")


def dotted(steps: Iterable[Step]) -> str:
    """Return ``links[0].from`` for ("links", 0, "from")."""
    return reduce(beneath, steps, "")


def beneath(path: str, step: Step) -> str:
    """Return the path of a key or an index below a path."""
    if isinstance(step, int):
        return f"{path}[{step}]"
    key = step or "''"
    return f"{path}.{key}" if path else key


def overlap_faults(places: Mapping[str, tuple[Step, ...]]) -> Iterator[Fault]:
    """Yield a fault for each path that is a part of another; `places` are steps by their names."""
    for (place, inner), (_, outer) in itertools.permutations(places.items(), 2):
        if inner[: len(outer)] == outer:
            yield Fault(place, f"is a part of {dotted(outer)}; give one of them")


def steps_of(path: str, document: object) -> tuple[Step, ...]:
    """Split a path into its steps.

    Parameters
    ----------
    path : str
        As ``links[0].delay_ms``. If names contain dots, the longest key of the document matches.
    document : object
        The cell's, as it is in the file.

    Raises
    ------
    ProblemError
        If the text is no path, or the document cannot have a value there.
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
    """Raise a ProblemError if the document has no place for a step."""
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
