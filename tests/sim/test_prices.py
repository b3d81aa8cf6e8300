"""Prices of transmitted bytes in windows, decisions and J, by hand; prices of nodes in reports."""

from __future__ import annotations

from dataclasses import replace

import pytest

import dwell
from dwell.cost import cost
from dwell.errors import MetricError, ProblemError, SimulationError
from dwell.model import (
    Constant,
    Execution,
    Flow,
    Link,
    Node,
    Objective,
    Problem,
    QoS,
    Replicas,
    Targets,
    Task,
    Weights,
)
from dwell.study import compare
from dwell.study.judged_cost import judged_cost
from dwell.study.reference import references
from tests.cells.generated import make_problem

BYTES = 1_000_000
PER_GB = 0.1
#: 36 GB per hour.
PER_HOUR = 10 * BYTES / 1e9 * 3600 * PER_GB


def cell(weight: float = 0.0, *, loss: float = 0.0, retransmit_ms: float | None = None) -> Problem:
    """Return a cell whose candidate OFF sends 36 GB per hour to E, faster than LOC."""
    problem = make_problem(
        [Node("R", "robot", 4), Node("E", "cloud", 4, price_per_hour=2.5)],
        [
            Task("sense", {"R": Execution(Constant(2.0))}),
            Task("act", {"R": Execution(Constant(50.0)), "E": Execution(Constant(5.0))}),
            Task("apply", {"R": Execution(Constant(1.0))}),
        ],
        [Flow("sense", "act", payload_bytes=BYTES), Flow("act", "apply", payload_bytes=100)],
        links=[
            Link("R", "E", Constant(5.0), loss=loss, retransmit_ms=retransmit_ms),
            Link("E", "R", Constant(5.0)),
        ],
        candidates={"LOC": {"act": "R"}, "OFF": {"act": "E"}},
        period_ms=100.0,
        window_cycles=20,
    )
    links = dict(problem.fabric.links)
    links["R->E"] = replace(links["R->E"], price_per_gb=PER_GB)
    return weighing(replace(problem, fabric=replace(problem.fabric, links=links)), weight)


def weighing(problem: Problem, weight: float) -> Problem:
    weights = Weights(latency=1.0, robot=0.0, edge=0.0, price=weight)
    targets = Targets(latency_ms=100.0, price_per_hour=PER_HOUR)
    objective = replace(problem.objective, weights=weights, targets=targets)
    return replace(problem, objective=objective)


def free() -> Problem:
    """Return the cell without prices of bytes."""
    problem = cell()
    links = {name: replace(link, price_per_gb=0.0) for name, link in problem.fabric.links.items()}
    return replace(problem, fabric=replace(problem.fabric, links=links))


def seen(problem: Problem, policy: str, **options: object) -> list[float]:
    run = dwell.simulate(problem, seed=1, windows=3, policy=policy, **options)  # type: ignore[arg-type]
    return run.windows["seen_price_per_hour"].to_list()


def test_a_window_has_the_price_of_what_its_candidate_sends() -> None:
    assert seen(cell(), "LOC") == [0.0] * 3
    assert seen(cell(), "OFF") == pytest.approx([PER_HOUR] * 3)


def test_lost_messages_and_repeated_ones_have_their_price() -> None:
    assert seen(cell(loss=0.5), "OFF") == pytest.approx([PER_HOUR] * 3)
    run = dwell.simulate(cell(loss=0.5, retransmit_ms=10.0), seed=1, windows=100, policy="OFF")
    assert run.windows["seen_price_per_hour"].mean() == pytest.approx(2 * PER_HOUR, rel=0.1)


def test_shadows_have_their_price() -> None:
    problem = cell(9.0)
    controller = replace(problem.controller, estimator="shadow", shadow_fraction=0.5)
    prices = seen(replace(problem, controller=controller), "dtp")
    # Up to two of 20 cycles more or less.
    assert prices[2] == pytest.approx(PER_HOUR / 2, abs=PER_HOUR / 10)


def test_both_copies_of_a_replica_have_their_price() -> None:
    problem = cell()
    both = Replicas({name: problem.candidates[name] for name in ("LOC", "OFF")})
    problem = replace(problem, candidates={**problem.candidates, "BOTH": both})
    assert seen(problem, "BOTH") == pytest.approx([PER_HOUR] * 3)


def test_the_price_is_a_term_of_the_cost_of_windows() -> None:
    windows = [
        dwell.simulate(cell(weight), seed=1, windows=2, policy="OFF").windows
        for weight in (0.0, 3.0)
    ]
    more = windows[1]["cost"] - windows[0]["cost"]
    assert more.to_list() == pytest.approx([3.0] * 2)


@pytest.mark.parametrize("estimator", ["profile", "corrected", "shadow"])
def test_a_policy_weighs_the_price_against_the_latency(estimator: str) -> None:
    for weight, placement in ((0.0, "OFF"), (2.0, "LOC")):
        problem = cell(weight)
        controller = replace(problem.controller, estimator=estimator, decide_cycles=5)
        run = dwell.simulate(
            replace(problem, controller=controller), seed=1, windows=6, policy="dtp"
        )
        assert run.windows["placement"][-1] == placement
        known = run.decisions.filter(run.decisions["est_price_per_hour_OFF"].is_not_null())
        assert known["est_price_per_hour_OFF"][0] == pytest.approx(PER_HOUR)
        assert {"seen_price_per_hour", "est_price_per_hour_LOC"} <= {*known.columns}


def test_a_cell_without_prices_has_no_columns_of_prices() -> None:
    run = dwell.simulate(free(), seed=1, windows=1, policy="dtp")
    columns = *run.windows.columns, *run.decisions.columns
    assert not [name for name in columns if "price" in name]


def test_the_search_ranks_by_the_price_too() -> None:
    for weight, node in ((0.0, "E"), (2.0, "R")):
        (placement, qos, J), _ = dwell.search(cell(weight), cycles=200, top=2)
        assert placement["act"] == node
        assert qos.price_per_hour == pytest.approx(0.0 if node == "R" else PER_HOUR)
        assert pytest.approx(J) == cost(qos, placement, placement, cell(weight).objective)


def test_a_comparison_shows_the_price_of_bytes_and_of_nodes() -> None:
    found = compare(cell(), policies=["LOC", "OFF"], seeds=[1], windows=3, processes=1)
    rows = {row["policy"]: row for row in found.runs.iter_rows(named=True)}
    assert rows["OFF"]["seen_price_per_hour"] == pytest.approx(PER_HOUR)
    assert [rows[name]["nodes_price_per_hour"] for name in ("LOC", "OFF")] == [0.0, 2.5]


def test_a_weight_needs_a_target_and_a_price() -> None:
    with pytest.raises(ProblemError, match=r"targets\.price_per_hour: missing"):
        Objective(weights=Weights(price=1.0), targets=Targets(latency_ms=100.0))
    with pytest.raises(ProblemError, match=r"objective\.weights\.price.*price_per_gb"):
        weighing(free(), 1.0)


def test_a_qos_without_a_price_has_no_cost_that_weighs_it() -> None:
    placement = cell().candidates["LOC"]
    qos = QoS(50.0, 0.0, {"R": 0.0, "E": 0.0})
    with pytest.raises(MetricError, match="price_per_hour is missing"):
        cost(qos, placement, placement, cell(1.0).objective)


def test_references_and_judges_refuse_prices_that_they_cannot_know() -> None:
    with pytest.raises(ProblemError, match=r"weights\.price"):
        references(cell(1.0), dwell.draw(cell(1.0), seed=1, windows=2))
    run = dwell.simulate(free(), seed=1, windows=2, policy="LOC")
    with pytest.raises(SimulationError, match="price_per_gb"):
        judged_cost(run, cell(1.0))
