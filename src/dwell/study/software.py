"""Versions of the software that the numbers of a study depend on."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from typing import Any

from dwell.cellfile.sources import digest_of
from dwell.errors import SimulationError
from dwell.model import FrozenDict
from dwell.model.bounds import CLASS_PATH
from dwell.model.document import to_document
from dwell.model.user_classes import source_digest
from dwell.record.fleet_run import fleet_document
from dwell.study.study import Contender, Study

#: Python sources of this package that make numbers; the kernel has a digest of its own.
SOURCES = (
    *("control", "cost.py", "estimators", "kernels", "model", "policies", "sim"),
    "record/table_arrays.py",
    *(f"study/{name}.py" for name in ("clairvoyant", "fleet_summary", "hindsight", "player")),
    *(f"study/{name}.py" for name in ("quality", "reference", "runner", "script", "summary")),
)


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
    """Return what has to be the same for the same numbers, to the last bit.

    Returns
    -------
    mapping of str to str
        The versions, of the kernel only the digest of its sources, since every compiler makes the
        same of them; ``sources``, the digest of this package's own.
    """
    from dwell.sim.versions import kernel_digest

    own = {"kernel": kernel_digest(), "sources": digest_of(SOURCES)}
    return FrozenDict({**versions(), **own})


def describe(study: Study) -> dict[str, Any]:
    """Return all that the tables of a study depend on, ready for JSON.

    Raises
    ------
    SimulationError
        If a policy or an estimator is an object that does not pickle.
    """
    cells = [to_document(point.problem) for point in study.points]
    fleets = [fleet_document(one.fleet) for one in study.points if one.fleet is not None]
    own = _own_sources(study)
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
        "cells": hashlib.sha256(json.dumps(cells).encode()).hexdigest(),
        **({"fleets": hashlib.sha256(json.dumps(fleets).encode()).hexdigest()} if fleets else {}),
        **({"modules": own} if own else {}),
    }


def _own_sources(study: Study) -> dict[str, str | None]:
    """Return a digest of the module of every class of a user's own, by the class's name."""
    settings = study.points[0].problem.controller
    used = [part for one in study.contenders for part in (one.policy, one.estimator)]
    folder = study.points[0].problem.folder
    given = [settings.estimator, *(part for part in used if isinstance(part, str))]
    names = sorted(filter(CLASS_PATH.holds, given))
    return {name: source_digest(name, folder) for name in names}


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
