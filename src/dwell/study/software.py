"""Versions of the software that the numbers of a study depend on."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import version
from typing import Any, TypeAlias

from dwell.cellfile.sources import digest_of
from dwell.errors import SimulationError
from dwell.model import FrozenDict
from dwell.model.bounds import CLASS_PATH
from dwell.model.document import to_document
from dwell.model.user_classes import object_digest, source_digest, user_function
from dwell.policies.registry import estimator_of
from dwell.record.fleet_run import fleet_document
from dwell.study.study import Contender, Point, Study

#: Python sources of this package that make numbers; the kernel has a digest of its own.
SOURCES = (
    *("control", "cost.py", "estimators", "kernels", "model", "policies", "sim"),
    "record/table_arrays.py",
    *(f"study/{name}.py" for name in ("clairvoyant", "fleet_summary", "hindsight", "oracle")),
    *(f"study/{name}.py" for name in ("parts", "player", "quality", "reference", "script")),
    *(f"study/{name}.py" for name in ("study_tables", "summary")),
)

#: Digests of own code by its name, for each player.
Sources: TypeAlias = "Mapping[str, Mapping[str, str | None]]"


def versions() -> dict[str, str]:
    """Return the versions of the software that makes numbers.

    Raises
    ------
    KernelError
        If the compiled kernel cannot be used.
    """
    from dwell.sim.versions import versions as simulators

    return {**simulators(), "polars": version("polars")}


@cache
def software() -> Mapping[str, str]:
    """Return the versions and digests that must be equal for bit-identical numbers.

    The kernel has only the digest of its sources, because every compiler gives the same numbers;
    ``sources`` is the digest of this package's Python sources.
    """
    from dwell.sim.versions import kernel_digest

    own = {"kernel": kernel_digest(), "sources": digest_of(SOURCES)}
    return FrozenDict({**versions(), **own})


def describe(study: Study) -> dict[str, Any]:
    """Return all inputs of a study's tables except the user's own code, ready for JSON.

    Raises
    ------
    SimulationError
        If a policy or an estimator is an object that does not pickle.
    """
    cells = [to_document(point.problem) for point in study.points]
    fleets = [fleet_document(one.fleet) for one in study.points if one.fleet is not None]
    return {
        "name": study.name,
        "software": software(),
        "scenarios": list(study.scenarios),
        "policies": {one.name: _contender(one) for one in study.contenders},
        "seeds": list(study.seeds),
        "windows": study.windows,
        "references": study.references,
        "parameters": list(study.parameters),
        "points": [list(point.values.values()) for point in study.points],
        "cell": cells[0],
        "cells": _digest(cells),
        **({"fleets": _digest(fleets)} if fleets else {}),
        **({"metrics": dict(study.metrics)} if study.metrics else {}),
    }


def own_sources(study: Study) -> Sources:
    """Return a digest of the source of all code of a user's own, by its name, for each player.

    Raises
    ------
    SimulationError
        If a metric cannot be imported.
    """
    metrics = {}
    for path in study.metrics.values():
        user_function(path, study.folder, "metric", SimulationError)
        metrics[path] = source_digest(path, study.folder)
    own = {one.name: {**_sources(one, study), **metrics} for one in study.contenders}
    return {name: own.get(name, metrics) for name in study.players}


def modules_of(sources: Sources) -> dict[str, str | None]:
    """Return the digests of all code of a user's own, by its name."""
    return {name: digest for used in sources.values() for name, digest in used.items()}


def _sources(contender: Contender, study: Study) -> dict[str, str | None]:
    """Return a digest of the source of a contender's own classes, by their names."""
    found: dict[str, str | None] = {}
    for point in study.points:
        for part, folder in _used(contender, point):
            if not isinstance(part, str):
                path = f"{type(part).__module__}:{type(part).__qualname__}"
                found.setdefault(path, object_digest(part))
            elif CLASS_PATH.holds(part) and part not in found:
                found[part] = source_digest(part, folder)
    return found


def _used(contender: Contender, point: Point) -> Iterator[tuple[object, str | None]]:
    """Yield the policy and the estimators of a contender at a point, with their folders."""
    problem, fleet = point.problem, point.fleet
    yield contender.policy, problem.folder
    estimator = contender.estimator or contender.settings.get("controller.estimator")
    if estimator is not None:
        yield estimator, problem.folder
    elif fleet is None:
        yield estimator_of(problem, contender.policy), problem.folder
    else:
        for one in fleet.entries:
            named = one.estimator or fleet.estimator or estimator_of(one.cell)
            yield named, one.cell.folder


def part_digests(description: Mapping[str, Any], sources: Sources) -> dict[str, str]:
    """Return a digest of everything that determines the runs of each player, by the player.

    Parameters
    ----------
    description, sources
        What `describe` and `own_sources` return.
    """
    policies = description["policies"]
    common = {name: value for name, value in description.items() if name != "policies"}
    shared = _digest(common)
    return {
        name: _digest([shared, name, policies.get(name), used])[:16]
        for name, used in sources.items()
    }


def _digest(document: object) -> str:
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def _contender(contender: Contender) -> Mapping[str, Any]:
    return {
        "policy": _known_as(contender, contender.policy),
        "estimator": _known_as(contender, contender.estimator),
        "settings": dict(contender.settings),
    }


def _known_as(contender: Contender, given: object) -> str | None:
    """Return what an object will be known by again: its class, and a digest of its state."""
    if given is None or isinstance(given, str):
        return given
    kind = f"{type(given).__module__}.{type(given).__qualname__}"
    try:
        state = pickle.dumps(given, protocol=5)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise SimulationError(
            f"{contender.name} does not pickle ({error}); its state could not be known again"
        ) from None
    return f"{kind} {hashlib.sha256(state).hexdigest()[:16]}"
