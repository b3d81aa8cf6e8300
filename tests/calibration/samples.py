"""Measurements with samples that are made up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dwell.calibration.profile_file import Measurement

QUIET: dict[str, Any] = {
    "load": 0.1,
    "cpus": 4,
    "governor": "performance",
    "frequency_mhz": [2000.0, 2000.0],
    "steal": 0.0,
    "preemptions": 0,
    "cpu_s": 1.0,
}


def task(
    name: str, node: str, samples: Sequence[float], cores: float = 1.0, **about: Any
) -> Measurement:
    """Return a measurement of a task."""
    values = np.array(samples, np.float64)
    full = f"{name}@{node}"
    return Measurement(
        full,
        {full: values, f"{full}/cpu_ms": values * cores},
        {
            "kind": "task",
            "task": name,
            "node": node,
            "cores_used": cores,
            "empty_wall_ms": 1e-4,
            "late": 0,
            "conditions": QUIET,
            **about,
        },
    )


def link(source: str, target: str, samples: Sequence[float], rate: float | None) -> Measurement:
    """Return a measurement of a link."""
    values = np.array(samples, np.float64)
    name = f"{source}->{target}"
    return Measurement(
        name,
        {name: values, f"{name}/round_trip_ms": 2 * values},
        {
            "kind": "link",
            "from": source,
            "to": target,
            "rate_mbps": rate,
            "late": 0,
            "conditions": QUIET,
        },
    )
