"""Cells whose controllers decide once per window."""

from __future__ import annotations

from dataclasses import replace

from dwell.model import ControllerSettings, Problem


def once(settings: ControllerSettings, window_cycles: int) -> ControllerSettings:
    """Give the paper's settings to a controller that leaves them out: W, N_min 3, the profile."""
    return replace(
        settings,
        decide_cycles=settings.decide_cycles or window_cycles,
        min_dwell=3 if settings.min_dwell is None else settings.min_dwell,
        estimator=settings.estimator or "profile",
    )


def with_windows(problem: Problem, window_cycles: int) -> Problem:
    """Return a cell with windows of another length, which decides once in each."""
    settings = replace(problem.controller, decide_cycles=window_cycles)
    return replace(problem, window_cycles=window_cycles, controller=settings)
