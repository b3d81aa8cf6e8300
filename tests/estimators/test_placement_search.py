"""The search finds what simulating every placement finds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from random import Random
from typing import Any

import pytest

import dwell
from dwell.cellfile.cell import from_document
from dwell.cost import cost
from dwell.errors import PlacementError, ProblemError, SimulationError
from dwell.estimators.any_placement import AnyPlacement
from dwell.estimators.cost_bounds import CostBounds
from dwell.estimators.placement_search import Ranked, rank, rank_until_apart
from dwell.model import Placement, Problem
from tests.cells.heft import heft_graph
from tests.cells.random_dags import random_dag
from tests.cells.rated import inner_loop, with_rates

CYCLES = 500


def every_placement(problem: Problem) -> Iterator[Placement]:
    """Yield all placements whose flows have links."""
    tasks, links = problem.pipeline.tasks, problem.fabric.links
    for nodes in itertools.product(*(task.on for task in tasks.values())):
        placement = Placement(zip(tasks, nodes, strict=True))
        ways = [(placement[flow.source], placement[flow.target]) for flow in problem.pipeline.flows]
        if all(one == other or f"{one}->{other}" in links for one, other in ways):
            yield placement


def brute_force(problem: Problem, seed: int) -> list[Ranked]:
    """Simulate all feasible placements, and check their lower bounds on the way."""
    sample = AnyPlacement(problem, "baseline", seed=seed, windows=CYCLES // problem.window_cycles)
    bounds, found = CostBounds(sample), []
    for placement in every_placement(problem):
        qos = sample.measure(placement.first).qos
        ranked = Ranked(placement, qos, cost(qos, placement, placement, problem.objective))
        partial, overloaded = bounds.root, False
        for name in bounds.order:
            partial = bounds.placed(partial, placement.first[name])
            overloaded |= bounds.overloaded(partial) is not None
            assert bounds.cost(partial) <= ranked.cost * (1 + 1e-9) + 1e-9
        if not overloaded:
            found.append(ranked)
    nodes = list(problem.fabric.nodes)
    return sorted(
        found,
        key=lambda one: (one.cost, [nodes.index(node) for node in one.placement.first.values()]),
    )


def small_dags(count: int) -> Iterator[tuple[int, Problem]]:
    """Yield random cells with contention and at most 300 placements."""
    known = ((seed, random_dag(seed)) for seed in itertools.count())
    small = (
        (seed, problem)
        for seed, problem in known
        if math.prod(len(task.on) for task in problem.pipeline.tasks.values()) <= 300
    )
    return itertools.islice(small, count)


def rated_dags(count: int) -> Iterator[tuple[int, Problem]]:
    """Yield small cells with several rates and sampled flows, some of them with idle cycles."""
    for number, (seed, problem) in enumerate(small_dags(count)):
        pipeline = with_rates(problem, rng := Random(seed)).pipeline
        deadline_ms = pipeline.period_ms * (1.0, 2.5)[number // 2 % 2]
        tasks = {
            name: replace(task, depth=rng.choice([0, 0, 1]))
            for name, task in pipeline.tasks.items()
        }
        yield (
            seed,
            replace(problem, pipeline=replace(pipeline, tasks=tasks, deadline_ms=deadline_ms)),
        )


@pytest.mark.parametrize(
    ("seed", "problem"),
    [
        *(pytest.param(*one, id=str(one[0])) for one in small_dags(20)),
        *(pytest.param(*one, id=f"rates-{one[0]}") for one in rated_dags(12)),
    ],
)
def test_the_search_finds_what_simulating_all_placements_finds(seed: int, problem: Problem) -> None:
    everything = brute_force(problem, seed)
    ranking = rank(problem, cycles=CYCLES, seed=seed, top=5)
    assert ranking.is_exact
    assert list(ranking.best) == everything[:5]
    pruned = sum(ranking.pruned.values())
    assert ranking.simulated + pruned == ranking.placements
    assert ranking.simulated <= len(everything)


def test_a_candidate_has_the_metrics_of_its_run() -> None:
    problem = dwell.load("examples/canonical.yaml")
    windows = 10
    sample = AnyPlacement(problem, "baseline", seed=3, windows=windows)
    for name, placement in problem.candidates.items():
        run = dwell.simulate(problem, policy=name, seed=3, windows=windows).windows
        measured = sample.measure(placement.first)
        assert measured.l95_ms.tolist() == run["seen_l95_ms"].to_list()
        assert measured.violation_rate.tolist() == run["seen_violation_rate"].to_list()
        assert measured.utilisation["R1"] == pytest.approx(run["u_R1"].mean())


@pytest.mark.parametrize(
    ("start_ms", "best_ms", "nodes"),
    [
        ((0, 0, 0), 75.0, "P3 P3 P2 P1 P3 P1 P2 P1 P2 P2"),
        ((1, 2, 3), 78.0, "P3 P3 P2 P1 P3 P1 P2 P1 P2 P2"),
        ((10, 20, 30), 102.0, "P2 P2 P1 P2 P2 P2 P1 P2 P2 P2"),
    ],
)
def test_the_best_placement_of_a_known_graph(
    start_ms: tuple[float, float, float], best_ms: float, nodes: str
) -> None:
    ranking = rank(heft_graph(start_ms), cycles=5, top=2)
    best, second = ranking.best
    assert ranking.is_exact
    assert best.cost == best_ms
    assert " ".join(best.placement.first[f"T{number}"] for number in range(1, 11)) == nodes
    assert second.cost > best.cost
    assert ranking.simulated < 0.02 * ranking.placements


def test_it_gives_placements_with_their_metrics_and_cost() -> None:
    problem = dwell.load("examples/canonical.yaml")
    found = dwell.search(problem, cycles=500, seed=1, top=2)
    assert len(found) == 2
    for placement, qos, J in found:
        assert cost(qos, placement, placement, problem.objective) == J
    assert found[0][2] <= found[1][2]


def test_equal_placements_are_in_the_order_of_nodes() -> None:
    problem = heft_graph()
    flat = {
        name: replace(task, on=dict.fromkeys(task.on, task.on["P1"]))
        for name, task in problem.pipeline.tasks.items()
    }
    pipeline = replace(problem.pipeline, tasks=flat)
    third = replace(problem.fabric.nodes["P3"], background=0.1)
    nodes = {**problem.fabric.nodes, "P3": third}
    fabric = replace(problem.fabric, nodes=nodes)
    # P1 and P2 are equal, so only one of two mirrored placements is simulated.
    ranking = rank(replace(problem, pipeline=pipeline, fabric=fabric), cycles=5, top=3)
    assert ranking.pruned["twins of others"] > 0
    for one in ranking.best:
        used = list(dict.fromkeys(one.placement.values()))
        assert "P2" not in used or ("P1" in used and used.index("P1") < used.index("P2"))


def test_random_nodes_are_no_twins() -> None:
    problem = heft_graph()
    assert "twins of others" not in rank(problem, cycles=5).pruned


def test_an_overloaded_node_is_not_feasible() -> None:
    problem = heft_graph()
    pipeline = replace(problem.pipeline, period_ms=80.0, deadline_ms=80.0)
    ranking = rank(replace(problem, pipeline=pipeline), cycles=5)
    assert any("over the capacity of" in reason for reason in ranking.pruned)
    pipeline = replace(problem.pipeline, period_ms=20.0, deadline_ms=20.0)
    overloaded = replace(problem, pipeline=pipeline)
    with pytest.raises(PlacementError, match=r"'heft' is feasible: \d+ over the capacity of P"):
        rank(overloaded, cycles=5)


def test_a_placement_without_a_link_is_not_feasible() -> None:
    problem = heft_graph()
    links = {name: link for name, link in problem.fabric.links.items() if name != "P1->P2"}
    ranking = rank(replace(problem, fabric=replace(problem.fabric, links=links)), cycles=5)
    assert ranking.pruned["without a link"] > 0
    for one in ranking.best:
        for flow in problem.pipeline.flows:
            assert (one.placement[flow.source], one.placement[flow.target]) != ("P1", "P2")


def test_several_scenarios_count_with_the_largest_cost() -> None:
    problem = dwell.load("examples/canonical.yaml")
    names = ("baseline", "robot-cpu-stress")
    (worst,) = rank(problem, names, cycles=500, top=1).best
    alone = [
        {one.placement: one.cost for one in rank(problem, (name,), cycles=500).best}
        for name in names
    ]
    largest = {placement: max(costs[placement] for costs in alone) for placement in alone[0]}
    assert worst.cost == min(largest.values())
    assert largest[worst.placement] == worst.cost


def test_a_scenario_is_simulated_whole() -> None:
    problem = dwell.load("examples/canonical.yaml")
    ranking = rank(problem, ("edge-cpu-stress",), cycles=100, top=1)
    assert ranking.cycles == 300 * problem.window_cycles


def test_a_search_that_ends_early_states_its_gap() -> None:
    ranking = rank(heft_graph(), cycles=5, top=1, most=50)
    assert not ranking.is_exact
    assert ranking.looked <= 50 + len(heft_graph().fabric.nodes)
    assert 0 < ranking.gap < 1
    assert ranking.best[0].cost * (1 - ranking.gap) <= 75.0


def test_more_cycles_tell_placements_apart_or_end_in_a_tie() -> None:
    problem = heft_graph()
    ranking = rank_until_apart(problem)
    assert (ranking.cycles, ranking.is_tie) == (1000, False)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"cycles": 0}, "cycles is 0"),
        ({"top": 0}, "top is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"cycles": True}, "cycles is True"),
    ],
)
def test_numbers_out_of_range_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(SimulationError, match=words):
        dwell.search(heft_graph(), **given)


def test_a_search_needs_a_run_of_each_sink() -> None:
    cell = inner_loop(window_cycles=60)
    cell["flows"][2]["sampled"] = False
    cell["tasks"]["control"]["every"] = 10
    problem = from_document(cell)
    assert dwell.search(problem, cycles=10)
    with pytest.raises(ProblemError, match="cycles: 9 is not allowed; it must be at least 10"):
        dwell.search(problem, cycles=9)


def test_an_unknown_scenario_is_refused() -> None:
    with pytest.raises(ProblemError, match="unknown scenario 'none'"):
        dwell.search(heft_graph(), scenario="none")
