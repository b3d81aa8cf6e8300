"""The reference visual-servo loop: a plant that follows a moving target, exactly between events.

The plant has one axis: an integrator x' = u, or a double integrator x'' = u. The target moves as
r(t) = A sin(w t). At the release of a cycle the camera sees the error e = r - x (and, for the
double integrator, its rate), and the control law makes a command of it:

    u = K e                for the integrator: eq. 4 of Chaumette and Hutchinson 2006, DOI
                           10.1109/MRA.2006.250573, on one axis
    u = K e + B e'         for the double integrator

The command takes effect at the cycle's actuation and is held until that of the next one (zero-order
hold). Between two actuations x is therefore a polynomial in t, and nothing is integrated step by
step. The two integrals of the error, of e^2 and of |e|, are taken over pieces of a hold that are so
short (w h <= 0.2) that a Taylor polynomial of degree 4 about their middle stands for the target: it
is off by less than A (w h / 2)^5 / 120 < 1e-7 A. e^2 is integrated in closed form; |e| too, between
the zeros of e, which are found where the error changes its sign or turns inside the piece.

Work and results belong to the caller; times are seconds from the start of the run. `servo_loop.cpp`
has the loop.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.library import library

# Status.
DONE, DIVERGED = 0, 1
# Columns of a state: since when, and position, velocity and acceleration then.
SINCE, POSITION, VELOCITY, ACCELERATION = 0, 1, 2, 3
N_STATE = 4


def follow(
    measured_s: NDArray[np.float64],
    actuated_s: NDArray[np.float64],
    begin_s: float,
    end_s: float,
    double: bool,
    gain: float,
    damping: float,
    amplitude: float,
    omega: float,
    states: NDArray[np.float64],
    integrals: NDArray[np.float64],
) -> int:
    """Play the loop from rest at 0 and integrate its error.

    Parameters
    ----------
    measured_s, actuated_s : float64 array, shape (n,)
        Instants at which the error of each command was seen, and at which it took effect; both
        ascending, none seen after it took effect.
    begin_s, end_s : float
        What the integrals are taken over.
    double : bool
        Whether the plant is the double integrator.
    gain : float
        K, 1/s; 1/s^2 for the double integrator.
    damping : float
        B, 1/s; not used for the integrator.
    amplitude, omega : float
        A, and w in rad/s, above 0.
    states : float64 array, shape (n + 1, N_STATE)
        Work: the state at the begin of every hold; the first holds 0.
    integrals : float64 array, shape (2,)
        Out: of e^2 and of |e|, in units of A squared times s, and of A times s.

    Returns
    -------
    int
        DONE, or DIVERGED where the position went beyond 10^6 amplitudes; the integrals are then
        not complete.
    """
    n = len(actuated_s)
    shapes = len(measured_s), states.shape, integrals.shape
    if shapes != (n, (n + 1, N_STATE), (2,)):
        raise ValueError(f"measured_s, states and integrals do not fit {n} actuations: {shapes}")
    status: int = _dwell_follow()(
        measured_s,
        actuated_s,
        n,
        begin_s,
        end_s,
        double,
        gain,
        damping,
        amplitude,
        omega,
        states,
        integrals,
    )
    return status


@cache
def _dwell_follow() -> Any:
    """Return the library's function; it refuses arrays of another type, or not in one piece."""
    instants = np.ctypeslib.ndpointer(np.float64, ndim=1, flags="C_CONTIGUOUS")
    written = np.ctypeslib.ndpointer(np.float64, flags=("C_CONTIGUOUS", "WRITEABLE"))
    function = library().dwell_follow
    function.restype = ctypes.c_int64
    function.argtypes = [
        *(instants, instants, ctypes.c_int64),
        *(ctypes.c_double, ctypes.c_double),
        *(ctypes.c_int64, ctypes.c_double, ctypes.c_double),
        *(ctypes.c_double, ctypes.c_double),
        *(written, written),
    ]
    return function
