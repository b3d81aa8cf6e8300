"""LatencyFirst: the lowest estimated L95 in every window."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from dwell.cost import ERRORS
from dwell.errors import MetricError, PolicyError
from dwell.policies import LatencyFirst
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, problem, qos


def latency_first(initial: str = "LOC") -> LatencyFirst:
    return LatencyFirst(candidates=CANDIDATES, initial=initial)


@pytest.mark.parametrize("initial", list(CANDIDATES))
@pytest.mark.parametrize("milliseconds", list(itertools.permutations([1.0, 2.0, 3.0])))
def test_it_takes_the_lowest(initial: str, milliseconds: tuple[float, ...]) -> None:
    shown = dict(zip(CANDIDATES, map(qos, milliseconds), strict=True))
    lowest = min(shown, key=lambda name: shown[name].l95_ms)
    decision = latency_first(initial).decide(observed=shown[initial], estimates=shown)
    assert (decision.name, decision.placement) == (lowest, CANDIDATES[lowest])
    assert decision.migrated == (lowest != initial)
    assert decision.reason == ("hold" if lowest == initial else "migrate")


def test_nothing_holds_it_back() -> None:
    policy = latency_first()
    loc = estimates(qos(10.0), qos(10.001), qos(20.0))
    so = estimates(qos(10.0), qos(9.999, 1.0, 1.0, 1.0), qos(20.0))
    names = [policy.decide(observed=qos(), estimates=window).name for window in [so, loc] * 4]
    assert names == ["SO", "LOC"] * 4


def test_dwell_is_counted_though_it_blocks_nothing() -> None:
    policy = latency_first()
    stay = estimates(qos(1.0), qos(2.0), qos(2.0))
    move = estimates(qos(3.0), qos(2.0), qos(2.0))
    dwells = [policy.decide(observed=qos(), estimates=w).dwell for w in (stay, stay, move, move)]
    assert dwells == [1, 2, 0, 1]


@pytest.mark.parametrize("initial", list(CANDIDATES))
def test_ties_go_to_the_incumbent(initial: str) -> None:
    shown = estimates(qos(5.0), qos(5.0), qos(5.0))
    assert latency_first(initial).decide(observed=qos(), estimates=shown).name == initial


def test_rounding_makes_no_latency_lower() -> None:
    # The mean of three windows of 0.1 ms is not 0.1 in floats.
    mean_ms = (0.1 + 0.1 + 0.1) / 3
    assert mean_ms > 0.1
    shown = estimates(qos(mean_ms), qos(0.1), qos(0.1))
    decision = latency_first().decide(observed=qos(), estimates=shown)
    assert (decision.name, decision.reason) == ("LOC", "hold")


def test_ties_of_others_go_to_the_first_candidate() -> None:
    shown = estimates(qos(9.0), qos(5.0), qos(5.0))
    assert latency_first().decide(observed=qos(), estimates=shown).name == "SO"
    turned = dict(reversed(list(shown.items())))
    assert latency_first().decide(observed=qos(), estimates=turned).name == "SO"


@pytest.mark.parametrize(
    ("errors_ms", "name"),
    [((0.0, 0.0), "SO"), ((2.9, 0.0), "SO"), ((0.0, 3.1), "LOC"), ((2.2, 2.2), "LOC")],
)
def test_the_lowest_must_be_lower_by_more_than_the_error(
    errors_ms: tuple[float, float], name: str
) -> None:
    assert ERRORS == 1.0
    here, there = (
        replace(qos(l95_ms), error=(error_ms, 1.0))
        for l95_ms, error_ms in zip((10.0, 7.0), errors_ms, strict=True)
    )
    shown = estimates(here, there, qos(8.0))
    assert latency_first().decide(observed=qos(), estimates=shown).name == name


def test_with_an_objective_costs_are_recorded() -> None:
    policy = LatencyFirst(candidates=CANDIDATES, objective=OBJECTIVE)
    shown = estimates(qos(40.0), qos(20.0), qos(30.0))
    assert policy.decide(observed=qos(), estimates=shown).costs == {
        "LOC": 1.0,
        "SO": 0.75,
        "HYB": 0.875,
    }
    assert latency_first().decide(observed=qos(), estimates=shown).costs == {}


def test_start_and_adopt() -> None:
    policy = latency_first()
    tie = estimates(qos(5.0), qos(5.0), qos(5.0))
    policy.adopt("HYB")
    assert policy.decide(observed=qos(), estimates=tie).name == "HYB"
    policy.start(problem())
    assert policy.decide(observed=qos(), estimates=tie).name == "LOC"


def test_errors() -> None:
    with pytest.raises(PolicyError, match="did you mean 'HYB'"):
        latency_first("HYP")
    policy = latency_first()
    with pytest.raises(MetricError, match="observed is None"):
        policy.decide(observed=None, estimates=estimates(qos(), qos(), qos()))  # type: ignore[arg-type]
    with pytest.raises(MetricError, match="nothing for candidate SO"):
        policy.decide(observed=qos(), estimates={"LOC": qos(), "HYB": qos()})
    with pytest.raises(MetricError, match="estimates is None"):
        policy.decide(observed=qos(), estimates=None)
    with pytest.raises(MetricError, match="the estimate of HYB is 3"):
        policy.decide(observed=qos(), estimates={**estimates(qos(), qos(), qos()), "HYB": 3})  # type: ignore[dict-item]
