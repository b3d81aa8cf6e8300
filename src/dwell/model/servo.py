"""The reference servo loop, which applies the commands of a run to a simulated robot."""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

from dwell.model.bounds import LARGEST, MAX_COUNT, Bound, require
from dwell.model.declaration import declared, key

Plant: TypeAlias = Literal["integrator", "double-integrator"]


@declared("target")
class MovingTarget:
    """The target: r(t) = amplitude · sin(2 pi t / period), t from the first release."""

    amplitude_mm: float = key(
        "Amplitude, mm; errors are proportional to it.", Bound(1e-6, MAX_COUNT)
    )
    period_s: float = key(
        "Duration of one swing, s; at least two frames of the camera.", Bound(1e-5, LARGEST)
    )

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2 * math.pi / self.period_s


@declared()
class Servo:
    """One axis of a robot that follows a moving target with a camera."""

    plant: Plant = key(
        "Effect of a command: it sets the velocity (`integrator`) or the acceleration."
    )
    gain: float = key(
        "Command for an error of 1: 1/s, for a `double-integrator` 1/s².",
        Bound(0, MAX_COUNT, above=True),
    )
    target: MovingTarget = key("Target that the robot follows.")
    damping: float = key(
        "Command for an error that grows by 1 a second, 1/s; for a `double-integrator`, which "
        "needs it.",
        Bound(0, MAX_COUNT),
        default=0.0,
    )

    def __post_init__(self) -> None:
        if self.plant == "double-integrator":
            bound = "above 0 with a double-integrator, which swings without end otherwise"
            require(self.damping > 0, "damping", self.damping, bound)
        else:
            bound = "left out with an integrator, which needs none"
            require(self.damping == 0, "damping", self.damping, bound)

    def require_seen(self, frame_ms: float) -> None:
        """Check that the target is slow enough for a camera with a frame every `frame_ms`.

        Raises
        ------
        ProblemError
            If the target's period is less than two frames (the sampling theorem).
        """
        least_s = 2 * frame_ms / 1e3
        bound = f"at least {least_s:g}, two frames of the camera"
        value_s = self.target.period_s
        require(value_s >= least_s, "servo.target.period_s", value_s, bound)
