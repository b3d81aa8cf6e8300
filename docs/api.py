"""The page of public Python names, from their docstrings: `python -m docs.api` writes it."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Mapping
from pathlib import Path

PAGE = Path(__file__).with_name("reference") / "api.md"
#: Public names by module, in the order of the page.
NAMES: Mapping[str, Mapping[str, str]] = {
    "Simulate": {
        "dwell": "load simulate draw simulate_realisation search open_run load_fleet "
        "simulate_fleet Run Realisation DwellError",
    },
    "Compare": {
        "dwell.study": "compare Contender Comparison load_study run_study open_study Hindsight "
        "paired_difference paired_median Family under keeps capacity_of",
        "dwell.report": "run_html comparison_html study_html",
    },
    "Extend": {
        "dwell.model": "Problem evolve Placement QoS Objective Weights Targets Caps",
        "dwell.cost": "cost hamming",
        "dwell.policies": "check_policy DTP ATP Cusum LatencyFirst WorkFunction Replicate Static",
        "dwell.estimators": "Profile Shadow Scaling Corrected",
        "dwell.live.stage": "Message Stage Actuator",
    },
}
TEXT = """# Which Python names may I use?

These names, and [`dwell.ros2`](../howto/ros2.md#payloads); all others are internal. Until 1.0 their
arguments may change; the [changelog](../../CHANGELOG.md) names each change. `help(dwell.load)` and
the site show each docstring. `python -m docs.api` writes this page.
"""


def page() -> str:
    """Return the page."""
    parts = [TEXT]
    for title, modules in NAMES.items():
        names = [f"{module}.{name}" for module in modules for name in modules[module].split()]
        rows = "\n".join(f"| `{name}` | {_sentence(name)} |" for name in names)
        parts.append(f"## {title}\n\n| name | sentence |\n|---|---|\n{rows}\n")
    return "\n".join(parts)


def _sentence(name: str) -> str:
    module, _, attribute = name.rpartition(".")
    importlib.import_module(module)
    text = inspect.getdoc(pkgutil.resolve_name(f"{module}:{attribute}")) or ""
    return text.partition("\n")[0]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
