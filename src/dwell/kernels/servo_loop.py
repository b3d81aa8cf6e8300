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

Work and results belong to the caller; times are seconds from the start of the run.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.compiled import kernel, phase

# Status.
DONE, DIVERGED = 0, 1
# Columns of a state: since when, and position, velocity and acceleration then.
SINCE, POSITION, VELOCITY, ACCELERATION = 0, 1, 2, 3
N_STATE = 4

# Halvings of the bracket of a zero before the secant: |e| is off by the square of what is left.
HALVINGS = 8
# Half of w h of the longest piece, and the error at which the loop counts as unstable, in A.
HALF_PIECE = 0.1
FAR = 1e6

THIRD, FIFTH, SEVENTH, NINTH = 1 / 3, 1 / 5, 1 / 7, 1 / 9


@phase
def _zero(c0: float, c1: float, c2: float, c3: float, c4: float, low: float, high: float) -> float:
    """Return the zero of a polynomial between two points where it has different signs."""
    at_low = c0 + low * (c1 + low * (c2 + low * (c3 + low * c4)))
    at_high = c0 + high * (c1 + high * (c2 + high * (c3 + high * c4)))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        at_middle = c0 + middle * (c1 + middle * (c2 + middle * (c3 + middle * c4)))
        if (at_middle > 0.0) == (at_high > 0.0):
            high = middle
            at_high = at_middle
        else:
            low = middle
            at_low = at_middle
    return (low * at_high - high * at_low) / (at_high - at_low)


@phase
def _area(c0: float, c1: float, c2: float, c3: float, c4: float, to: float) -> float:
    """Return the integral of a polynomial from 0."""
    return to * (c0 + to * (0.5 * c1 + to * (THIRD * c2 + to * (0.25 * c3 + to * FIFTH * c4))))


@phase
def _absolute(c0: float, c1: float, c2: float, c3: float, c4: float) -> float:
    """Return the integral of |e| from -1 to 1, e a polynomial that turns once at most."""
    even, odd = c0 + c2 + c4, c1 + c3
    slope_even, slope_odd = c1 + 3 * c3, 2 * c2 + 4 * c4
    turns = slope_even * slope_even < slope_odd * slope_odd
    if even * even >= odd * odd and not turns:
        return abs(2.0 * (c0 + THIRD * c2 + FIFTH * c4))
    stop = _zero(c1, 2 * c2, 3 * c3, 4 * c4, 0.0, -1.0, 1.0) if turns else 1.0
    start, at_start = -1.0, even - odd
    before = _area(c0, c1, c2, c3, c4, -1.0)
    total = 0.0
    for _ in range(2):
        at_stop = c0 + stop * (c1 + stop * (c2 + stop * (c3 + stop * c4)))
        if (at_start > 0.0) != (at_stop > 0.0):
            area = _area(c0, c1, c2, c3, c4, _zero(c0, c1, c2, c3, c4, start, stop))
            total += abs(area - before)
            before = area
        area = _area(c0, c1, c2, c3, c4, stop)
        total += abs(area - before)
        before = area
        start, at_start, stop = stop, at_stop, 1.0
    return total


@phase
def _add(
    begin: float,
    end: float,
    since: float,
    position: float,
    velocity: float,
    acceleration: float,
    amplitude: float,
    omega: float,
    integrals: NDArray[np.float64],
) -> None:
    """Add the integrals of e^2 and |e| from begin to end, a part of one hold."""
    pieces = 1
    half = 0.5 * (end - begin)
    if half * omega > HALF_PIECE:
        pieces = math.ceil(half * omega / HALF_PIECE)
        half /= pieces
    q = omega * half
    for i in range(pieces):
        middle = begin + (2 * i + 1) * half
        held = middle - since
        sine = amplitude * math.sin(omega * middle)
        cosine = q * amplitude * math.cos(omega * middle)
        # Coefficients of e over [-1, 1], half a piece being the unit of time.
        c0 = sine - (position + held * (velocity + 0.5 * acceleration * held))
        c1 = cosine - half * (velocity + acceleration * held)
        c2 = -0.5 * (q * q * sine + acceleration * half * half)
        c3 = -q * q * cosine / 6.0
        c4 = q * q * q * q * sine / 24.0
        integrals[0] += (2.0 * half) * (
            c0 * c0
            + THIRD * (c1 * c1 + 2.0 * c0 * c2)
            + FIFTH * (c2 * c2 + 2.0 * (c0 * c4 + c1 * c3))
            + SEVENTH * (c3 * c3 + 2.0 * c2 * c4)
            + NINTH * c4 * c4
        )
        integrals[1] += half * _absolute(c0, c1, c2, c3, c4)


@kernel
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
        DONE, or DIVERGED where the position went beyond `FAR` amplitudes; the integrals are then
        not complete.
    """
    n = actuated_s.size
    integrals[:] = 0.0
    states[0, :] = 0.0
    seen = 0
    for k in range(n + 1):
        since, position = states[k, SINCE], states[k, POSITION]
        velocity, acceleration = states[k, VELOCITY], states[k, ACCELERATION]
        until = actuated_s[k] if k < n else end_s
        begin, end = max(since, begin_s), min(until, end_s)
        if begin < end:
            _add(begin, end, since, position, velocity, acceleration, amplitude, omega, integrals)
        if k == n or until >= end_s:
            break
        held = until - since
        position += held * (velocity + 0.5 * acceleration * held)
        if not abs(position) < FAR * amplitude:
            return DIVERGED
        velocity += acceleration * held
        # What the camera saw, at an instant that may lie several holds back.
        at = measured_s[k]
        while seen < k and actuated_s[seen] <= at:
            seen += 1
        held = at - states[seen, SINCE]
        rate, push = states[seen, VELOCITY], states[seen, ACCELERATION]
        error = amplitude * math.sin(omega * at)
        error -= states[seen, POSITION] + held * (rate + 0.5 * push * held)
        if double:
            slope = amplitude * omega * math.cos(omega * at) - (rate + push * held)
            acceleration = gain * error + damping * slope
        else:
            velocity = gain * error
        states[k + 1, SINCE], states[k + 1, POSITION] = until, position
        states[k + 1, VELOCITY], states[k + 1, ACCELERATION] = velocity, acceleration
    return DONE
