from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dwell.cost import ERRORS, cost, tier_utilisation
from dwell.errors import MetricError, PolicyError
from dwell.model import Caps, Objective, Placement, QoS, Targets, Tier, Weights
from dwell.policies.pricing import Pricing

CANDIDATES = {
    "LOC": Placement({"perception": "R1", "planning": "R2"}),
    "SO": Placement({"perception": "E", "planning": "E"}),
}
TIERS = {"R1": "robot", "R2": "robot", "E": "edge"}
OBJECTIVE = Objective(Weights(), Targets(30.0), Caps(100.0, 0.9), TIERS)  # type: ignore[arg-type]


def qos(l95_ms: float = 20.0, used: float = 0.5) -> QoS:
    return QoS(l95_ms, 0.0, dict.fromkeys(TIERS, used))


def pricing(objective: Objective = OBJECTIVE) -> Pricing:
    return Pricing(CANDIDATES, objective)


def test_prices_are_those_of_the_formulas() -> None:
    estimates = {"LOC": qos(), "SO": qos(40.0)}
    found = pricing().estimated(estimates, "LOC")
    for name, placement in CANDIDATES.items():
        assert found[name] == cost(estimates[name], placement, CANDIDATES["LOC"], OBJECTIVE)
    assert pricing().cost(qos(), "SO", "LOC") == cost(
        qos(), CANDIDATES["SO"], CANDIDATES["LOC"], OBJECTIVE
    )


@pytest.mark.parametrize("used", [{}, {"E.gpu": 0.8}, {"E.gpu": 0.2, "R1.npu": 0.9}])
@pytest.mark.parametrize("apart", [False, True])
def test_prices_with_accelerators_are_those_of_the_formulas(
    used: dict[str, float], apart: bool
) -> None:
    accelerators: dict[str, Tier] = {"E.gpu": "cloud" if apart else "edge", "R1.npu": "robot"}
    objective = Objective(
        Weights(cloud=0.2 if apart else None),
        Targets(30.0, cloud=0.5 if apart else None),
        tiers={**OBJECTIVE.tiers, "E": "cloud"} if apart else OBJECTIVE.tiers,
        accelerators=accelerators,
    )
    window = QoS(20.0, 0.1, {**dict.fromkeys(TIERS, 0.5), **used})
    found = pricing(objective)
    estimates = dict.fromkeys(CANDIDATES, window)
    for name, placement in CANDIDATES.items():
        expected = cost(window, placement, CANDIDATES["LOC"], objective)
        assert found.estimated(estimates, "LOC")[name] == expected
    assert found.used(window) == tier_utilisation(window.utilisation, objective)


def test_candidates_within_the_caps_are_eligible() -> None:
    estimates = {"LOC": qos(used=0.95), "SO": qos()}
    assert pricing().eligible(estimates) == (["SO"], True)


def test_where_none_is_those_nearest_to_their_caps_are() -> None:
    both = {"LOC": qos(used=0.99), "SO": qos(used=0.99 + 1e-9)}
    assert pricing().eligible(both) == (["LOC", "SO"], False)
    one = {"LOC": qos(used=0.99), "SO": qos(l95_ms=500.0)}
    assert pricing().eligible(one) == (["LOC"], False)


def test_the_reason_tells_what_a_cap_has_done() -> None:
    costs = {"LOC": 1.0, "SO": 2.0}
    assert pricing().reason("SO", costs, ["SO"], within_caps=True) == "capped"
    assert pricing().reason("LOC", costs, ["LOC", "SO"], within_caps=True) == "migrate"
    assert pricing().reason("LOC", costs, ["LOC"], within_caps=False) == "infeasible"


def test_what_cannot_be_priced_is_named() -> None:
    with pytest.raises(PolicyError, match="must be an Objective"):
        Pricing(CANDIDATES, "cheap")  # type: ignore[arg-type]
    with pytest.raises(MetricError, match="nothing for candidate SO"):
        pricing().estimated({"LOC": qos()}, "LOC")
    with pytest.raises(MetricError, match="the window of LOC has no utilisation of R2"):
        pricing().cost(QoS(1.0, 0.0, {"R1": 0.1, "E": 0.1}), "LOC", "LOC")
    with pytest.raises(MetricError, match="must be a QoS"):
        pricing().cost(3, "LOC", "LOC")  # type: ignore[arg-type]
    with pytest.raises(MetricError, match="no finite J"):
        pricing(Objective(Weights(latency=1e9), Targets(1e-9), tiers=OBJECTIVE.tiers)).cost(
            qos(1e300), "LOC", "LOC"
        )


def test_the_margin_is_that_of_the_errors_of_j() -> None:
    certain, exact = qos(), replace(qos(), error=(0.0, 0.0))
    one, other = replace(qos(), error=(3.0, 0.1)), replace(qos(), error=(1.5, 0.0))
    weights = OBJECTIVE.weights
    J = weights.latency * 3.0 / 30.0 + weights.violations * 0.1
    found = pricing()
    assert found.margin(certain, certain) == found.margin(certain, exact) == 0.0
    assert found.margin(one, certain) == found.margin(exact, one) == pytest.approx(ERRORS * J)
    both = ERRORS * math.hypot(J, weights.latency * 1.5 / 30.0)
    assert found.margin(one, other) == found.margin(other, one) == pytest.approx(both)


def test_the_margin_of_paired_errors_grows_with_the_number_of_candidates() -> None:
    here = replace(qos(), error=(2.0, 0.1), paired=(0.0, 0.0))
    there = replace(qos(), error=(2.0, 0.1), paired=(0.3, 0.01))
    names = "ABCDEFGH"
    for count in range(2, 9):
        many = Pricing(dict.fromkeys(names[:count], CANDIDATES["LOC"]), OBJECTIVE)
        expected = math.sqrt(2 * math.log(count)) * (0.3 / 30.0 + 3.0 * 0.01)
        assert many.margin(there, here) == pytest.approx(ERRORS * expected)
