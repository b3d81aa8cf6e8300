"""The machine that a benchmark runs on: one core of it, and what to call it."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path

from dwell import __version__


def available_cores() -> list[int]:
    """Cores that this process may use; one nameless core where the system does not say."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return [0]


def pin(cores: list[int]) -> None:
    """Keep this process, and those it starts, on the last of the cores."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {cores[-1]})
    # Libraries that ask for the number of cores of the machine would start threads for all.
    for name in ("POLARS_MAX_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"


def describe(cores: list[int]) -> dict[str, str]:
    """Processor, system and versions."""
    load = f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"
    return {
        "processor": _processor(),
        "cores": f"1 of {len(cores)} (load {load} at the start)",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "dwell": __version__,
        **{name: version(name) for name in ("numpy", "polars")},
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
