"""The canonical cell with the dynamic scenarios beside its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dwell.cellfile import from_document
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.yaml_text import read_yaml
from dwell.model import Problem
from dwell.model.scenario import Scenario

EXAMPLES = Path(__file__).parents[2] / "examples"


def dynamic_problem() -> Problem:
    """Return the canonical cell with the scenarios of the study ``dynamic``."""
    cell, study = (_read(EXAMPLES / name) for name in ("canonical.yaml", "studies/dynamic.yaml"))
    scenarios = {**cell["scenarios"], **study["scenarios"]}
    return from_document({**cell, "scenarios": scenarios})


def dynamic_scenarios() -> Mapping[str, Scenario]:
    """Return the scenarios of the study ``dynamic`` alone."""
    own = _read(EXAMPLES / "studies/dynamic.yaml")["scenarios"]
    return {name: dynamic_problem().scenario(name) for name in own}


def _read(path: Path) -> Any:
    faults = Faults(str(path))
    document = read_yaml(str(path), faults)
    if faults:
        raise faults.error()
    return document
