"""Evolve: replace values of a problem, given by their paths in the cell file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, get_args

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import Bound
from dwell.model.declaration import DeclaredField, declared_fields, is_declared, made_at
from dwell.model.document import to_document
from dwell.model.dotted_paths import Step, beneath, steps_of
from dwell.model.problem import Problem
from dwell.model.process import Constant, Process
from dwell.model.semantics import nearest

#: Parts of a problem whose keys a cell file has at its top.
AT_TOP = ("pipeline", "fabric")


@dataclass(frozen=True, slots=True)
class _Value:
    value: object


#: Values by step after step.
_Tree: TypeAlias = "dict[Step, _Tree | _Value]"


def evolve(problem: Problem, changes: Mapping[str, object]) -> Problem:
    """Return the problem with some values replaced.

    Parameters
    ----------
    changes : mapping of str to object
        Values by their paths in a cell file: ``{"controller.min_dwell": 1, "period_ms": 40.0,
        "tasks.plan.on.E.exec_ms": 3.0}``. A value is an object of the model, a number for a
        constant process, or a mapping for a part with these keys.

    Raises
    ------
    ProblemError
        If a path does not exist, or a value is out of its bound or inconsistent with others.
    """
    document = to_document(problem)
    trees: dict[str, _Tree] = {}
    for path, value in changes.items():
        given = value
        if path == "objective.targets" and isinstance(value, Mapping):
            # As in a file, the latency target defaults to the deadline.
            given = {"latency_ms": problem.pipeline.deadline_ms, **value}
        *before, last = steps_of(path, document)
        first = before[0] if before else last
        home = next((name for name in AT_TOP if first in _keys(type(getattr(problem, name)))), "")
        tree: Any = trees.setdefault(home, {})
        for step in before:
            tree = tree.setdefault(step, {})
        tree[last] = _Value(given)
    whole = _arguments(problem, trees.pop("", {}), "")
    parts = {name: _changed(getattr(problem, name), tree, None, "") for name, tree in trees.items()}
    return replace(problem, **parts, **whole)


def _keys(kind: type) -> dict[str, DeclaredField]:
    return {one.named: one for one in declared_fields(kind)}


def _arguments(part: Any, tree: _Tree, path: str) -> dict[str, Any]:
    keys = _keys(type(part))
    given = {}
    for step, inner in tree.items():
        here, one = beneath(path, step), keys.get(str(step))
        if one is None:
            message = f"unknown key {step!r}; {nearest(str(step), keys)}"
            raise ProblemError([Fault(here, message)])
        given[one.name] = _changed(getattr(part, one.name), inner, one, here)
    return given


def _changed(part: Any, tree: _Tree | _Value, one: DeclaredField | None, path: str) -> Any:
    """Return a part with the values of a tree; `one` is the field of the part or around it."""
    if isinstance(tree, _Value):
        return tree.value if one is None else made_at(path, one.kind, _made, one, tree.value)
    if isinstance(part, Mapping | tuple):
        names = list(part) if isinstance(part, Mapping) else range(len(part))
        items = dict(part) if isinstance(part, Mapping) else dict(enumerate(part))
        for step, inner in tree.items():
            name = names[step] if isinstance(step, int) else step
            items[name] = _changed(items.get(name), inner, one, beneath(path, step))
        return items if isinstance(part, Mapping) else tuple(items.values())
    return made_at(path, type(part), replace, part, **_arguments(part, tree, path))


def _made(one: DeclaredField, value: object) -> Any:
    """Convert a value to the model: a number to a process, a mapping to a part."""
    kind = one.kind if not one.is_mapping or isinstance(value, Mapping) else get_args(one.kind)[1]
    whole = isinstance(one.key.bound, Bound) and one.key.bound.whole
    if whole and isinstance(value, float) and value.is_integer():
        return int(value)
    if kind is Process and isinstance(value, int | float) and not isinstance(value, bool):
        return Constant(float(value))
    if isinstance(value, Mapping) and isinstance(kind, type) and is_declared(kind):
        keys = _keys(kind)
        return kind(**{keys[name].name: _made(keys[name], item) for name, item in value.items()})
    return value
