"""What the kernel holds of parts is what a plain list of windows holds."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from dwell.estimators.pool import ENOUGH, LARGEST, PlaceSums, Pool, Reference, least_deviations
from dwell.kernels.meter import CyclesLayout, PartTimes, WindowRows
from dwell.kernels.pools import ADDED, GROWN, HeldValues, PoolRows, TimesRow, fill

Floats = NDArray[np.float64]
PARTS, BLOCK = 5, 10
#: How often a part is compared in a window.
TESTS = 5.0


class Plain:
    """Values of the newest windows, and the sums of their places."""

    def __init__(self) -> None:
        self.windows: deque[tuple[int, Floats, PlaceSums, int]] = deque()

    def add(self, values: Floats, sums: PlaceSums, window: int, memory: float, cycles: int) -> None:
        """Add values, and drop the oldest: what is forgotten, and what is beyond `LARGEST`."""
        self.windows.append((window, values.copy(), sums, cycles))
        while len(self.values) > LARGEST or (
            self.windows[0][0] <= window - memory
            and len(self.values) - len(self.windows[0][1]) >= ENOUGH
        ):
            self.windows.popleft()

    @property
    def values(self) -> Floats:
        return np.concatenate([values for _, values, _, _ in self.windows])

    @property
    def cycles(self) -> int:
        return sum(cycles for *_, cycles in self.windows)


@pytest.mark.parametrize("seed", range(20))
def test_the_newest_values_are_held(seed: int) -> None:
    rng = np.random.default_rng(seed)
    known = np.sort(rng.lognormal(size=50))
    held, plain = HeldValues(known, np.inf, 0.1, BLOCK), Plain()
    held.begin(np.empty(0), (0.0, 0.0, 0.0), 0)
    for window in range(1, 80):
        values = rng.lognormal(size=int(rng.integers(1, rng.choice([3, LARGEST + 1]))))
        sums, memory = PlaceSums.among(values, known), float(rng.choice([0.5, 3.0, np.inf]))
        held.add(values, sums.sums, window, memory, len(values) + 3)
        plain.add(values, sums, window, memory, len(values) + 3)
        if seed % 2:
            held = copy.deepcopy(held)
        np.testing.assert_array_equal(held.values, plain.values)
        assert held.row.cycles == plain.cycles
        assert held.row.places == pytest.approx(sum(one.places for _, _, one, _ in plain.windows))


def of_parts(values: Sequence[Floats]) -> PartTimes:
    """Return a window that shows some values of each part, as the times of a task's jobs."""
    found = PartTimes(len(values))
    count = max(map(len, values))
    end = np.full((count, len(values)), -1)
    for column, one in enumerate(values):
        end[: len(one), column] = np.rint(one * 1e6)
    begin = np.where(end >= 0, 0, -1)
    none = begin[:, :0]
    nothing = np.zeros((2, 0), np.bool_)
    layout = CyclesLayout(np.zeros(0, np.int64), np.array([range(len(values))] * 2), nothing)
    found.begin(WindowRows.of((begin[:, 0] * 0, begin, end, none, begin, begin)), 0)
    found.add(0, layout)
    return found


@pytest.mark.parametrize("seed", range(30))
def test_a_window_of_all_parts_leaves_pools_as_each_by_itself_does(seed: int) -> None:
    rng, by_some = np.random.default_rng(seed), seed % 3 == 0
    scale = rng.choice([1.0, 1.0, 4.0], PARTS)

    def shown() -> list[Floats]:
        sizes = rng.integers(0, 60, PARTS)
        return [
            np.round(rng.gamma(9.0, size=n) * by, 6) for n, by in zip(sizes, scale, strict=True)
        ]

    references = [
        Reference(np.round(rng.gamma(9.0, size=400), 6), BLOCK, patience_ms=patience)
        for patience in (np.inf, 15.0, np.inf, 12.0, np.inf)
    ]
    alone, together = ([Pool(one, additive=False) for one in references] for _ in range(2))
    least, grown = least_deviations(TESTS), 0
    # Of few cycles, windows in succession are one run.
    cycles = 60 if seed % 2 else 4
    rows = PoolRows([pool.rows for pool in together], np.array([[0, 1, -1], [2, 3, 4]]))
    for window in range(1, 25):
        if window % 8 == 0:
            scale = rng.choice([1.0, 1.0, 4.0], PARTS)
            alone, together, rows = copy.deepcopy((alone, together, rows))
        found = of_parts(shown())
        times = found.by_part()
        looks: dict[int, int] = {}
        for some in (
            (np.array(found.numbers[:2]), np.array(found.numbers[2:])) if by_some else (None,)
        ):
            looks |= dict(rows.learn(found, window, 6.0, cycles, least, some))
        assert looks.keys() <= times.keys()
        for part in times:
            why = looks.get(part, 0)
            has_changed = alone[part].learn(times[part], window, 6.0, cycles, TESTS)
            grown += why == GROWN
            if why == GROWN:
                assert not has_changed
                assert not together[part].is_declared
            elif why == ADDED:
                assert together[part].has_left(window, cycles, least) == has_changed
            elif why:
                assert together[part].learn(times[part], window, 6.0, cycles, TESTS) == has_changed
            else:
                assert not has_changed
        for one, other in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one.held, other.held)
            assert (one.is_declared, one.last, one.measured, one.touched) == (
                *(other.is_declared, other.last, other.measured, other.touched),
            )
            assert (one.usual, one.lost, one.error_ms) == (
                *(other.usual, other.lost, other.error_ms),
            )
        assert rows.others() == [i for i, one in enumerate(alone) if not one.is_declared]
        assert rows.weakest() == [
            [min(alone[i].measured for i in of), min(alone[i].last for i in of)]
            for of in ((0, 1), (2, 3, 4))
        ]
    assert grown or all(one.is_declared for one in alone)


def test_figures_are_of_the_values_that_are_held_now() -> None:
    rng = np.random.default_rng(1)
    one = Pool(Reference(rng.gamma(9.0, size=400), BLOCK), additive=True)
    one.replace(np.append(rng.gamma(9.0, size=30), np.inf), 1)
    before, lost, error_ms = one.held, one.lost, one.error_ms
    assert one.held is before
    one.rows.add(rng.gamma(9.0, size=30) + 50.0, (0.0, 0.0, 0.0), 2, np.inf, 30)
    assert len(one.held) == len(before) + 30 == 61
    assert one.lost == lost * 31 / 61
    assert one.error_ms > error_ms
    with pytest.raises(ValueError, match="read-only"):
        one.held[0] = 0.0


@pytest.mark.parametrize("seed", range(20))
def test_cycles_meet_finite_values_in_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.gamma(2.0, size=int(rng.integers(1, 300)))
    values[rng.random(len(values)) < rng.choice([0.0, 0.3, 1.0])] = np.inf
    begin, offset = int(rng.choice([0, 7, 99, 100, 120])), int(rng.integers(0, 500))
    rows = rng.integers(0, 9, (2, 100))
    expected, known = rows.copy(), values[np.isfinite(values)]
    if len(known):
        demands = np.rint(known * 1e6 / 0.7).astype(np.int64)
        expected[:, begin:] = demands[(np.arange(begin, max(begin, 100)) + offset) % len(known)][
            : max(100 - begin, 0)
        ]
    fill(list(map(TimesRow.of, rows)), values, 0.7, begin, offset)
    np.testing.assert_array_equal(rows, expected)
