"""Errors from few samples: the same bits as loops in Python and sums of NumPy."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import numpy as np
import pytest

from dwell.kernels.pools import HeldValues
from dwell.kernels.sampling_errors import PAIRS, Steps, tail_error_ms
from dwell.model.number_arrays import Floats


def moments(values: Sequence[float]) -> tuple[float, float, float]:
    total = squares = products = 0.0
    for value in values:
        total += value - values[0]
    mean = values[0] + total / len(values)
    for i, value in enumerate(values):
        squares += (value - mean) * (value - mean)
        products += (values[i - 1] - mean) * (value - mean) if i else 0.0
    return mean, squares, products


def percentile_error(ordered: Floats, off: float) -> float:
    last = len(ordered) - 1
    usual = ordered.item(round(0.95 * last))
    low = ordered.item(max(round((0.95 - 2 * off) * last), 0))
    high = ordered.item(min(round((0.95 + 2 * off) * last), last))
    return float(max(high - usual, usual - low) / 2)


@pytest.mark.parametrize("resources", [0, 1, 5])
@pytest.mark.parametrize("count", [1, 2, 3, 24])
def test_sums_of_steps_add_one_after_another(count: int, resources: int) -> None:
    steps = np.random.default_rng(count).gamma(3.0, size=(count, PAIRS + resources))
    steps[::2, 1] = steps[::2, 0]
    table = Steps(24, PAIRS + resources)
    for step in (*np.ones_like(steps), *steps):
        table.add(step)
    table.keep(count)
    *pairs, sums = table.sums()
    np.testing.assert_array_equal(table.table, steps)
    assert len(table) == count
    for column, found in zip((0, 2), pairs, strict=True):
        shown, declared = steps[:, column].tolist(), steps[:, column + 1].tolist()
        more = [one - other for one, other in zip(shown, declared, strict=True)]
        apart = 0.0
        for one in more:
            apart += abs(one)
        assert found == (*moments(shown), *moments(more), apart)
    expected = [0.0] * resources
    for row in steps.tolist():
        expected = [one + other for one, other in zip(expected, row[PAIRS:], strict=True)]
    assert sums == expected


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 12, 129, 200, 2400])
def test_held_values_have_the_larger_of_two_errors(count: int) -> None:
    rng, held = np.random.default_rng(count), HeldValues(np.arange(3.0), math.inf, 0.0, 1)
    for share, measured in ((0.0, 0), (0.3, count), (0.9, 1), (0.05, count // 2)):
        values = np.where(rng.random(count) < share, np.inf, rng.lognormal(3.0, 1.0, count))
        known, independent = np.sort(values[np.isfinite(values)]), max(measured, 2)
        held.begin(values, (0.0, 0.0, 0.0), 1)
        held.row.measured = measured
        lost, error_ms = copy.deepcopy(held).error()
        assert (lost, error_ms) == held.error()
        assert lost == (count - len(known)) / max(count, 1)
        if len(known) < 2:
            assert error_ms == 0.0
            continue
        few = (independent + 1) / (independent - 1)
        off = math.sqrt(0.05 * (1.0 - 0.05) / independent)
        of_mean = few * float(known.std()) / math.sqrt(independent)
        assert error_ms == max(of_mean, percentile_error(known, off))


@pytest.mark.parametrize("count", [1, 2, 30, 2400])
@pytest.mark.parametrize("off", [0.0, 0.003, 0.04, 0.6])
def test_the_error_of_a_tail_is_of_its_limits(count: int, off: float) -> None:
    rng = np.random.default_rng(count)
    latency_ns = rng.integers(1, 60_000_000, count)
    latency_ns[rng.random(count) < 0.1] = 2**62
    ordered = np.sort(np.minimum(latency_ns / 1e6, 400.0))
    assert tail_error_ms(latency_ns, 400.0, off) == percentile_error(ordered, off)
