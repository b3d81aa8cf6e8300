"""The example cells that need nothing but a simulator."""

from __future__ import annotations

from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"
CELLS = ("canonical", "fan-in", "cloud")
