"""The questions, one module each, in the order of the page.

A module has `TITLE`, the question, and `answer(cell, scale, run)`, which simulates its studies.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from dwell.study import Study, StudyResult, load_study

QUESTIONS = (
    "table",
    "dynamic",
    "concurrent",
    "reversion",
    "chatter",
    "weights",
    "deciding",
    "hysteresis",
    "jitter",
    "dominance",
    "real",
)

#: Simulates a study, or what is left to do of it.
Run: TypeAlias = Callable[[Study], StudyResult]


def study_file(name: str) -> Study:
    """Return one of the studies that are files."""
    return load_study(Path(__file__).resolve().parent.parent / "studies" / f"{name}.yaml")
