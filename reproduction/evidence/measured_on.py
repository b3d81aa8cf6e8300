"""Origin of an evidence page: day, processor and commit."""

from __future__ import annotations

import subprocess
from datetime import date
from pathlib import Path

from benchmarks.machine import available_cores, describe


def measured_on() -> str:
    """Return the sentence in which an evidence page names its origin."""
    words = "git", "rev-parse", "--short", "HEAD"
    found = subprocess.run(words, cwd=Path(__file__).parent, check=True, capture_output=True)
    processor = describe(available_cores())["processor"]
    commit = found.stdout.decode().strip()
    return f"Measured on {date.today().isoformat()} ({processor}, commit {commit})."
