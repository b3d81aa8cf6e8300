"""Evolve: replace values of a problem, given by their paths in the cell file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, replace
from typing import Any, TypeAlias, get_args, get_origin

from dwell.errors import Fault, PlacementError, ProblemError
from dwell.model.bounds import require
from dwell.model.declaration import DeclaredField, declared_fields, is_declared, made_at
from dwell.model.document import to_document
from dwell.model.dotted_paths import Step, beneath, overlap_faults, steps_of
from dwell.model.fabric import Node
from dwell.model.objective import latency_target_ms
from dwell.model.pipeline import Pipeline, Task
from dwell.model.placement import Placement, Replicas
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
        constant process, or a mapping of the keys of a part; parts by name, as `chains`, are a
        mapping of such parts, and parts in a tuple, as `flows`, a list.

    Raises
    ------
    ProblemError
        If a path does not exist, or a value is out of its bound or inconsistent with others.
    """
    document = to_document(problem)
    trees: dict[str, _Tree] = {}
    places = {path: steps_of(path, document) for path in changes}
    if faults := [*overlap_faults(places)]:
        raise ProblemError(faults)
    for path, (*before, last) in places.items():
        first = before[0] if before else last
        home = next((name for name in AT_TOP if first in _keys(type(getattr(problem, name)))), "")
        tree: Any = trees.setdefault(home, {})
        for step in before:
            tree = tree.setdefault(step, {})
        tree[last] = _Value(changes[path])
    top = trees.pop("", {})
    parts = {name: _changed(getattr(problem, name), tree, None, "") for name, tree in trees.items()}
    _add_latency_target(top.get("objective"), problem, parts.get("pipeline", problem.pipeline))
    return replace(problem, **parts, **_arguments(problem, top, ""))


def _add_latency_target(tree: Any, problem: Problem, pipeline: Pipeline) -> None:
    """Add the latency target to given targets without one, as a cell file does."""
    targets = tree.get("targets") if isinstance(tree, dict) else None
    if isinstance(targets, _Value) and isinstance(targets.value, Mapping):
        named = tree.get("latency", _Value(problem.objective.latency))
        chains = (chain for name, chain in pipeline.chains.items() if _Value(name) == named)
        chain = next(chains, None)
        target_ms = latency_target_ms(pipeline.deadline_ms, chain)
        tree["targets"] = _Value({"latency_ms": target_ms, **targets.value})


def _keys(kind: type) -> dict[str, DeclaredField]:
    return {one.named: one for one in declared_fields(kind)}


def _key(keys: Mapping[str, DeclaredField], step: Step, path: str) -> DeclaredField:
    """Return the key of a part that a step names."""
    if (one := keys.get(str(step))) is None:
        raise _fault(path, f"unknown key {step!r}; {nearest(str(step), keys)}")
    return one


def _arguments(part: Any, tree: _Tree, path: str) -> dict[str, Any]:
    keys, given = _keys(type(part)), {}
    for step, inner in tree.items():
        here = beneath(path, step)
        one = _key(keys, step, here)
        given[one.name] = _changed(getattr(part, one.name), inner, one.kind, here, one.default)
    return given


def _changed(
    part: Any, tree: _Tree | _Value, kind: Any, path: str, default: object = MISSING, name: str = ""
) -> Any:
    """Return a part with the values of a tree; `kind` is its type, `name` its key in a mapping."""
    if isinstance(tree, _Value) or part is None:
        value = _plain(tree)
        return None if value is None and default is None else _made(kind, value, path, name)
    if isinstance(part, Replicas):
        raise _fault(path, "has two copies of each cycle; give it whole, as `Replicas`")
    if isinstance(part, Mapping | tuple):
        names = list(part) if isinstance(part, Mapping) else range(len(part))
        items = dict(part) if isinstance(part, Mapping) else dict(enumerate(part))
        for step, inner in tree.items():
            at = names[step] if isinstance(step, int) else step
            inside = _kind_inside(kind), beneath(path, step)
            items[at] = _changed(items.get(at), inner, *inside, name=str(step))
        changed = items if isinstance(part, Mapping) else tuple(items.values())
        return _made(kind, changed, path, name)
    return made_at(path, type(part), replace, part, **_arguments(part, tree, path))


def _plain(tree: _Tree | _Value) -> object:
    """Return the values of a tree as a mapping."""
    if isinstance(tree, _Value):
        return tree.value
    return {step: _plain(inner) for step, inner in tree.items()}


def _kind_inside(kind: Any) -> Any:
    """Return the type of the items of a mapping or a tuple; of placements, `str`."""
    if get_origin(kind) is tuple:
        return get_args(kind)[0]
    return get_args(kind)[1] if get_origin(kind) is Mapping else str


def _made(kind: Any, value: Any, path: str, name: str = "") -> Any:
    """Convert a value to a type of the model: a number to a process, a mapping to a part.

    Values of other types stay as they are; the constructor of their part checks them.
    """
    if get_origin(kind) is Mapping:
        require(isinstance(value, Mapping), path, value, "a mapping")
        inside = _kind_inside(kind)
        return {at: _made(inside, one, beneath(path, at), at) for at, one in value.items()}
    if get_origin(kind) is tuple:
        require(isinstance(value, list | tuple), path, value, "a list")
        inside = _kind_inside(kind)
        return tuple(_made(inside, one, beneath(path, i)) for i, one in enumerate(value))
    kinds = get_args(kind) or (kind,)
    if int in kinds and isinstance(value, float) and value.is_integer():
        return int(value)
    if kind is Process and isinstance(value, int | float) and not isinstance(value, bool):
        return Constant(float(value))
    parts = [one for one in kinds if is_declared(one)]
    if isinstance(value, Mapping) and not isinstance(value, Placement):
        if len(parts) == 1:
            return _part(parts[0], value, path, name)
        if kind is Placement:
            return _placement(value, path)
    if parts or kind in (Process, Placement):
        names = " or ".join(f"`{one.__name__}`" for one in kinds)
        further = ", or a mapping of its keys" if len(parts) == 1 else ""
        require(isinstance(value, kinds), path, value, f"of the type {names}{further}")
    return value


def _part(kind: Any, values: Mapping[Any, Any], path: str, name: str) -> Any:
    """Make a part from its keys; nodes and tasks have the name of their key."""
    keys = _keys(kind)
    given: dict[str, Any] = {"name": name} if kind in (Node, Task) else {}
    for step, value in values.items():
        here = beneath(path, step)
        one = _key(keys, step, here)
        is_absent = value is None and one.default is None
        given[one.name] = None if is_absent else _made(one.kind, value, here)
    for named, one in keys.items():
        if one.default is MISSING and one.name not in given:
            raise _fault(beneath(path, named), f"missing; add it: {one.key.says}")
    return made_at(path, kind, kind, **given)


def _placement(nodes: Mapping[str, str], path: str) -> Placement:
    try:
        return Placement(nodes)
    except PlacementError as error:
        raise _fault(path, str(error)) from None


def _fault(path: str, message: str) -> ProblemError:
    return ProblemError([Fault(path, message)])
