"""The sum-of-means predictor, by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dwell.model import (
    Constant,
    Episodes,
    LinkDisturbance,
    NodeDisturbance,
    Normal,
    Problem,
    Quota,
    Scenario,
)
from dwell_lab.validation.sum_of_means import sum_of_means, sums_of_shares
from tests.cells.small import make_problem


def with_scenario(*items: object) -> Problem:
    problem = make_problem()
    scenario: Scenario = items  # type: ignore[assignment]
    return replace(problem, scenarios={"mine": scenario})


def latency(problem: Problem, name: str, scenario: str = "baseline") -> float:
    return sum_of_means(problem, problem.candidates[name], scenario, 0.0, 100.0)


def test_calm() -> None:
    problem = make_problem()
    # Sensing 3, perception 14, one message of 1 ms, planning 7, control 0.5.
    assert latency(problem, "LOC") == pytest.approx(3 + 14 + 1 + 7 + 0.5)
    assert latency(problem, "SO") == pytest.approx(3 + 1 + 10 + 5 + 1 + 0.5)


def test_bytes_take_time() -> None:
    problem = make_problem()
    links = {name: replace(link, rate_mbps=1.0) for name, link in problem.fabric.links.items()}
    slow = replace(problem, fabric=replace(problem.fabric, links=links))
    assert latency(slow, "SO") - latency(problem, "SO") == pytest.approx(2 * 8.0)


def test_quota_and_foreign_threads_slow_down() -> None:
    problem = with_scenario(NodeDisturbance("R1", stress_threads=7))
    # 4 cores among 8 threads: half the speed.
    assert latency(problem, "LOC", "mine") == pytest.approx(2 * 17 + 8.5)
    nodes = dict(problem.fabric.nodes)
    nodes["R1"] = replace(nodes["R1"], quota=Quota(0.5, 4.0))
    slow = replace(problem, fabric=replace(problem.fabric, nodes=nodes))
    assert latency(slow, "LOC") == pytest.approx(2 * 17 + 8.5)
    # Three threads that are there leave cores to spare.
    few = with_scenario(NodeDisturbance("R1", stress_threads=3))
    assert latency(few, "LOC", "mine") == pytest.approx(25.5)


def test_disturbances_count_by_the_time_they_are_on() -> None:
    extra = Normal(20.0, 5.0)
    whole = with_scenario(LinkDisturbance("R1", "E", add_delay_ms=extra))
    added = whole.scenario("mine")[0]
    assert isinstance(added, LinkDisturbance)
    assert added.add_delay_ms is not None
    mean_ms = added.add_delay_ms.expectation
    assert latency(whole, "SO", "mine") == pytest.approx(20.5 + mean_ms)
    part = with_scenario(LinkDisturbance("R1", "E", at_s=75.0, for_s=50.0, add_delay_ms=extra))
    assert latency(part, "SO", "mine") == pytest.approx(20.5 + mean_ms / 4)
    episodes = Episodes("x", every_s=Constant(3.0), for_s=Constant(1.0))
    some = with_scenario(LinkDisturbance("R1", "E", add_delay_ms=extra, episodes=episodes))
    assert latency(some, "SO", "mine") == pytest.approx(20.5 + mean_ms / 4)
    assert latency(whole, "LOC", "mine") == pytest.approx(25.5)


def test_shares_of_placements() -> None:
    sums = {"LOC": 25.0, "SO": 40.0}
    assert sums_of_shares(sums, {"LOC": 100}, 33.0) == (25.0, 0.0)
    assert sums_of_shares(sums, {"SO": 100}, 33.0) == (40.0, 1.0)
    assert sums_of_shares(sums, {"LOC": 95, "SO": 5}, 33.0) == (25.0, 0.05)
    assert sums_of_shares(sums, {"LOC": 94, "SO": 6}, 33.0) == (40.0, 0.06)
