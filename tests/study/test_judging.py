"""J of a run by another objective than its controller's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dwell.sim
from dwell import draw, simulate, simulate_realisation
from dwell.model import FrozenDict
from dwell.study.judging import judged_cost, judged_costs
from dwell.study.summary import summarise
from tests.cells.small import make_problem

PROBLEM = make_problem()


@pytest.mark.parametrize("policy", ["dtp", "latency-first", "SO"])
@pytest.mark.parametrize("scenario", ["baseline", "network-impairment"])
def test_judging_by_the_own_objective_changes_no_bit(policy: str, scenario: str) -> None:
    run = simulate(PROBLEM, scenario=scenario, policy=policy, seed=3, windows=40)
    assert judged_costs(run, PROBLEM).tolist() == run.windows["cost"].to_list()


def test_judging_by_another_objective_is_what_its_controller_would_see() -> None:
    weights = replace(PROBLEM.objective.weights, switching=3.0, edge=0.7)
    other = replace(PROBLEM, objective=replace(PROBLEM.objective, weights=weights))
    realisation = draw(PROBLEM, scenario="network-impairment", seed=3, windows=40)
    # Latency-first looks at no weight: both controllers decide the same.
    one, two = (
        simulate_realisation(problem, realisation, policy="latency-first")
        for problem in (PROBLEM, other)
    )
    assert one.decisions["migrated"].any()
    assert judged_costs(one, other).tolist() == two.windows["cost"].to_list()


def test_windows_that_the_controller_did_not_see_are_not_judged() -> None:
    down = dwell.model.NodeDisturbance("E", at_s=3.0, for_s=2.0, down=True)
    problem = replace(PROBLEM, scenarios=FrozenDict({**PROBLEM.scenarios, "crash": (down,)}))
    run = simulate(problem, scenario="crash", policy="dtp", seed=1, windows=40)
    unseen = run.windows["cost"].is_null()
    assert unseen.any()
    assert np.isnan(judged_costs(run, problem)).tolist() == unseen.to_list()
    assert judged_cost(run, problem) == pytest.approx(summarise(run, problem, {}).row["cost"])
