"""Paths of random processes: NumPy's numbers, in any pieces, as they are or in nanoseconds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.kernels.drawn_path import Path, ReplayedPath, path_of
from dwell.model import AR1, Constant, Exponential, Gamma, LogNormal, Normal, Process, Uniform
from dwell.model.instants import HORIZON_NS

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

PROCESSES: tuple[Process, ...] = (
    Constant(2.5),
    Uniform(1, 4),
    Normal(2, 1.5, 0.5),
    LogNormal(3, 0.4),
    Gamma(3, 0.4),
    Exponential(3),
    AR1(3, 0.4, 0.8),
)
INDEPENDENT = [process for process in PROCESSES if not isinstance(process, AR1)]


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


def drawn_ns(path: Path, count: int, factors: Floats | None = None) -> Ints:
    out = np.empty(count, np.int64)
    path.fill_ns(out, factors)
    return out


def name(process: Process) -> str:
    return type(process).__name__


@pytest.mark.parametrize("process", INDEPENDENT, ids=name)
def test_values_are_those_that_numpy_draws(process: Process) -> None:
    """To the last bit, but for exponentials, which NumPy chooses by processor."""
    found, expected = path_of(process, rng()).values(10_000), process.marginal(rng(), 10_000)
    np.testing.assert_array_max_ulp(found, expected, maxulp=isinstance(process, LogNormal))


def test_an_autoregression_remembers_the_cycle_before() -> None:
    process = AR1(3, 0.4, 0.8)
    noise, correlation = rng().standard_normal(5_000), process.log_correlation
    normals = [noise[0]]
    for e in noise[1:]:
        normals.append(correlation * normals[-1] + math.sqrt(1 - correlation**2) * e)
    mu, sigma = LogNormal(3, 0.4).log_parameters
    values = path_of(process, rng()).values(5_000)
    np.testing.assert_allclose(values, np.exp(sigma * np.array(normals) + mu), rtol=1e-12)


def test_independent_values_have_no_memory() -> None:
    process = AR1(3, 0.4, 0.8)
    values = path_of(process, rng(), independent=True).values(1_000)
    np.testing.assert_array_max_ulp(values, process.marginal(rng(), 1_000), maxulp=1)


@pytest.mark.parametrize("process", PROCESSES, ids=name)
@given(counts=st.lists(st.integers(0, 1_100), max_size=6))
def test_pieces_of_a_path_are_the_path(process: Process, counts: list[int]) -> None:
    whole = path_of(process, rng()).values(sum(counts))
    path = path_of(process, rng())
    pieces = [np.empty(0), *(path.values(count) for count in counts)]
    np.testing.assert_array_equal(np.concatenate(pieces), whole)


@pytest.mark.parametrize("process", PROCESSES, ids=name)
def test_durations_are_whole_nanoseconds(process: Process) -> None:
    factors = np.linspace(0, 3, 3_000)
    values = path_of(process, rng()).values(3_000)
    found = drawn_ns(path_of(process, rng()), 3_000)
    np.testing.assert_array_equal(found, np.rint(values * 1e6).astype(np.int64))
    found = drawn_ns(path_of(process, rng()), 3_000, factors)
    np.testing.assert_array_equal(found, np.rint(values * factors * 1e6).astype(np.int64))


@pytest.mark.parametrize(
    ("ms", "ns"),
    [
        (0.0, 0),
        (1.0000004, 1_000_000),
        (1.5e-6, 2),
        (2.5e-6, 2),
        (2.0**51 / 1e6, 2**51),
        ((2.0**51 + 0.5) / 1e6, 2**51),
        ((2.0**51 + 1.5) / 1e6, 2**51 + 2),
        (5e12, 5 * 10**18),
        (1e30, HORIZON_NS),
        (math.inf, HORIZON_NS),
    ],
)
def test_durations_are_rounded_half_to_even_up_to_the_horizon(ms: float, ns: int) -> None:
    """However large the others are that are rounded beside them."""
    recorded = np.array([1.0, ms])
    assert drawn_ns(ReplayedPath(recorded, np.array([0, 1, 0])), 3).tolist() == [10**6, ns, 10**6]


@pytest.mark.parametrize("mean", [5e-324, 1e-290, 1e-250])
def test_next_to_nothing_is_nothing(mean: float) -> None:
    assert not drawn_ns(path_of(LogNormal(mean, 100), rng()), 10_000, np.full(10_000, 1e9)).any()


def test_a_trace_is_replayed_in_the_order_of_its_rows() -> None:
    path = ReplayedPath(np.array([1.0, 2.0, 3.0]), np.array([1, 2, 2, 0, 1]))
    assert path.values(2).tolist() == [2, 3]
    assert drawn_ns(path, 3).tolist() == [3_000_000, 1_000_000, 2_000_000]


def test_a_process_of_a_users_own_draws_its_own_values() -> None:
    @dataclass(frozen=True)
    class Dice:
        expectation: float = 3.5

        def marginal(self, rng: np.random.Generator, size: int) -> Floats:
            return rng.integers(1, 7, size)  # type: ignore[return-value]

    assert set(drawn_ns(path_of(Dice(), rng()), 1_000)) == {n * 10**6 for n in range(1, 7)}
