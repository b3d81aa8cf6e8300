"""Runs of the small cell, in folders."""

from __future__ import annotations

from pathlib import Path

import dwell
from dwell.record import Run
from tests.cli.small_cell import SMALL


def small_run(
    folder: Path, *, policy: str = "dtp", seed: int = 1, windows: int = 60, jobs: bool = True
) -> Run:
    """Simulate the small cell under stress, and save the run."""
    file = folder.parent / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    problem = dwell.load(file)
    run = dwell.simulate(
        problem, scenario="stress", policy=policy, seed=seed, windows=windows, jobs=jobs
    )
    run.save(folder)
    return run
