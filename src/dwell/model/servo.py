"""The reference servo loop: what the commands of a run would have done to a robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

from dwell.model.bounds import AMPLITUDE_MM, DAMPING, SERVO_GAIN, TARGET_PERIOD_S, require

Plant: TypeAlias = Literal["integrator", "double-integrator"]
PLANTS: tuple[Plant, ...] = ("integrator", "double-integrator")


@dataclass(frozen=True, slots=True)
class MovingTarget:
    """Moving target: r(t) = amplitude · sin(2 pi t / period), t from the first release.

    Parameters
    ----------
    amplitude_mm : float
        All errors are proportional to it.
    """

    amplitude_mm: float
    period_s: float

    def __post_init__(self) -> None:
        AMPLITUDE_MM.check("target.amplitude_mm", self.amplitude_mm)
        TARGET_PERIOD_S.check("target.period_s", self.period_s)

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2 * math.pi / self.period_s


@dataclass(frozen=True, slots=True)
class Servo:
    """One axis of a robot that follows a moving target by what the camera saw.

    Parameters
    ----------
    plant : {"integrator", "double-integrator"}
        The command is a velocity, or an acceleration.
    gain : float
        Command for an error of 1: 1/s for the integrator, 1/s² for the double integrator.
    damping : float
        Command for an error that grows by 1 a second, 1/s; above 0 for the double integrator, 0 for
        the integrator.
    """

    plant: Plant
    gain: float
    target: MovingTarget
    damping: float = 0.0

    def __post_init__(self) -> None:
        require(self.plant in PLANTS, "plant", self.plant, f"one of {', '.join(PLANTS)}")
        SERVO_GAIN.check("gain", self.gain)
        DAMPING.check("damping", self.damping)
        if self.plant == "double-integrator":
            bound = "above 0 with a double-integrator, which swings without end otherwise"
            require(self.damping > 0, "damping", self.damping, bound)
        else:
            bound = "left out with an integrator, which needs none"
            require(self.damping == 0, "damping", self.damping, bound)

    def require_seen(self, period_ms: float) -> None:
        """Refuse a target that moves too fast for the camera: it takes a frame a cycle.

        Raises
        ------
        ProblemError
            If the target's period is less than two of the cell's (the sampling theorem).
        """
        least_s = 2 * period_ms / 1e3
        bound = f"at least {least_s:g}, two periods of the cell"
        value_s = self.target.period_s
        require(value_s >= least_s, "servo.target.period_s", value_s, bound)
