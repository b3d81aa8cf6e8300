"""The share of shadows where it is `auto`: by their price, for each placement by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import dwell
from dwell.control import Controller
from dwell.estimators import Corrected
from dwell.estimators.prices import KNOWN_PRICES
from dwell.estimators.sent_shadows import hindered
from dwell.estimators.shadow_price import affordable, fraction_of, shadow_prices
from dwell.model import Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.study import Contender, compare
from tests.cells.camera import camera
from tests.cells.examples import EXAMPLES
from tests.cells.many import many
from tests.cells.random_dags import random_dag
from tests.reference.test_against import Probe

CANONICAL = dwell.load(EXAMPLES / "canonical.yaml")


def auto(problem: Problem, **settings: Any) -> Problem:
    """Return a cell with `corrected`, whose shares of shadows follow from their prices."""
    given = {"estimator": "corrected", "shadow_fraction": "auto", **settings}
    return replace(problem, controller=replace(problem.controller, **given))


def test_a_placement_whose_jobs_never_wait_for_shadows_gets_the_largest_share() -> None:
    problem = auto(CANONICAL)
    before = KNOWN_PRICES.known.keys()
    assert fraction_of(problem) == dict.fromkeys(("LOC", "SO", "HYB"), 0.05)
    # That needs no simulation.
    assert KNOWN_PRICES.known.keys() == before


def test_the_share_is_the_largest_whose_price_is_small() -> None:
    problem = camera(min_improvement=0.2)
    assert hindered(problem) == {"LOC"}
    prices = shadow_prices(problem)["LOC"]
    assert [one.fraction for one in prices] == [0.05, 0.02, 0.01]
    # 0.2 of Delta_min.
    assert [one.cost < 0.04 for one in prices] == [False, False, True]
    assert fraction_of(problem) == {"LOC": 0.01, "OFF": 0.05}


def means(problem: Problem, fraction: float) -> tuple[float, float]:
    """Return the means over the windows of a long run on LOC: L95 and V_D."""
    run = dwell.simulate(problem, policy="LOC", estimator=Probe(fraction), seed=5, windows=800)
    l95_ms, rate = (run.windows[name].to_numpy() for name in ("seen_l95_ms", "seen_violation_rate"))
    return float(l95_ms.mean()), float(rate.mean())


@pytest.mark.parametrize("fraction", [0.05, 0.02])
def test_a_price_is_the_part_of_j_by_which_runs_with_shadows_differ(fraction: float) -> None:
    problem = camera(min_improvement=0.0)
    prices = {one.fraction: one for one in shadow_prices(problem)["LOC"]}
    l95_ms, rate = (
        with_shadows - without
        for with_shadows, without in zip(means(problem, fraction), means(problem, 0.0), strict=True)
    )
    weights, targets = problem.objective.weights, problem.objective.targets
    cost = weights.latency * l95_ms / targets.latency_ms + weights.violations * rate
    price = prices[fraction]
    assert price.l95_ms == pytest.approx(l95_ms, rel=0.2, abs=0.05)
    assert price.violation_rate == pytest.approx(rate, rel=0.2, abs=0.002)
    assert price.cost == pytest.approx(cost, rel=0.2, abs=0.005)


def test_a_larger_delta_min_allows_a_larger_share() -> None:
    shares = [affordable_under(delta) for delta in (0.0, 0.05, 0.2, 1.0, 10.0)]
    assert shares == sorted(shares)
    assert shares[-1] == 0.05
    assert shares[0] == 0.0


def affordable_under(min_improvement: float) -> float:
    problem = camera(min_improvement=min_improvement)
    return affordable(problem, shadow_prices(problem)["LOC"])


@pytest.mark.parametrize(("candidates", "share"), [(2, 0.05), (22, 1 / 21), (100, 1 / 99)])
def test_all_alternatives_together_get_every_cycle_at_most(candidates: int, share: float) -> None:
    fractions = fraction_of(many(candidates, shadow_fraction="auto"))
    assert isinstance(fractions, dict)
    assert set(fractions.values()) == {share}


@pytest.mark.parametrize("seed", range(30, 42))
def test_no_share_costs_more_than_is_allowed(seed: int) -> None:
    problem = auto(random_dag(seed))
    for name, share in dict(fraction_of(problem)).items():  # type: ignore[arg-type]
        prices = shadow_prices(problem)[name]
        assert share == 0.0 or next(one for one in prices if one.fraction == share).cost < 0.01
        assert all(one.cost >= 0.01 for one in prices if one.fraction > share)


def test_prices_are_kept_by_content() -> None:
    first = shadow_prices(camera())
    known = KNOWN_PRICES.known.keys()
    assert shadow_prices(camera()) == first
    assert fraction_of(replace(camera(), name="another")) == fraction_of(camera())
    assert KNOWN_PRICES.known.keys() == known


@pytest.mark.parametrize("estimator", ["profile", "scaling"])
def test_an_estimator_without_shadows_gets_none(estimator: str) -> None:
    problem = camera(estimator=estimator, min_improvement=0.017)
    before = KNOWN_PRICES.known.keys()
    controller = Controller(problem)
    assert controller.shadow_fractions == {"LOC": 0.0, "OFF": 0.0}
    assert not [one for one in KNOWN_PRICES.known.keys() - before if one.cycles]


def test_a_share_that_is_given_in_python_goes_before_auto() -> None:
    problem = camera()
    given = Controller(problem, estimator=Corrected(problem, shadow_fraction=0.3))
    assert given.shadow_fractions == {"LOC": 0.3, "OFF": 0.3}
    made = Controller(problem, estimator=Corrected(problem))
    assert made.shadow_fractions == Controller(problem).shadow_fractions == fraction_of(problem)


def test_a_run_sends_the_share_of_the_placement_in_force_and_records_it(tmp_path: Path) -> None:
    problem = camera(min_improvement=0.2)
    shares = {"LOC": 0.01, "OFF": 0.05}
    for name, share in shares.items():
        run = dwell.simulate(problem, policy=name, seed=1, windows=40)
        sent = run.windows["shadow_cycles"].mean()
        assert sent == pytest.approx(50 * share, abs=0.1)
        run.save(tmp_path / name)
        assert dwell.open_run(tmp_path / name).meta["shadow_fractions"] == shares


def test_where_the_least_share_is_too_dear_the_estimator_learns_from_the_incumbent() -> None:
    problem = camera(min_improvement=0.0)
    assert fraction_of(problem) == {"LOC": 0.0, "OFF": 0.05}
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=20)
    assert run.windows["shadow_cycles"].sum() == 0
    assert run.decisions["est_samples_LOC"].max() > 0  # type: ignore[operator]


def test_each_cell_of_a_fleet_has_its_own_shares() -> None:
    careful, bold = camera(min_improvement=0.2), replace(camera(min_improvement=1.0), name="bold")
    fleet = Fleet("mixed", (FleetEntry(careful), FleetEntry(bold)))
    run = dwell.simulate_fleet(fleet, seed=1, windows=3)
    fractions = [one.meta["shadow_fractions"] for one in run.cells.values()]
    assert fractions == [{"LOC": 0.01, "OFF": 0.05}, {"LOC": 0.05, "OFF": 0.05}]


def test_a_study_says_which_shares_its_runs_had() -> None:
    contenders = [Contender("dtp", "dtp"), Contender("alone", "LOC", "profile")]
    found = compare(
        camera(min_improvement=0.2),
        policies=contenders,
        scenarios=["baseline"],
        seeds=[1],
        windows=7,
    )
    shares = dict(found.costs.select("policy", "shadow_fraction").group_by("policy").all().rows())
    assert shares == {"dtp": [0.01, 0.05], "alone": [0.0, 0.0]}
