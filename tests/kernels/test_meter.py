"""Times and demands of parts: as a plain loop over cycles and columns finds them."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.kernels.meter import CyclesLayout, PartTimes, WindowRows
from dwell.kernels.pools import places

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

CANDIDATES, TASKS, PARTS, LINKS = 3, 4, 9, 2
LIMIT_NS = 60_000_000


class Window(NamedTuple):
    """Cycles, and maybe their shadows, and what they go through."""

    cycles: list[NDArray[np.integer]]
    shadows: list[NDArray[np.integer]] | None
    sources: Ints
    parts: Ints
    shared: NDArray[np.bool_]


def instants(rng: np.random.Generator, count: int, columns: int) -> Ints:
    """Return instants of which some have not come."""
    known = rng.integers(0, 100_000_000, (count, columns))
    return np.where(rng.random((count, columns)) < 0.8, known, -1)


def random_window(seed: int, flows: int, *, shadows: bool) -> Window:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 60))
    shape = (1 + CANDIDATES, TASKS + flows)
    # No part twice in a row: a cycle goes through each of its parts once.
    numbers = np.array([rng.permutation(PARTS)[: shape[1]] for _ in range(shape[0])])
    shared = rng.random((1 + CANDIDATES, flows)) < 0.5
    shared[0] = False
    sent: list[list[NDArray[np.integer]]] = [
        [
            rng.integers(low, CANDIDATES, count).astype(np.int16),
            *(instants(rng, count, width) for width in (TASKS, TASKS, flows, TASKS, TASKS)),
        ]
        for low in (0, -1)
    ]
    return Window(
        sent[0],
        sent[1] if shadows else None,
        rng.integers(0, TASKS, flows),
        np.where(rng.random(shape) < 0.7, numbers, -1),
        shared,
    )


def span(begin_ns: int, end_ns: int) -> float | None:
    if begin_ns >= 0 and end_ns >= 0:
        return (end_ns - begin_ns) / 1e6
    return math.inf if 0 <= begin_ns < LIMIT_NS else None


def looped(
    window: Window,
    cost: Floats | None = None,
    link: Sequence[int] = (),
    repeats: Sequence[int] = (),
) -> dict[int, list[float]]:
    """What is found, by part."""
    found: dict[int, list[float]] = {}
    for active in range(CANDIDATES):
        mine = np.flatnonzero(window.cycles[0] == active)
        ways = [(0, mine, window.cycles)]
        if window.shadows is not None:
            through = window.shadows[0][mine]
            ways += [(1 + i, mine[through == i], window.shadows) for i in range(CANDIDATES)]
        crossings: list[tuple[int, int, int, int, int]] = []
        for way, rows, of in ways:
            for column, part in enumerate(window.parts[way].tolist()):
                for row in rows if part >= 0 else ():
                    flow = column - TASKS
                    if flow < 0 and cost is not None:
                        ended, work_ns = of[2][row, column], of[4][row, column]
                        ms = work_ns * cost[part] / 1e6 if min(ended, work_ns) >= 0 else None
                    elif flow < 0:
                        ms = span(of[1][row, column], of[2][row, column])
                    else:
                        sender = window.cycles if window.shared[way, flow] else of
                        sent_ns = sender[2][row, window.sources[flow]]
                        ms = span(sent_ns, of[3][row, flow])
                        if ms is not None and ms < math.inf and cost is not None:
                            place = len(found.get(part, ()))
                            crossings.append((link[part], sent_ns, part, place, of[3][row, flow]))
                    if ms is not None:
                        found.setdefault(part, []).append(ms)
        # Of every link on which messages wait, the messages in the order in which they were sent.
        assert cost is not None or not crossings
        for number in range(LINKS):
            free_ns, last_ns, delays = 0.0, -math.inf, list[float]()
            for _, sent_ns, part, place, arrived_ns in sorted(
                (one for one in crossings if one[0] == number), key=lambda one: one[1]
            ):
                assert cost is not None
                free_ns = max(free_ns, sent_ns) + cost[part]
                ms = found[part][place] - (free_ns - sent_ns) / 1e6
                ms = max(ms, 0.0)
                if repeats[part]:
                    if arrived_ns <= last_ns + 100_000:
                        ms = next((known for known in reversed(delays) if known <= ms), ms)
                    last_ns = max(last_ns, arrived_ns)
                delays.append(ms)
                found[part][place] = ms
    return found


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("demands", [False, True])
@pytest.mark.parametrize("flows", [0, 3])
@pytest.mark.parametrize("seed", range(5))
def test_times_and_demands_are_those_of_a_plain_loop(
    seed: int, flows: int, demands: bool, shadows: bool
) -> None:
    window = random_window(seed, flows, shadows=shadows)
    rng = np.random.default_rng(seed)
    cost, link = rng.integers(1, 5_000_000, PARTS) / 2.0, rng.integers(-1, LINKS, PARTS)
    repeats = np.isin(link, [1]).astype(np.int64)
    known = link.tolist(), repeats.tolist()
    times = copy.deepcopy(PartTimes(PARTS, cost, link, repeats) if demands else PartTimes(PARTS))
    times.begin(WindowRows.of(window.cycles, window.shadows), LIMIT_NS)
    layout = CyclesLayout(window.sources, window.parts, window.shared)
    for active in range(CANDIDATES):
        times.add(active, copy.deepcopy(layout))
    found = {part: values.tolist() for part, values in times.by_part().items()}
    expected = looped(window, cost, *known) if demands else looped(window)
    if demands:
        expected = {part: np.round(values, 6).tolist() for part, values in expected.items()}
    assert found == expected
    assert list(found) == list(expected)


def test_a_window_overwrites_the_one_before() -> None:
    layout = CyclesLayout(np.zeros(0, np.int64), np.array([[0], [-1]]), np.zeros((2, 0), np.bool_))
    times = PartTimes(1)
    for count, ms in ((3, 1), (1, 2), (5, 3)):
        ready, end = np.zeros((count, 1), np.int64), np.full((count, 1), ms * 1_000_000)
        columns = np.zeros(count, np.int16), ready, end, ready[:, :0], end, ready
        times.begin(WindowRows.of(columns), 0)
        times.add(0, layout)
        assert times.by_part()[0].tolist() == [ms] * count


def crossed(
    sent_ms: Sequence[float], arrived_ms: Sequence[float], *, send_ms: float = 4.0, repeats: int = 0
) -> list[float]:
    """Delays of a flow's messages on a link that takes a time to send one; -1 for what is lost."""
    layout = CyclesLayout(
        np.zeros(1, np.int64), np.array([[-1, 0], [-1, -1]]), np.zeros((2, 1), np.bool_)
    )
    times = PartTimes(1, np.array([send_ms * 1e6]), np.array([0]), np.array([repeats]))
    end = np.array([[round(ms * 1e6)] for ms in sent_ms])
    arrived = np.array([[-1 if ms < 0 else round(ms * 1e6)] for ms in arrived_ms])
    columns = np.zeros(len(end), np.int16), end, end, arrived, end, end
    times.begin(WindowRows.of(columns), LIMIT_NS)
    times.add(0, layout)
    delays: list[float] = times.by_part()[0].tolist()
    return delays


def test_waiting_behind_own_messages_and_their_transmission_are_no_delay() -> None:
    # The second waits 3 ms for the first, the third none.
    assert crossed([0.0, 1.0, 20.0], [6.0, 10.0, 27.0]) == [2.0, 2.0, 3.0]
    # In whatever order they are handed in.
    assert crossed([1.0, 0.0], [10.0, 6.0]) == [2.0, 2.0]


def test_a_message_that_arrives_before_it_can_be_sent_has_no_delay() -> None:
    assert crossed([0.0], [3.0]) == [0.0]


def test_of_a_lost_message_nothing_is_taken_off_and_nothing_waits_behind_it() -> None:
    assert crossed([0.0, 1.0], [-1, 7.0]) == [math.inf, 2.0]


def test_waiting_behind_a_repeated_message_is_no_delay() -> None:
    # The third is repeated: the fourth and the fifth wait for it.
    sent, arrived = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0], [5.0, 15.0, 65.0, 65.0, 65.05, 66.0]
    assert crossed(sent, arrived, send_ms=0.0) == [5.0, 5.0, 45.0, 35.0, 25.05, 16.0]
    assert crossed(sent, arrived, send_ms=0.0, repeats=1) == [5.0, 5.0, 45.0, 5.0, 5.0, 16.0]


def test_a_message_waits_no_longer_than_it_took() -> None:
    # The second waits for the first, and nothing is known of it but that it took 3 ms at most.
    assert crossed([0.0, 6.0], [9.0, 9.0], send_ms=0.0, repeats=1) == [9.0, 3.0]


def literal(known: Sequence[float], value: float) -> float:
    below, ties = sum(x < value for x in known), sum(x == value for x in known)
    return (below + ties / 2 + 0.5) / (len(known) + 1)


numbers = st.integers(0, 5).map(float) | st.just(math.inf)


@given(st.lists(numbers, max_size=9), st.lists(numbers, max_size=9))
def test_places_lie_among_the_known_ones(known: list[float], values: list[float]) -> None:
    found = places(np.sort(np.array(known, float)), np.array(values, float))
    shares = [literal(known, value) for value in values]
    larger, smaller = (-sum(map(math.log, of)) for of in ([1 - p for p in shares], shares))
    assert found == pytest.approx((larger, smaller, sum(shares)))
