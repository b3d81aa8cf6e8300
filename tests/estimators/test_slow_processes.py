"""Prices of what changes slowly: the stated errors hold, whatever the computers are called."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.estimators.prices import MOST_CYCLES, Price, prices_of
from dwell.estimators.slow_processes import RENEWALS, mean_and_error, slow_processes
from dwell.kernels.random_draws import draw
from dwell.model import Constant, Problem

#: χ² that 20 values exceed by chance in 0.1 % of all cases.
CHI_20 = 45.3
SHARE = 6 / 66


def hall(edge: str, uplink: Mapping[str, Any], **more: Any) -> Problem:
    """Return a cell whose placement SO misses what its uplink, or its edge, delays by 20 ms."""
    document = {
        "dwell": 1,
        "name": "hall",
        "period_ms": 33.333333,
        "deadline_ms": 25,
        "window_cycles": 50,
        "nodes": {"R": {"tier": "robot", "cores": 4}, edge: {"tier": "edge", **more}},
        "links": [
            {"from": "R", "to": edge, "delay_ms": 1, **uplink},
            {"from": edge, "to": "R", "delay_ms": 1},
        ],
        "tasks": {
            "cam": {"on": {"R": {"exec_ms": 1}}},
            "see": {"on": {"R": {"exec_ms": 20}, edge: {"exec_ms": 10}}},
            "act": {"on": {"R": {"exec_ms": 1}}},
        },
        "flows": [{"from": "cam", "to": "see"}, {"from": "see", "to": "act"}],
        "candidates": {"LOC": {"see": "R"}, "SO": {"see": edge}},
        "scenarios": {
            "episodes": [
                {
                    "link": f"R->{edge}",
                    "add_delay_ms": 40,
                    "episodes": {
                        "name": f"{edge}-storms",
                        "every_s": {"exponential": {"mean": 60}},
                        "for_s": {"exponential": {"mean": 6}},
                    },
                }
            ],
            "late": [{"link": f"R->{edge}", "add_delay_ms": 40, "at_s": 900, "for_s": 100}],
            "later": [{"link": f"R->{edge}", "add_delay_ms": 40, "at_s": 1e5}],
        },
    }
    return from_document(document, folder=Path())


def bursts(times: float = 1.0) -> dict[str, Any]:
    every, length = ({"exponential": {"mean": ms * times}} for ms in (60_000, 6_000))
    return {"every_ms": every, "for_ms": length}


def priced(problems: Iterator[Problem], scenario: str = "baseline") -> list[Price]:
    return [prices_of(problem, scenario)["SO"] for problem in problems]


def chi_square(prices: list[Price], rate: float) -> float:
    return sum(((one.violation_rate - rate) / one.violation_error) ** 2 for one in prices)


def names(number: int = 20) -> Iterator[str]:
    return (f"E{i}" for i in range(number))


@pytest.mark.parametrize("place", ["link", "node", "scenario"])
def test_bursts_are_in_a_price_whatever_the_edge_is_called(place: str) -> None:
    on_link = {"bursts": {**bursts(), "add_delay_ms": 40}}
    # Five threads share two cores, and 10 ms become 25.
    on_node = {"bursts": {**bursts(), "threads": 4}, "cores": 2}
    if place == "scenario":
        prices = priced((hall(name, {}) for name in names()), "episodes")
    elif place == "node":
        prices = priced(hall(name, {}, **on_node) for name in names())
    else:
        prices = priced(hall(name, on_link) for name in names())
    assert chi_square(prices, SHARE) < CHI_20
    mean = np.mean([one.violation_rate for one in prices])
    error = math.sqrt(sum(one.violation_error**2 for one in prices)) / len(prices)
    assert abs(mean - SHARE) <= 2 * error
    assert all(0 < one.violation_error <= 0.02 for one in prices)
    assert all(one.is_settled for one in prices)


def test_errors_hold_where_bursts_are_so_rare_that_the_bound_on_cycles_cuts_them_short() -> None:
    rare = {"bursts": {**bursts(10), "add_delay_ms": 40}}
    prices = priced(hall(name, rare) for name in names())
    assert {one.cycles for one in prices} == {MOST_CYCLES}
    assert chi_square(prices, SHARE) < CHI_20
    assert all(0.02 < one.violation_error < 0.1 for one in prices)


def test_a_burst_that_was_never_seen_is_in_the_error() -> None:
    problem = hall("E", {"bursts": {**bursts(300), "add_delay_ms": 40}})
    found = prices_of(problem)
    # One burst of 30 minutes on average, in 55 minutes.
    assert found["SO"].violation_rate == 0.0
    assert found["SO"].violation_error > 0.3
    assert found["SO"].l95_error_ms > 10
    assert (found["LOC"].violation_error, found["LOC"].l95_error_ms) == (0.0, 0.0)


@pytest.mark.parametrize("rho", [0.99, 0.999, 0.9999])
def test_a_delay_with_a_long_memory_has_an_error_that_holds(rho: float) -> None:
    delay = {"delay_ms": {"ar1": {"mean": 6, "cv": 0.5, "rho": rho}}}
    prices = priced(hall(name, delay) for name in names())
    # The share of a lognormal distribution beyond D less all other times.
    sigma = math.sqrt(math.log1p(0.25))
    late = (math.log((25 - 13) / 6) + sigma**2 / 2) / sigma
    assert chi_square(prices, 0.5 * math.erfc(late / math.sqrt(2))) < CHI_20


def test_copies_of_a_trace_have_the_same_exact_rate(tmp_path: Path) -> None:
    values = np.ones(1999)
    values[700:900] = 41
    prices = []
    for rows, i in zip((1999, 1999, 1950, 1950), count(), strict=False):
        np.savetxt(tmp_path / f"{i}.csv", values[:rows], header="ms", comments="")
        file = str(tmp_path / f"{i}.csv")
        trace = {"delay_ms": {"trace": {"file": file, "column": "ms", "wrap": True}}}
        price = prices_of(hall("E", trace))["SO"]
        assert price.violation_rate == pytest.approx(200 / rows, abs=5e-4)
        prices.append(price)
    # 1950 rows are 39 windows of 50: nothing is counted more often than the rest.
    assert {(one.violation_rate, one.violation_error) for one in prices[2:]} == {(200 / 1950, 0.0)}
    assert all(0 < one.violation_error < 5e-4 for one in prices[:2])


def test_a_trace_that_is_too_long_is_uncertain(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "long.csv", np.ones(3 * MOST_CYCLES), header="ms", comments="")
    trace = {"file": str(tmp_path / "long.csv"), "column": "ms", "wrap": True}
    price = prices_of(hall("E", {"delay_ms": {"trace": trace}}))["SO"]
    assert (price.violation_rate, price.cycles) == (0.0, MOST_CYCLES)
    assert price.violation_error > 0.03


def test_everything_slow_is_simulated_for_long_enough() -> None:
    problem = hall("E", {"bursts": {**bursts(), "add_delay_ms": 40}})
    slow = slow_processes(problem, "baseline")
    cycles = slow.least_cycles(problem.pipeline.period_ms)
    assert cycles == pytest.approx(RENEWALS * 66_000 / 33.333333)
    rare = hall("E", {"bursts": {"every_ms": 1e6, "for_ms": 2e3, "add_delay_ms": 40}})
    assert slow_processes(rare, "baseline").least_cycles(33.333333) == 0.0
    harmless = hall("E", {"bursts": {**bursts(), "add_delay_ms": 0}})
    assert slow_processes(harmless, "baseline").least_cycles(33.333333) == 0.0


def test_the_share_of_windows_in_which_a_process_is_on() -> None:
    problem = hall("E", {"bursts": {"every_ms": 2_500, "for_ms": 2_500, "add_delay_ms": 40}})
    realisation = draw(problem, scenario="baseline", seed=1, windows=6)
    (process,) = slow_processes(problem, "baseline").on_off
    seen, shares = process.seen(realisation, realisation.release_ns[::50])
    # On from 2.5 to 5 s and from 7.5 to 10 s, in windows of 5/3 s.
    assert seen == 2
    assert shares == pytest.approx([0, 0.5, 1, 0, 0.5, 1], abs=1e-6)


def test_a_burst_that_is_declared_is_no_other_regime() -> None:
    rare = {"bursts": {**bursts(), "add_delay_ms": 40}}
    for name in names(4):
        problem = hall(name, rare)
        still = replace(problem.controller, initial="SO", min_improvement=1e6)
        run = dwell.simulate(
            replace(problem, controller=still),
            policy="dtp",
            estimator="corrected",
            seed=5,
            windows=200,
        )
        assert 0.04 < run.windows["violation_rate"].to_numpy().mean() < 0.2
        assert run.decisions["est_l95_ms_SO"].n_unique() == 1


def test_disturbances_are_simulated_to_their_end() -> None:
    late = prices_of(hall("E", {}), "late")["SO"]
    assert 1000 * 30 <= late.cycles <= 1000 * 30 + 50
    assert late.violation_rate == pytest.approx(0.1, abs=0.001)
    later = prices_of(hall("E", {}), "later")["SO"]
    assert (later.cycles, later.violation_rate) == (MOST_CYCLES, 0.0)


def test_what_never_settles_is_not_settled() -> None:
    problem = hall("E", {})
    see = problem.pipeline.tasks["see"]
    # A cycle waits 67 ns longer than the one before.
    slow = replace(see, on={**see.on, "E": replace(see.on["E"], exec_ms=Constant(33.3334))})
    pipeline = replace(problem.pipeline, tasks={**problem.pipeline.tasks, "see": slow})
    found = prices_of(replace(problem, pipeline=pipeline))
    assert not found["SO"].is_settled
    assert found["LOC"].is_settled


def test_windows_that_are_equal_have_no_error_and_one_alone_any() -> None:
    assert mean_and_error(np.full(9, 0.1)) == (0.1, 0.0)
    assert mean_and_error(np.array([3.0])) == (3.0, math.inf)


def test_the_error_of_windows_that_depend_on_each_other_is_that_of_their_stretches() -> None:
    rng = np.random.default_rng(5)
    found = []
    for _ in range(200):
        walk = np.convolve(rng.standard_normal(1_009), np.ones(10) / 10, mode="valid")
        mean, error = mean_and_error(walk)
        found.append(abs(mean) / error)
    # Of 20 stretches: beyond twice the error are as many as of Student's t.
    assert 0.01 < np.mean(np.array(found) > 2.0) < 0.12
