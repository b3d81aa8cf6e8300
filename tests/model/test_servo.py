from __future__ import annotations

import math

import pytest

from dwell.errors import ProblemError
from dwell.model import MovingTarget, Servo

TARGET = MovingTarget(amplitude_mm=100, period_s=4)


def test_omega_is_that_of_the_period() -> None:
    assert math.isclose(TARGET.omega, math.pi / 2)


def test_damping_is_for_the_double_integrator_alone() -> None:
    Servo("double-integrator", 4.0, TARGET, damping=3.0)
    with pytest.raises(ProblemError, match="above 0 with a double-integrator"):
        Servo("double-integrator", 4.0, TARGET)
    with pytest.raises(ProblemError, match="left out with an integrator"):
        Servo("integrator", 4.0, TARGET, damping=1.0)
    with pytest.raises(ProblemError, match="one of integrator, double-integrator"):
        Servo("pendulum", 4.0, TARGET)  # type: ignore[arg-type]


def test_a_target_is_sampled_twice_a_period_at_least() -> None:
    servo = Servo("integrator", 4.0, TARGET)
    servo.require_seen(2_000)
    with pytest.raises(ProblemError, match=r"servo\.target\.period_s.*two frames of the camera"):
        servo.require_seen(2_001)
