"""The formulas of the paper, against numbers worked out by hand and against themselves in bulk."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cost import (
    cost,
    cost_error,
    excess,
    hamming,
    margin,
    price,
    tier_nodes,
    tier_utilisation,
)
from dwell.errors import MetricError, PlacementError
from dwell.model import Caps, Objective, Placement, QoS, Targets, Weights

LOC = Placement({"sensing": "R1", "perception": "R1", "planning": "R2", "control": "R2"})
SO = Placement({"sensing": "R1", "perception": "E", "planning": "E", "control": "R2"})
HYB = Placement({"sensing": "R1", "perception": "E", "planning": "R2", "control": "R2"})

OBJECTIVE = Objective(
    weights=Weights(latency=1, violations=3, robot=0.5, edge=0.3, switching=0.5),
    targets=Targets(latency_ms=40, robot=0.7, edge=0.7),
    caps=Caps(latency_ms=120, utilisation=0.98),
    tiers={"R1": "robot", "E": "edge", "R2": "robot", "C": "cloud"},
)
APART = replace(
    OBJECTIVE,
    weights=replace(OBJECTIVE.weights, cloud=0.2),
    targets=replace(OBJECTIVE.targets, cloud=0.5),
)
QOS = QoS(30.0, 0.1, {"R1": 0.35, "E": 0.14, "R2": 0.2, "C": 0.07})

latencies = st.floats(0, 1e6)
shares = st.floats(0, 1)
metrics = st.builds(
    QoS,
    l95_ms=latencies,
    violation_rate=shares,
    utilisation=st.fixed_dictionaries(dict.fromkeys(OBJECTIVE.tiers, shares)),
)


@pytest.mark.parametrize(
    ("current", "previous", "share"),
    [(LOC, LOC, 0.0), (LOC, HYB, 0.25), (HYB, SO, 0.25), (LOC, SO, 0.5), (SO, LOC, 0.5)],
)
def test_hamming_by_hand(current: Placement, previous: Placement, share: float) -> None:
    assert hamming(current, previous) == share


def test_hamming_does_not_depend_on_the_order_of_tasks() -> None:
    assert hamming(LOC, Placement(reversed(list(LOC.first.items())))) == 0


def test_hamming_names_the_tasks_that_differ() -> None:
    with pytest.raises(PlacementError, match="perception, planning, sensing against tracking"):
        hamming(
            Placement({"sensing": "R1", "perception": "R1", "planning": "R2"}),
            Placement({"tracking": "R1"}),
        )


def test_hamming_refuses_a_subset_of_the_tasks() -> None:
    with pytest.raises(PlacementError):
        hamming(LOC, Placement({"sensing": "R1"}))
    with pytest.raises(PlacementError):
        hamming(Placement({"sensing": "R1"}), LOC)


def test_cost_by_hand() -> None:
    # 1 * 30/40 + 3 * 0.1 + 0.5 * 0.35/0.7 + 0.3 * 0.14/0.7 + 0.5 * 1/4
    assert cost(QOS, HYB, LOC, OBJECTIVE) == pytest.approx(0.75 + 0.3 + 0.25 + 0.06 + 0.125)


def test_cloud_nodes_count_as_edge_nodes() -> None:
    busy = replace(QOS, utilisation={**QOS.utilisation, "C": 0.42})
    assert cost(busy, LOC, LOC, OBJECTIVE) == pytest.approx(0.75 + 0.3 + 0.25 + 0.18)


def test_cloud_nodes_weighed_apart() -> None:
    assert cost(QOS, LOC, LOC, APART) == pytest.approx(0.75 + 0.3 + 0.25 + 0.06 + 0.2 * 0.14)


def test_a_tier_without_nodes_counts_as_zero() -> None:
    alone = replace(OBJECTIVE, tiers={"R1": "robot"})
    assert tier_utilisation({"R1": 0.35}, alone) == (0.35, 0.0, 0.0)
    assert cost(QoS(0.0, 0.0, {"R1": 0.35}), LOC, LOC, alone) == pytest.approx(0.25)


def test_tiers_take_the_maximum_and_not_the_mean() -> None:
    used = {"R1": 1.0, "R2": 0.0, "E": 0.25, "C": 0.75}
    assert tier_utilisation(used, OBJECTIVE) == (1.0, 0.75, 0.0)
    assert tier_utilisation(used, APART) == (1.0, 0.25, 0.75)
    assert tier_nodes(OBJECTIVE) == (("R1", "R2"), ("E", "C"), ())
    assert tier_nodes(APART) == (("R1", "R2"), ("E",), ("C",))


def test_nodes_of_no_tier_are_ignored() -> None:
    more = replace(QOS, utilisation={**QOS.utilisation, "laptop": 1.0})
    assert cost(more, LOC, LOC, OBJECTIVE) == cost(QOS, LOC, LOC, OBJECTIVE)


def test_accelerators_count_in_their_tier_where_the_objective_takes_them() -> None:
    busy = replace(QOS, utilisation={**QOS.utilisation, "E.gpu": 0.84})
    assert cost(busy, LOC, LOC, OBJECTIVE) == cost(QOS, LOC, LOC, OBJECTIVE)
    taken = replace(OBJECTIVE, accelerators={"E.gpu": "edge", "R1.npu": "robot"})
    more = 0.3 * (0.84 - 0.14) / 0.7
    assert cost(busy, LOC, LOC, taken) == pytest.approx(cost(QOS, LOC, LOC, OBJECTIVE) + more)
    # Of what nobody measured J does without.
    assert cost(QOS, LOC, LOC, taken) == cost(QOS, LOC, LOC, OBJECTIVE)


def test_the_cap_holds_for_accelerators_whatever_j_takes() -> None:
    busy = replace(QOS, utilisation={**QOS.utilisation, "E.gpu": 0.996})
    assert excess(busy, OBJECTIVE) == 1 / 0.98 - 1


@pytest.mark.parametrize("node", ["R1", "E", "R2", "C"])
def test_a_missing_node_is_named(node: str) -> None:
    used = {name: share for name, share in QOS.utilisation.items() if name != node}
    with pytest.raises(MetricError, match=f"utilisation of {node} is missing"):
        cost(QoS(1.0, 0.0, used), LOC, LOC, OBJECTIVE)


def test_cost_is_never_infinite() -> None:
    with pytest.raises(MetricError, match="J is inf"):
        cost(replace(QOS, l95_ms=1e308), LOC, LOC, replace(OBJECTIVE, targets=Targets(1e-9)))


def test_cost_checks_the_placements() -> None:
    with pytest.raises(PlacementError):
        cost(QOS, LOC, Placement({"sensing": "R1"}), OBJECTIVE)


@given(metrics, latencies, shares)
def test_cost_grows_with_every_metric(qos: QoS, more_ms: float, more: float) -> None:
    base = cost(qos, LOC, LOC, APART)
    rate = min(1.0, qos.violation_rate + more)
    assert cost(replace(qos, l95_ms=qos.l95_ms + more_ms), LOC, LOC, APART) >= base
    assert cost(replace(qos, violation_rate=rate), LOC, LOC, APART) >= base
    for node in APART.tiers:
        busier = {**qos.utilisation, node: qos.utilisation[node] + more}
        assert cost(replace(qos, utilisation=busier), LOC, LOC, APART) >= base
    assert base <= cost(qos, LOC, HYB, APART) <= cost(qos, LOC, SO, APART)


@given(metrics)
def test_a_weight_of_zero_takes_its_metric_out(qos: QoS) -> None:
    only = replace(OBJECTIVE, weights=Weights(0, 1, 0, 0, 0))
    assert cost(qos, LOC, SO, only) == qos.violation_rate


@pytest.mark.parametrize("objective", [OBJECTIVE, APART], ids=["cloud as edge", "cloud apart"])
def test_arrays_and_floats_are_priced_alike_bit_by_bit(objective: Objective) -> None:
    rng = np.random.default_rng(3)
    n = 5000
    l95 = rng.lognormal(3, 2, n)
    rate, robot, edge, cloud = rng.random((4, n))
    switching = rng.choice([0.0, 0.25, 1 / 3, 0.5, 1.0], n)
    together = price(l95, rate, robot, edge, cloud, switching, objective)
    still = price(l95, rate, robot, edge, cloud, 0.0, objective)
    for k in range(n):
        row = [float(column[k]) for column in (l95, rate, robot, edge, cloud)]
        l95_k, rate_k, robot_k, edge_k, cloud_k = row
        alone = price(l95_k, rate_k, robot_k, edge_k, cloud_k, float(switching[k]), objective)
        assert alone == together[k]
        assert price(l95_k, rate_k, robot_k, edge_k, cloud_k, 0.0, objective) == still[k]


def test_cost_of_a_window_is_its_row_of_the_bulk() -> None:
    rng = np.random.default_rng(4)
    l95, rate = rng.lognormal(3, 1, 500), rng.random(500)
    used = {node: rng.random(500) for node in OBJECTIVE.tiers}
    nodes = tier_nodes(OBJECTIVE)
    robot = np.maximum.reduce([used[node] for node in nodes.robot])
    edge = np.maximum.reduce([used[node] for node in nodes.edge])
    bulk = price(l95, rate, robot, edge, 0.0, 0.0, OBJECTIVE)
    for k in range(500):
        qos = QoS(float(l95[k]), float(rate[k]), {n: float(used[n][k]) for n in used})
        assert cost(qos, LOC, LOC, OBJECTIVE) == bulk[k]


@pytest.mark.parametrize(
    ("l95_ms", "busiest", "expected"),
    [
        (60.0, 0.49, -0.5),
        (120.0, 0.49, 0.0),
        (180.0, 0.49, 0.5),
        (60.0, 0.98 * 1.25, 0.25),
        (180.0, 0.98 * 1.25, 0.5),
        # From 0.995 on a node counts as full.
        (60.0, 0.9949, 0.9949 / 0.98 - 1),
        (60.0, 0.995, 1 / 0.98 - 1),
        (60.0, 1.0, 1 / 0.98 - 1),
    ],
)
def test_excess_by_hand(l95_ms: float, busiest: float, expected: float) -> None:
    qos = QoS(l95_ms, 0.0, {"R1": 0.1, "E": busiest})
    assert excess(qos, OBJECTIVE) == pytest.approx(expected)


def test_excess_without_caps() -> None:
    assert excess(QoS(1e9, 1.0, {"R1": 1.0}), replace(OBJECTIVE, caps=Caps())) == -1


@given(st.floats(1e-3, 1e6), st.integers(-3, 3))
def test_excess_is_positive_exactly_above_the_cap(cap: float, steps: int) -> None:
    value = cap
    for _ in range(abs(steps)):
        value = math.nextafter(value, math.inf if steps > 0 else 0.0)
    objective = replace(OBJECTIVE, caps=Caps(latency_ms=cap))
    assert (excess(QoS(value, 0.0, {}), objective) > 0) == (value > cap)


@given(metrics, st.floats(-1, 1), st.floats(-1, 1))
def test_no_errors_of_one_estimate_make_more_of_j_than_their_sum(
    window: QoS, late: float, missed: float
) -> None:
    """L95 and V_D are off by up to their errors, each in its own direction."""
    error = (5.0, 0.05)
    off = replace(
        window,
        l95_ms=max(window.l95_ms + late * error[0], 0.0),
        violation_rate=min(max(window.violation_rate + missed * error[1], 0.0), 1.0),
    )
    difference = cost(off, LOC, LOC, OBJECTIVE) - cost(window, LOC, LOC, OBJECTIVE)
    assert abs(difference) <= cost_error(error, OBJECTIVE) + 1e-9


def test_errors_by_hand() -> None:
    assert cost_error(None, OBJECTIVE) == cost_error((0.0, 0.0), APART) == 0.0
    assert cost_error((4.0, 0.1), OBJECTIVE) == pytest.approx(4 / 40 + 3 * 0.1)
    assert margin(0.0, 0.0) == 0.0
    assert margin(3.0, 4.0) == margin(4.0, 3.0) == 5.0
