"""The servo loop against scipy: exact discretisation, quadrature, frequency response."""

from __future__ import annotations

import cmath
import ctypes
import itertools
import math
from typing import Any, TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, signal

from dwell.kernels.servo_loop import DIVERGED, DONE, follow
from dwell.model import MovingTarget, Servo
from dwell.model.servo import Plant

# NumPy's own types for what arithmetic makes of float64.
Floats: TypeAlias = NDArray[np.floating[Any]]

AMPLITUDE, SWING_S = 0.04, 1.6
OMEGA = 2 * math.pi / SWING_S
PERIOD = 0.03
INTEGRATOR: dict[str, Any] = {"double": False, "gain": 4.0, "damping": 0.0}
DOUBLE: dict[str, Any] = {"double": True, "gain": 30.0, "damping": 8.0}
SERVO = Servo("integrator", 4.0, MovingTarget(AMPLITUDE, SWING_S))
PLANTS = pytest.mark.parametrize("law", [INTEGRATOR, DOUBLE], ids=["integrator", "double"])


def played(
    measured: Floats, actuated: Floats, begin: float, end: float, law: dict[str, Any]
) -> tuple[int, float, float]:
    """Return the status and the integrals of e^2 and |e|."""
    plant: Plant = "double-integrator" if law["double"] else "integrator"
    servo = Servo(plant, law["gain"], MovingTarget(AMPLITUDE, SWING_S), law["damping"])
    seen, acted = np.asarray(measured, np.float64), np.asarray(actuated, np.float64)
    status, integrals, _ = follow(servo, seen, acted, begin, end)
    return status, float(integrals[0]), float(integrals[1])


def target(t: Floats) -> Floats:
    moved: Floats = AMPLITUDE * np.sin(OMEGA * t)
    return moved


# ------------------------------------------------------- a constant delay, by scipy.signal


def errors_on_a_grid(steps: int, late: int, cycles: int, law: dict[str, Any]) -> Floats:
    """Return e at every step of a loop whose period is `steps` and whose delay is `late` of them.

    The plant is discretised exactly (zero-order hold); the delay is a shift of its input.
    """
    step = PERIOD / steps
    if law["double"]:
        plant = signal.StateSpace([[0, 1], [0, 0]], [[0], [1]], np.eye(2), np.zeros((2, 1)))
    else:
        plant = signal.StateSpace([[0]], [[1]], [[1]], [[0]])
    discrete = plant.to_discrete(step)
    count = steps * cycles
    times = np.arange(count + 1) * step
    inputs = np.zeros(count + late + steps + 1)
    state, seen = np.zeros((len(discrete.A), 1)), np.empty(count + 1)
    for i in range(count + 1):
        seen[i] = state[0, 0]
        if i % steps == 0:
            command = law["gain"] * (target(times[i : i + 1])[0] - state[0, 0])
            if law["double"]:
                rate = AMPLITUDE * OMEGA * math.cos(OMEGA * times[i])
                command += law["damping"] * (rate - state[1, 0])
            inputs[i + late : i + late + steps] = command
        state = discrete.A @ state + discrete.B * inputs[i]
    return target(times) - seen


@PLANTS
@pytest.mark.parametrize("late", [0, 80, 100, 250])
def test_a_constant_delay_is_that_of_an_exact_discretisation(
    late: int, law: dict[str, Any]
) -> None:
    """For delays of nothing, of 0.8, 1 and 2.5 periods."""
    steps, cycles, begin = 100, 120, 20
    error = errors_on_a_grid(steps, late, cycles, law)[begin * steps :]
    step = PERIOD / steps
    released = np.arange(cycles) * PERIOD
    status, squared, absolute = played(
        released, released + late * step, begin * PERIOD, cycles * PERIOD, law
    )
    assert status == DONE
    assert squared == pytest.approx(integrate.simpson(error**2, dx=step), rel=1e-6)
    assert absolute == pytest.approx(integrate.trapezoid(abs(error), dx=step), rel=1e-5)


@PLANTS
@pytest.mark.parametrize("late", [0.0, 0.0405, 0.1])
def test_fast_sampling_tends_to_the_frequency_response_of_the_delayed_loop(
    late: float, law: dict[str, Any]
) -> None:
    """E / R = 1 / (1 + C P exp(-s T)), with half a period of the hold in T."""
    period, swings = 0.001, 10
    released = np.arange(int(2 * swings * 1.6 / period)) * period
    begin, end = swings * 1.6, 2 * swings * 1.6
    _, squared, absolute = played(released, released + late, begin, end, law)
    law_of_s = [law["damping"], law["gain"]] if law["double"] else [law["gain"]]
    _, (opened,) = signal.freqs(law_of_s, [1, 0, 0] if law["double"] else [1, 0], [OMEGA])
    delayed = opened * cmath.exp(-1j * OMEGA * (late + period / 2))
    amplitude = AMPLITUDE * abs(1 / (1 + delayed))
    assert math.sqrt(squared / (end - begin)) == pytest.approx(amplitude / math.sqrt(2), rel=1e-3)
    assert absolute / (end - begin) == pytest.approx(2 / math.pi * amplitude, rel=1e-3)


@pytest.mark.parametrize(("gain", "status"), [(0.98, DONE), (1.02, DIVERGED)])
def test_the_stability_limit_of_a_delay_of_one_period(gain: float, status: int) -> None:
    """z^2 - z + K P has its zeros inside the unit circle for K P < 1 (Jury's criterion)."""
    inside = np.abs(np.roots([1, -1, gain])).max() < 1
    assert inside == (status == DONE)
    released = np.arange(3000) * PERIOD
    law = {**INTEGRATOR, "gain": gain / PERIOD}
    found, *integrals = played(released, released + PERIOD, 0.0, 3000 * PERIOD, law)
    assert found == status
    if status == DONE:
        assert all(math.isfinite(value) for value in integrals)


# ------------------------------------------------------- any instants, by quadrature


def by_quadrature(
    measured: Floats, actuated: Floats, begin: float, end: float, law: dict[str, Any]
) -> tuple[float, float]:
    """Integrate what closures over the past say the error is."""
    holds: list[tuple[float, float, float, float]] = [(-math.inf, 0.0, 0.0, 0.0)]

    def state(t: float) -> tuple[float, float]:
        since, x, v, a = next(hold for hold in reversed(holds) if hold[0] <= t)
        s = t - since if since > -math.inf else 0.0
        return x + v * s + a * s * s / 2, v + a * s

    for seen, at in zip(measured, actuated, strict=True):
        x, v = state(seen)
        error = AMPLITUDE * math.sin(OMEGA * seen) - x
        rate = AMPLITUDE * OMEGA * math.cos(OMEGA * seen) - v
        command = law["gain"] * error + law["damping"] * rate
        x, v = state(at)
        holds.append((at, x, v, command) if law["double"] else (at, x, command, 0.0))

    def error_at(t: float) -> float:
        return AMPLITUDE * math.sin(OMEGA * t) - state(t)[0]

    cuts = [begin, *(at for at in actuated if begin < at < end), end]
    squared = absolute = 0.0
    for low, high in itertools.pairwise(cuts):
        squared += integrate.quad(lambda t: error_at(t) ** 2, low, high, epsabs=1e-13)[0]
        grid = np.linspace(low, high, 60)
        values = [error_at(t) for t in grid]
        changes = [
            (a, b)
            for a, b, p, q in zip(grid[:-1], grid[1:], values[:-1], values[1:], strict=True)
            if p * q < 0
        ]
        ends = [low, *(_root(error_at, *pair) for pair in changes), high]
        for a, b in itertools.pairwise(ends):
            absolute += abs(integrate.quad(error_at, a, b, epsabs=1e-13)[0])
    return squared, absolute


def _root(function: Any, low: float, high: float) -> float:
    from scipy.optimize import brentq

    return float(brentq(function, low, high, xtol=1e-14))


@given(
    gaps=st.lists(st.floats(1e-4, 0.4), min_size=1, max_size=12),
    lates=st.lists(st.floats(0, 0.3), min_size=12, max_size=12),
    counted=st.tuples(st.floats(0, 0.3), st.floats(0.5, 2.0)),
    double=st.booleans(),
)
def test_any_instants_give_what_quadrature_does(
    gaps: list[float], lates: list[float], counted: tuple[float, float], double: bool
) -> None:
    """Long holds too: the target passes, and the error turns and changes its sign inside."""
    law = DOUBLE if double else INTEGRATOR
    actuated = np.cumsum(gaps)
    measured = np.maximum.accumulate(np.maximum(actuated - lates[: len(gaps)], 0.0))
    status, squared, absolute = played(measured, actuated, *counted, law)
    expected = by_quadrature(measured, actuated, *counted, law)
    assert status == DONE
    # The bound of the module is 1e-7 amplitudes in the error.
    scale = AMPLITUDE * counted[1]
    assert squared == pytest.approx(expected[0], rel=1e-6, abs=1e-7 * AMPLITUDE * scale)
    assert absolute == pytest.approx(expected[1], rel=1e-6, abs=1e-7 * scale)


def test_an_error_that_is_zero_twice_within_a_piece() -> None:
    """The integrator moves along a chord of the target's path."""
    first = (2 * math.pi + 1) / OMEGA
    second = first + 0.02
    begin, end = first - 0.004, second + 0.005
    assert OMEGA * (end - begin) < 0.2, "one piece"
    (low, high) = target(np.array([first, second]))
    speed = (high - low) / (second - first)
    seen = 1 / OMEGA
    law = {**INTEGRATOR, "gain": speed / (AMPLITUDE * math.sin(OMEGA * seen))}
    instants = np.array([seen]), np.array([first - low / speed]), begin, end
    _, squared, absolute = played(*instants, law)
    expected = by_quadrature(*instants, law)
    assert squared == pytest.approx(expected[0], rel=1e-4)
    assert absolute == pytest.approx(expected[1], rel=1e-4)


# ------------------------------------------------------- what is and is not in effect


@PLANTS
def test_a_command_is_held_until_the_next(law: dict[str, Any]) -> None:
    """The loop without its later cycles is the loop whose later cycles never come."""
    released = np.arange(40) * PERIOD
    kept = np.delete(np.arange(40), [20, 21, 22])
    late = released + 0.02
    end = released[20] + 0.02
    some = played(released[kept], late[kept], 0.1, end, law)
    assert some == played(released[:20], late[:20], 0.1, end, law)
    longer = played(released[kept], late[kept], 0.1, released[23] + 0.02, law)
    assert longer == played(released[:20], late[:20], 0.1, released[23] + 0.02, law)
    assert longer != played(released, late, 0.1, released[23] + 0.02, law)


@PLANTS
def test_without_a_command_the_plant_rests(law: dict[str, Any]) -> None:
    none = np.empty(0)
    status, squared, absolute = played(none, none, 0.0, 1.6, law)
    assert status == DONE
    assert squared == pytest.approx(AMPLITUDE**2 / 2 * 1.6)
    assert absolute == pytest.approx(2 / math.pi * AMPLITUDE * 1.6)


@PLANTS
def test_what_takes_effect_after_the_end_does_not_count(law: dict[str, Any]) -> None:
    released = np.arange(60) * PERIOD
    end = released[30] + 0.01
    assert played(released, released + 0.02, 0.0, end, law) == played(
        released[:30], released[:30] + 0.02, 0.0, end, law
    )


@PLANTS
def test_parts_of_a_stretch_add_up(law: dict[str, Any]) -> None:
    released = np.arange(60) * PERIOD
    cuts = [0.0, 0.4, 1.234, 1.8]
    whole = played(released, released + 0.04, cuts[0], cuts[-1], law)
    parts = [
        played(released, released + 0.04, low, high, law) for low, high in itertools.pairwise(cuts)
    ]
    assert whole[1:] == pytest.approx(np.sum(parts, axis=0)[1:])


# ------------------------------------------------------- arguments


@pytest.mark.parametrize("measured", [np.zeros(2), np.zeros(4)])
def test_instants_that_do_not_fit_are_refused(measured: Any) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        follow(SERVO, measured, np.zeros(3), 0.0, 1.0)


@pytest.mark.parametrize(
    "measured", [np.zeros(3, np.float32), np.zeros(3, np.int64), np.zeros(6)[::2]]
)
def test_arrays_of_another_type_or_in_pieces_are_refused(measured: Any) -> None:
    with pytest.raises(ctypes.ArgumentError):
        follow(SERVO, measured, np.zeros(3), 0.0, 1.0)
