"""The settings of a controller that decides once per window."""

from __future__ import annotations

from dataclasses import replace

from dwell.model import ControllerSettings


def once(settings: ControllerSettings, window_cycles: int) -> ControllerSettings:
    """Give the paper's settings to a controller that leaves them out: W, N_min 3, the profile."""
    return replace(
        settings,
        decide_cycles=settings.decide_cycles or window_cycles,
        min_dwell=3 if settings.min_dwell is None else settings.min_dwell,
        estimator=settings.estimator or "profile",
    )
