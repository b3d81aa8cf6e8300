"""Times of parts: as a plain loop over cycles and columns finds them."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from dwell.kernels.meter import CyclesLayout, PartTimes

Ints = NDArray[np.int64]

CANDIDATES, TASKS, PARTS = 3, 4, 9
LIMIT_NS = 60_000_000


def instants(rng: np.random.Generator, count: int, columns: int) -> Ints:
    """Return instants of which some have not come."""
    known = rng.integers(0, 100_000_000, (count, columns))
    return np.where(rng.random((count, columns)) < 0.8, known, -1)


def span(begin_ns: int, end_ns: int) -> float | None:
    if begin_ns >= 0 and end_ns >= 0:
        return (end_ns - begin_ns) / 1e6
    return math.inf if 0 <= begin_ns < LIMIT_NS else None


@pytest.mark.parametrize("flows", [0, 3])
@pytest.mark.parametrize("seed", range(5))
def test_times_are_those_of_a_plain_loop(seed: int, flows: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 60))
    sources = rng.integers(0, TASKS, flows)
    shape = (1 + CANDIDATES, TASKS + flows)
    # No part twice in a row: a cycle goes through each of its parts once.
    numbers = np.array([rng.permutation(PARTS)[: shape[1]] for _ in range(shape[0])])
    parts = np.where(rng.random(shape) < 0.7, numbers, -1)
    shared = rng.random((1 + CANDIDATES, flows)) < 0.5
    shared[0] = False
    placement = rng.integers(0, CANDIDATES, count).astype(np.int16)
    through = rng.integers(-1, CANDIDATES, count).astype(np.int16)
    columns = (TASKS, TASKS, flows)
    cycles: list[NDArray[np.integer]] = [
        placement,
        *(instants(rng, count, width) for width in columns),
    ]
    shadows: list[NDArray[np.integer]] = [
        through,
        *(instants(rng, count, width) for width in columns),
    ]
    for sent in (None, shadows):
        expected: dict[int, list[float]] = {}
        times = copy.deepcopy(PartTimes(PARTS))
        times.begin(cycles, sent, LIMIT_NS)
        for active in range(CANDIDATES):
            times.add(active, copy.deepcopy(CyclesLayout(sources, parts, shared)))
            mine = np.flatnonzero(placement == active)
            ways = [(0, mine, cycles)]
            if sent is not None:
                ways += [(1 + i, mine[through[mine] == i], sent) for i in range(CANDIDATES)]
            for way, rows, of in ways:
                for column in range(TASKS + flows):
                    for row in rows:
                        if column < TASKS:
                            found = span(of[1][row, column], of[2][row, column])
                        else:
                            flow = column - TASKS
                            sender = cycles if shared[way, flow] else of
                            found = span(sender[2][row, sources[flow]], of[3][row, flow])
                        if found is not None and parts[way, column] >= 0:
                            expected.setdefault(int(parts[way, column]), []).append(found)
        found_times = times.by_part()
        assert {part: values.tolist() for part, values in found_times.items()} == expected
        assert list(found_times) == list(expected)


def test_a_window_overwrites_the_one_before() -> None:
    layout = CyclesLayout(np.zeros(0, np.int64), np.array([[0], [-1]]), np.zeros((2, 0), np.bool_))
    times = PartTimes(1)
    for count, ms in ((3, 1), (1, 2), (5, 3)):
        ready, end = np.zeros((count, 1), np.int64), np.full((count, 1), ms * 1_000_000)
        times.begin((np.zeros(count, np.int16), ready, end, ready[:, :0]), None, 0)
        times.add(0, layout)
        assert times.by_part()[0].tolist() == [ms] * count
