"""Prices of ages and of misses: those of a static run on the same realisation."""

from __future__ import annotations

from dataclasses import replace

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.cost import excess
from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.fleet_prices import FleetPrices, PricedCell
from dwell.estimators.prices import Question, price_of, prices_of
from dwell.kernels.random_draws import draw
from dwell.model import (
    Caps,
    Chain,
    Constant,
    Execution,
    MissCap,
    Node,
    NodeDisturbance,
    Problem,
    Task,
    Uniform,
    Weights,
)
from tests.cells.generated import make_problem

SETTLING = 5
WINDOWS = 25


def with_ages(problem: Problem, latency: str | None = "see-act") -> Problem:
    objective = replace(
        problem.objective,
        weights=Weights(age=1.0),
        targets=replace(problem.objective.targets, age_ms=100.0),
        latency=latency,
    )
    return replace(problem, objective=objective)


@pytest.mark.parametrize("latency", ["see-act", None])
def test_a_price_equals_a_static_run_on_the_same_realisation(latency: str | None) -> None:
    problem = with_ages(dwell.load("examples/inner-loop.yaml"), latency)
    drawn = draw(problem, scenario="weak-wifi", seed=3, windows=WINDOWS)
    player = CandidatePlayer([(problem, drawn)])
    for name in problem.candidates:
        found = price_of(player, name)
        windows = dwell.simulate_realisation(problem, drawn, policy=name).windows[SETTLING:]
        assert found.l95_ms == pytest.approx(windows["seen_l95_ms"].mean(), rel=1e-12)
        assert found.age is not None
        assert found.age[0] == pytest.approx(windows["seen_age_ms"].mean(), rel=1e-12)
        if latency is not None:
            age_ms = windows["age_l95_see-act"].mean()
            assert found.uncut_l95_ms == pytest.approx(age_ms, rel=1e-3)


def test_an_age_above_the_bound_for_j_is_over_the_cap() -> None:
    problem = with_ages(dwell.load("examples/inner-loop.yaml"))
    chains = {"see-act": Chain("camera", "control", 20)}
    objective = replace(problem.objective, caps=Caps(latency_ms=100))
    problem = replace(
        problem, pipeline=replace(problem.pipeline, chains=chains), objective=objective
    )
    # The age is about 153 ms; J counts 100 ms.
    price = prices_of(problem)["EDGE"]
    assert price.l95_ms == problem.censor_ms == 100
    assert price.uncut_l95_ms > 140
    assert excess(price.qos, problem.objective) > 0.4


def test_what_an_objective_measures_is_part_of_a_prices_key() -> None:
    problem = dwell.load("examples/inner-loop.yaml")
    aged = with_ages(problem, None)
    capped = replace(problem, objective=replace(problem.objective, caps=Caps(misses=MissCap(1, 9))))
    known = [problem, aged, with_ages(problem), capped]
    questions = {Question.of(one, "baseline", 1, None) for one in known}
    assert len(questions) == len(known)


def missing(share: float) -> Problem:
    """Return a cell that misses a share of its deadlines, each independently."""
    times = Uniform(0.0, 10.0)
    problem = make_problem(
        [Node("R", "robot", 1), Node("E", "edge", 1)],
        [Task("act", {"R": Execution(times), "E": Execution(Constant(1.0))})],
        candidates={"LOC": {"act": "R"}, "OFF": {"act": "E"}},
        period_ms=20.0,
        deadline_ms=10.0 * (1 - share),
        window_cycles=50,
    )
    capped = replace(problem.objective, caps=Caps(misses=MissCap(m=2, k=20)))
    return replace(problem, objective=capped)


def test_a_cap_on_misses_plays_enough_cycles_and_counts_stretches() -> None:
    problem = missing(0.05)
    found = prices_of(problem)
    # P(more than 2 of 20 independent cycles miss) for a share of 5 %.
    binomial = 1 - sum(
        coefficient * 0.05**m * 0.95 ** (20 - m) for m, coefficient in enumerate((1, 20, 190))
    )
    assert found["LOC"].misses == pytest.approx(binomial, rel=0.25)
    assert found["OFF"].misses == 0.0
    assert min(price.cycles for price in found.values()) >= 20 * 20
    assert excess(found["LOC"].qos, problem.objective) == pytest.approx(
        (found["LOC"].misses or 0.0) / 0.01 - 1
    )
    longer = replace(problem.objective, caps=Caps(misses=MissCap(m=20, k=200)))
    prices = prices_of(replace(problem, objective=longer))
    assert min(price.cycles for price in prices.values()) >= 20 * 200


@pytest.mark.parametrize("estimator", ["profile", "corrected"])
def test_a_candidate_over_the_cap_on_misses_is_not_eligible(estimator: str) -> None:
    run = dwell.simulate(missing(0.05), seed=1, windows=4, policy=f"dtp+{estimator}")
    first = run.decisions.row(0, named=True)
    assert first["est_misses_LOC"] > 0.01 >= first["est_misses_OFF"] == 0.0
    assert (first["eligible_LOC"], first["eligible_OFF"]) == (False, True)
    assert run.decisions["placement"][-1] == "OFF"
    fewer = dwell.simulate(missing(0.001), seed=1, windows=1, policy=f"dtp+{estimator}")
    assert fewer.decisions["eligible_LOC"].all()


def test_the_stretches_of_measured_conditions_are_long_enough() -> None:
    problem = missing(0.05)
    item = NodeDisturbance("R", stress_threads=1)
    problem = replace(problem, scenarios={"busy": (item,)})
    run = dwell.simulate(
        problem, scenario="busy", seed=1, windows=8, policy="LOC", estimator="corrected"
    )
    last = run.decisions.row(-1, named=True)
    assert 0.1 < last["est_misses_LOC"] <= 1.0


def test_a_fleet_counts_stretches_as_the_price_of_a_cell_alone() -> None:
    problem = missing(0.05)
    longer = replace(problem.objective, caps=Caps(misses=MissCap(m=20, k=600)))
    cells = [PricedCell("a", problem), PricedCell("b", replace(problem, objective=longer))]
    price = FleetPrices(cells, ["E"]).price(("LOC", "OFF"))
    capped, other = (price.qos(i) for i in range(2))
    assert capped is not None
    assert other is not None
    assert capped.misses == pytest.approx(prices_of(problem)["LOC"].misses, rel=0.4)
    assert excess(capped, problem.objective) > 0 == other.misses
    assert price.cells[0] is not None
    # Both cells play the 20 stretches of the longer cap.
    assert len(price.cells[0].windows) * problem.window_cycles >= 20 * 600


def test_stretches_count_data_that_are_too_old() -> None:
    problem = dwell.load("examples/inner-loop.yaml")
    capped = replace(problem.objective, caps=Caps(misses=MissCap(1, 20)))
    shares = []
    for max_age_ms in (180.0, 140.0):
        # The age of a picture is about 150 ms at the last command before the next one.
        chains = {"see-act": Chain("camera", "control", max_age_ms)}
        pipeline = replace(problem.pipeline, chains=chains)
        cell = replace(problem, pipeline=pipeline, objective=capped)
        of_fleet = FleetPrices([PricedCell("a", cell)], ["E"]).price(("EDGE",)).qos(0)
        assert of_fleet is not None
        shares.append((prices_of(cell)["EDGE"].misses, of_fleet.misses))
    assert shares == [(0.0, 0.0), (1.0, 1.0)]


@pytest.mark.parametrize("deadline_ms", [20, 100, 1280])
def test_a_price_has_no_age_of_windows_that_close_after_the_last_release(deadline_ms: int) -> None:
    """A constant latency of 86 ms and half of 20 ms, with few cycles."""
    document = {
        "dwell": 1,
        "period_ms": 20,
        "deadline_ms": deadline_ms,
        "nodes": {"R": {"tier": "robot", "cores": 5}},
        "tasks": {"see": {"workers": 5, "on": {"R": {"exec_ms": 86}}}},
        "candidates": {"R": {}},
        "objective": {"weights": {"age": 1}, "targets": {"age_ms": 100}},
    }
    price = prices_of(from_document(document))["R"]
    assert price.age is not None
    assert price.age == pytest.approx((min(96, 4 * max(deadline_ms, 20)), 0.0))
    assert price.own["R"] == pytest.approx(86 / 20 / 5)
    assert price.cycles < 2_000
