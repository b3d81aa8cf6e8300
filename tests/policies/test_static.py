"""Static: the placement that never moves."""

from __future__ import annotations

import math

import pytest

from dwell.errors import MetricError, PolicyError
from dwell.model import QoS
from dwell.policies import Static
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, problem, qos

WORSE = estimates(qos(10.0), qos(119.0, 1.0), qos(10.0))


@pytest.mark.parametrize("name", list(CANDIDATES))
def test_it_never_moves(name: str) -> None:
    policy = Static(candidates=CANDIDATES, initial=name)
    for k in range(1, 6):
        decision = policy.decide(observed=qos(200.0, 1.0, 1.0, 1.0), estimates=WORSE)
        assert (decision.name, decision.placement) == (name, CANDIDATES[name])
        assert (decision.reason, decision.migrated, decision.dwell) == ("hold", False, k)
        assert decision.costs == {}
        assert math.isnan(decision.delta_j)


def test_it_starts_on_the_first_candidate() -> None:
    assert Static(candidates=CANDIDATES).incumbent == "LOC"


def test_with_an_objective_costs_are_recorded() -> None:
    policy = Static(candidates=CANDIDATES, initial="HYB", objective=OBJECTIVE)
    decision = policy.decide(observed=qos(), estimates=estimates(*[qos(20.0)] * 3))
    assert decision.costs == {"LOC": 0.625, "SO": 0.625, "HYB": 0.5}
    assert policy.decide(observed=qos()).costs == {}


def test_it_wants_back_from_where_somebody_else_has_moved_the_cell() -> None:
    policy = Static(candidates=CANDIDATES, initial="SO")
    for k in range(3):
        policy.adopt("LOC")
        assert policy.incumbent == "LOC"
        decision = policy.decide(observed=qos())
        assert (decision.name, decision.migrated, decision.reason) == ("SO", True, "migrate"), k
    decision = policy.decide(observed=qos())
    assert (decision.name, decision.migrated, decision.dwell) == ("SO", False, 1)
    policy.adopt("LOC")
    policy.start(problem())
    decision = policy.decide(observed=qos())
    assert (decision.name, decision.migrated, decision.dwell) == ("SO", False, 1)


def test_errors() -> None:
    with pytest.raises(PolicyError, match="initial is 'NOWHERE'"):
        Static(candidates=CANDIDATES, initial="NOWHERE")
    with pytest.raises(MetricError, match="observed is None"):
        Static(candidates=CANDIDATES).decide(observed=None)  # type: ignore[arg-type]
    priced = Static(candidates=CANDIDATES, objective=OBJECTIVE)
    with pytest.raises(MetricError, match="nothing for candidate SO"):
        priced.decide(observed=qos(), estimates={"LOC": qos()})
    with pytest.raises(MetricError, match="no utilisation of R1"):
        priced.decide(observed=qos(), estimates={"LOC": QoS(1.0, 0.0, {})})
