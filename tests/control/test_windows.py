from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import dwell
from dwell.control import final_l95_ms, reactions
from dwell.control.windows import missed_cycles, seen_l95_ms, utilisation
from dwell.model import Constant, Execution, Node, Task
from dwell.model.instants import NEVER_NS
from tests.cells.generated import make_problem

MS = 1_000_000
PROBLEM = make_problem([Node("R", "robot")], [Task("a", {"R": Execution(Constant(1.0))})])


def test_a_cycle_misses_when_it_is_late_or_not_there_yet() -> None:
    latency = np.array([10, 33, 34, NEVER_NS, 30], np.int64)
    age = np.array([100, 100, 100, 20, 25], np.int64)
    # The last has an age below D and will complete after the close: not known to be in time.
    assert missed_cycles(latency, age, 33) == 3
    np.testing.assert_array_equal(
        missed_cycles(np.stack([latency, latency]), np.stack([age, age]), 33), [3, 3]
    )


def seen(
    latency_ns: NDArray[np.int64], age_ns: NDArray[np.int64], censor_ms: float
) -> tuple[float, float]:
    l95_ms, uncut_ms = seen_l95_ms(latency_ns, age_ns, censor_ms)
    return float(l95_ms), float(uncut_ms)


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=60), st.data())
def test_l95_is_the_order_statistic_of_what_could_be_known(
    latencies: list[int], data: st.DataObject
) -> None:
    size = len(latencies)
    ages = data.draw(st.lists(st.integers(0, 10**9), min_size=size, max_size=size))
    # An unfinished cycle comes after a finished one that shows the same.
    shown = sorted((min(pair), pair[0] > pair[1]) for pair in zip(latencies, ages, strict=True))
    rank = math.ceil(0.95 * size - 1e-9)
    l95, unfinished = shown[rank - 1]
    unfinished &= sum(flag for _, flag in shown) > size - rank
    found = seen(np.array(latencies), np.array(ages), 500.0)
    assert found == (min(l95 / MS, 500.0), math.inf if unfinished else l95 / MS)


def test_an_l95_that_no_completion_showed_is_known_as_an_age_alone() -> None:
    latency, age = np.full(20, 8 * MS), np.full(20, 100 * MS)
    latency[:2] = NEVER_NS
    assert seen(latency, age, 60.0) == (60.0, math.inf)
    latency[1] = 90 * MS
    assert seen(latency, age, 60.0) == (60.0, 90.0)
    # A cap of any size is a bound.
    assert seen(latency, age, 1e300) == (90.0, 90.0)
    far = np.full(20, NEVER_NS - 1)
    assert seen(np.full(20, NEVER_NS), far, 1e300)[1] == math.inf
    # One of the two, released of late, is neither lost nor known to be: there are five percent.
    latency[:], age[0] = 8 * MS, 20 * MS
    latency[0], latency[1] = NEVER_NS, 90 * MS
    assert seen(latency, age, 60.0) == (20.0, 20.0)
    age[0] = 100 * MS
    # Two cycles released just before the close are unfinished, and younger than others' latencies.
    latency[:], age[-2:] = 60 * MS, 20 * MS
    assert seen(latency, age, 100.0) == (60.0, 60.0)


def test_final_l95_is_infinite_where_more_than_5_percent_never_completed() -> None:
    latency = np.full((2, 100), 10 * MS, np.int64)
    latency[0, :5] = latency[1, :6] = NEVER_NS
    np.testing.assert_array_equal(final_l95_ms(latency), [10.0, np.inf])


def test_utilisation_is_a_share_of_the_cores() -> None:
    busy = np.array([1.0e9, 9.0e9])
    assert utilisation(busy, np.array([4.0, 4.0]), 10**9) == pytest.approx([0.25, 1.0])


def test_the_cost_of_a_placement_that_loses_cycles_does_not_grow_with_its_windows() -> None:
    cell = dwell.load("examples/canonical.yaml")
    cost = {}
    for W in (25, 50, 100, 200, 400):
        controller = replace(cell.controller, decide_cycles=W)
        problem = replace(cell, window_cycles=W, warmup_windows=400 // W, controller=controller)
        runs = [
            dwell.simulate(
                problem, scenario="robot-cpu-stress", policy="LOC", seed=seed, windows=9600 // W
            )
            for seed in range(1, 9)
        ]
        costs = [run.windows.filter(~run.windows["warmup"])["cost"].mean() for run in runs]
        cost[W] = float(np.mean(np.array(costs, float)))
    mean = sum(cost.values()) / len(cost)
    assert all(abs(value / mean - 1) < 0.05 for value in cost.values()), cost


def test_a_release_waits_for_the_first_actuation_in_time_that_knows_a_later_one() -> None:
    # The actuation of place 1 comes last; those of places 3 and 4 never do.
    at_ns = np.array([10, 50, 30, NEVER_NS, NEVER_NS])
    newest = np.array([-1, 4, 6, 9, 9])
    cycles, places = reactions(at_ns, newest, 2, 0)
    assert (cycles.tolist(), places.tolist()) == ([0, 2, 4], [2, 2, 2])
    cycles, places = reactions(at_ns[:2], newest[:2], 2, 2)
    assert (cycles.tolist(), places.tolist()) == ([2], [1])
    assert [len(one) for one in reactions(at_ns[3:], newest[3:], 1, 0)] == [0, 0]
