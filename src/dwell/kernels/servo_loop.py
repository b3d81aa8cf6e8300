"""The reference visual-servo loop: a plant that follows a moving target, with exact solutions.

The plant has one axis: an integrator x' = u, or a double integrator x'' = u. The target moves as
r(t) = A sin(w t). At the release of a cycle the camera measures the error e = r - x (and, for the
double integrator, its rate), from which the control law computes a command:

    u = K e                for the integrator: eq. 4 of Chaumette and Hutchinson 2006, DOI
                           10.1109/MRA.2006.250573, on one axis
    u = K e + B e'         for the double integrator

The command takes effect at the cycle's actuation and is held until the next actuation (zero-order
hold). Between two actuations x is a polynomial in t, known in closed form. The integrals of e^2 and
|e| are sums over short pieces of a hold (w h <= 0.2). In each piece a Taylor polynomial of degree 4
about the midpoint replaces the target; its error is less than A (w h / 2)^5 / 120 < 1e-7 A. Both
integrals are in closed form; |e| is integrated between the zeros of e, which the loop searches if
the error changes its sign or has an extremum inside the piece.

Times are seconds from the start of the run. `servo_loop.cpp` has the loop.
"""

from __future__ import annotations

from ctypes import c_double, c_int64

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.rows import FLOAT_ROWS_OUT, FLOATS_IN, FLOATS_OUT
from dwell.model import Servo
from dwell.model.number_arrays import Floats

# Status.
DONE, DIVERGED = 0, 1
# Columns of a state: its instant, and position, velocity and acceleration at that instant.
SINCE, POSITION, VELOCITY, ACCELERATION = 0, 1, 2, 3
N_STATE = 4


def follow(
    servo: Servo, measured_s: Floats, actuated_s: Floats, begin_s: float, end_s: float
) -> tuple[int, Floats, Floats]:
    """Simulate the loop from rest at 0 and integrate its error.

    Parameters
    ----------
    servo : Servo
        Plant, control law and target.
    measured_s, actuated_s : float64 array, shape (n,)
        Instants of measurement and actuation of each command; actuations ascend, and none is
        before its measurement.
    begin_s, end_s : float
        Limits of the integrals.

    Returns
    -------
    status : int
        DONE, or DIVERGED if the position exceeded 10^6 amplitudes; the integrals are then
        incomplete.
    integrals : float64 array, shape (2,)
        Integrals of e^2 and |e|, in amplitude squared times s, and in amplitude times s.
    states : float64 array, shape (n + 1, N_STATE)
        The state at the start of every hold; the first is 0.
    """
    n, target = len(actuated_s), servo.target
    if len(measured_s) != n:
        raise ValueError(f"{len(measured_s)} instants of measurement do not fit {n} actuations")
    states, integrals = np.zeros((n + 1, N_STATE)), np.empty(2)
    plant = servo.plant == "double-integrator", servo.gain, servo.damping
    swing = target.amplitude_mm, target.omega
    status: int = _follow()(
        measured_s, actuated_s, n, begin_s, end_s, *plant, *swing, states, integrals
    )
    return status, integrals, states


_follow = foreign(
    *("dwell_follow", c_int64, FLOATS_IN, FLOATS_IN, c_int64, c_double, c_double),
    *(c_int64, c_double, c_double, c_double, c_double, FLOAT_ROWS_OUT, FLOATS_OUT),
)
