"""The oracle knows when disturbances are on, and no other random numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import fmean, stdev
from typing import Any

import numpy as np
import pytest

from dwell.model import (
    AR1,
    Bursts,
    Constant,
    ControllerSettings,
    Disturbance,
    Episodes,
    Exponential,
    Fabric,
    FrozenDict,
    Gamma,
    Link,
    LinkDisturbance,
    LogNormal,
    NodeDisturbance,
    Normal,
    Problem,
    Process,
    Scenario,
    Trace,
    TraceTable,
    Uniform,
)
from dwell.sim import Drawing, draw
from dwell.study import oracle
from dwell.study.oracle import RAMP_PRICES, expected_costs, sets_of
from dwell.study.reference import (
    CLAIRVOYANT,
    CLAIRVOYANT_DWELL,
    ORACLE,
    ORACLE_DWELL,
    References,
    mean_cost,
    planned,
    references,
)
from tests.cells.dynamic import dynamic_problem
from tests.cells.small import make_problem
from tests.study.test_reference import SETTINGS, TURNS, W, realise, stressed, two_nodes

EPISODES = Episodes("turns", every_s=Uniform(0.3, 0.9), for_s=Uniform(0.3, 0.9))
DYNAMIC = dynamic_problem()


def placements(found: References, title: str) -> list[str]:
    return [str(name) for name in found.runs[title].windows["placement"]]


def with_links(scenario: Scenario, rate_mbps: float = math.inf) -> Problem:
    """Return the cell of two nodes with a link of which only the scenario makes use."""
    problem = two_nodes(4.0)
    links = {"A->B": Link("A", "B", Constant(1.0), rate_mbps=rate_mbps)}
    fabric = Fabric(nodes=problem.fabric.nodes, links=links)
    return replace(problem, fabric=fabric, scenarios={"given": scenario})


# ---------------------------------------------------------------------------- known by hand


def test_it_moves_exactly_in_time() -> None:
    problem = two_nodes(4.0, TURNS)
    found = references(problem, realise(problem, 20))
    turns = ["A"] * 6 + ["B"] * 4 + ["A"] * 2 + ["B"] * 3 + ["A"] * 5
    assert placements(found, ORACLE) == turns
    # J is 0.4, and a move costs 0.3: nothing is random, so the clairvoyant plans the same.
    assert found.costs[ORACLE] == pytest.approx(0.4 + 4 * 0.3 / 18)
    assert found.costs[ORACLE] == found.costs[CLAIRVOYANT]
    assert found.promised[ORACLE] == pytest.approx(found.promised[CLAIRVOYANT], rel=1e-12)


@pytest.mark.parametrize(("windows", "moved"), [(1, 0), (2, 2)])
def test_a_short_disturbance_is_not_worth_the_moves(windows: int, moved: int) -> None:
    # A stressed window costs 0.4 more, two moves 0.6.
    after = 6 + windows
    spans = ("B", 0, 6), ("A", 6, windows), ("B", after, 20 - after)
    problem = two_nodes(4.0, stressed(*spans))
    found = references(problem, realise(problem, 20))
    placed = placements(found, ORACLE)
    assert placed == ["A"] * 6 + ["B" if moved else "A"] * windows + ["A"] * (14 - windows)
    assert found.runs[ORACLE].decisions["migrated"].sum() == moved


def test_its_dwell_is_the_problem_s() -> None:
    spans = [("AB"[k % 4 == 1], k, 2) for k in range(3, 15, 2)]
    problem = two_nodes(4.0, stressed(("B", 0, 3), *spans), switching=0.1)
    problem = replace(problem, controller=replace(problem.controller, min_dwell=2))
    found = references(problem, realise(problem, 15))
    free, bound = (
        np.flatnonzero(np.diff(found.sequences[title].choice)) + 1
        for title in (ORACLE, ORACLE_DWELL)
    )
    assert free.tolist() == [3, 5, 7, 9, 11, 13]
    assert len(bound) >= 2
    assert min(np.diff([0, *bound])) >= 3


@pytest.mark.parametrize(
    ("settings", "apart"),
    [
        ({"min_dwell": 0, "min_dwell_cycles": 15}, (30, 30)),
        ({"min_dwell": 1, "min_dwell_cycles": 25, "decide_cycles": 5}, (30, 40)),
        ({"min_dwell": None, "estimator": "profile"}, (40, 40)),
        ({"min_dwell": None, "estimator": "corrected"}, (10, 10)),
        ({"min_dwell": None, "estimator": "corrected", "decide_cycles": 5}, (5, 10)),
    ],
)
def test_references_keep_to_the_dwell_of_the_cell(
    settings: dict[str, Any], apart: tuple[int, int]
) -> None:
    spans = [("AB"[k % 2], k, 1) for k in range(20)]
    problem = two_nodes(4.0, stressed(*spans), switching=0.01)
    problem = replace(problem, controller=replace(problem.controller, **settings))
    found = references(problem, realise(problem, 20))
    for title, least, every in (
        (ORACLE_DWELL, apart[0], problem.decide_cycles),
        (CLAIRVOYANT_DWELL, apart[1], W),
    ):
        moves = np.flatnonzero(np.diff(found.sequences[title].choice)) + 1
        assert len(moves) >= 2
        assert min(np.diff([0, *moves])) * every == least


@pytest.mark.parametrize(
    "controller",
    [
        SETTINGS,
        replace(SETTINGS, order_delay_ms=25.0, order_lead_cycles=4),
        replace(SETTINGS, migration="cold"),
    ],
)
def test_its_orders_come_in_time(controller: ControllerSettings) -> None:
    problem = replace(two_nodes(4.0, TURNS), controller=controller)
    run = references(problem, realise(problem, 20)).runs[ORACLE]
    stamped = run.cycles["placement"].cast(str).to_list()
    assert "".join(stamped[::W]) == "AAAAAABBBBAABBBAAAAA"
    assert stamped[6 * W - 1 : 6 * W + 1] == ["A", "B"]


def test_drawn_episodes_are_known_and_bursts_are_not() -> None:
    known = two_nodes(4.0, (NodeDisturbance("A", stress_threads=1, episodes=EPISODES),))
    random = two_nodes(4.0)
    bursts = Bursts(every_ms=Constant(600.0), for_ms=Constant(600.0), threads=1)
    nodes = {**random.fabric.nodes, "A": replace(random.fabric.nodes["A"], bursts=bursts)}
    nodes["B"] = replace(random.fabric.nodes["B"], bursts=bursts)
    random = replace(random, fabric=replace(random.fabric, nodes=FrozenDict(nodes)))
    found = references(known, realise(known, 80))
    assert placements(found, ORACLE) == ["A"] + ["B"] * 79  # B is never disturbed
    found = references(random, realise(random, 80))
    assert placements(found, ORACLE) == ["A"] * 80


def test_each_cycle_has_the_set_that_was_drawn() -> None:
    items = (
        NodeDisturbance("A", stress_threads=1, episodes=EPISODES),
        NodeDisturbance("B", at_s=1.0, for_s=2.0, stress_threads=2),
    )
    problem = two_nodes(4.0, items)
    realisation = realise(problem, 80)
    sets, which = sets_of(problem, realisation)
    drawn = Drawing(problem, "given", seed=1, windows=80).episodes()
    assert len(drawn) > 5
    for cycle, at_ns in enumerate(realisation.release_ns[:-1].tolist()):
        on = {item.place for item in drawn if item.at_s <= at_ns / 1e9 < item.end_s}
        chosen = sets[which[cycle]]
        assert {item.place for item in chosen} == on
        assert all(item.at_s == 0 and item.for_s == math.inf for item in chosen)
    assert len(sets) == 4


def test_equal_disturbances_at_the_same_time_add_up() -> None:
    item = NodeDisturbance("A", at_s=0.5, for_s=1.0, stress_threads=1)
    problem = two_nodes(4.0, (item, replace(item, at_s=1.0)))
    sets, which = sets_of(problem, realise(problem, 20))
    always = NodeDisturbance("A", stress_threads=1)
    counts = {times: int((which == sets.index((always,) * times)).sum()) for times in range(3)}
    assert counts == {0: 50, 1: 100, 2: 50}


# ------------------------------------------------------------------------------- stretches


def test_a_stretch_costs_the_mean_of_its_cycles() -> None:
    problem = two_nodes(4.0, (NodeDisturbance("A", at_s=0.57, for_s=0.2, stress_threads=1),))
    realisation = realise(problem, 10)
    costs = expected_costs(problem, realisation, W)
    assert costs[:, 1] == pytest.approx([0.4] * 10)
    assert costs[:, 0] == pytest.approx([0.4] * 5 + [0.52, 0.8, 0.68] + [0.4] * 2)
    for decide_cycles in (1, 3, 7, 100):
        parts = expected_costs(problem, realisation, decide_cycles)
        assert len(parts) == -(-100 // decide_cycles)
        assert parts.sum(axis=0) == pytest.approx(costs.sum(axis=0))


def test_shorter_stretches_move_inside_a_window() -> None:
    spans = ("B", 0.0, 0.55), ("A", 0.55, 1.0), ("B", 1.55, 0.45)
    problem = two_nodes(4.0, tuple(NodeDisturbance(*span, stress_threads=1) for span in spans))
    realisation = realise(problem, 20)
    promised = []
    for decide_cycles, moves in ((10, [5, 16]), (5, [11, 31]), (1, [55, 155])):
        costs = expected_costs(problem, realisation, decide_cycles)
        plan, mean = planned(problem, realisation, costs, decide_cycles, 0)
        at = (np.flatnonzero(np.diff(plan.choice)) + 1).tolist()
        assert len(at) == 2
        if decide_cycles < 10:
            assert at == moves
        promised.append(mean)
    # Eighteen windows count; both moves are paid.
    assert promised[1:] == pytest.approx([0.4 + 0.6 / 18] * 2)


@pytest.mark.parametrize("decide_cycles", [10, 5, 4, 1])
def test_the_dwell_in_windows_holds_for_shorter_stretches(decide_cycles: int) -> None:
    turns = stressed(*(("AB"[k % 2], 3 * k, 3) for k in range(1, 9)))
    problem = two_nodes(4.0, turns, switching=0.05)
    realisation = realise(problem, 27)
    costs = expected_costs(problem, realisation, decide_cycles)
    for dwell_cycles in (0, 2 * W, 33, 5 * W):
        plan, _ = planned(problem, realisation, costs, decide_cycles, dwell_cycles)
        moves = np.flatnonzero(np.diff(plan.choice)) + 1
        assert len(moves) >= 2
        assert min(np.diff([0, *moves])) * decide_cycles >= dwell_cycles + decide_cycles


def test_nothing_is_planned_while_the_controller_is_down() -> None:
    outage = NodeDisturbance("C", at_s=0.55, for_s=0.6, down=True)
    problem = two_nodes(4.0, (*TURNS, outage), switching=0.1)
    found = references(problem, realise(problem, 20))
    assert placements(found, ORACLE) == ["A"] * 5 + ["B"] * 10 + ["A"] * 5


# ----------------------------------------------------------------------------------- ramps


def test_a_ramp_is_priced_in_equal_steps() -> None:
    ramp = NodeDisturbance("A", at_s=0.0, for_s=8.0, ramp_s=4.0, stress_threads=8)
    problem = two_nodes(4.0, (ramp,))
    sets, which = sets_of(problem, realise(problem, 80))
    threads = [
        sum(item.stress_threads for item in items if isinstance(item, NodeDisturbance))
        for items in sets
    ]
    assert sorted(threads) == list(range(9))
    by_cycle = np.array(threads)[which]
    # 0.5 s a step; each level is nearest for a quarter of a second before and after its instant.
    assert by_cycle[[0, 24, 26, 74, 76, 399, 400, 774, 776]].tolist() == [0, 0, 1, 1, 2, 8, 8, 1, 0]
    assert RAMP_PRICES == 8


TABLE = TraceTable("measured.csv", {"delay": np.array([8.0, 16.0])})


@pytest.mark.parametrize(
    ("full", "quarter"),
    [
        (Constant(8.0), Constant(2.0)),
        (Uniform(4.0, 8.0), Uniform(1.0, 2.0)),
        (Normal(8.0, 4.0, 1.0), Normal(2.0, 1.0, 0.25)),
        (LogNormal(8.0, 0.5), LogNormal(2.0, 0.5)),
        (Gamma(8.0, 0.5), Gamma(2.0, 0.5)),
        (Exponential(8.0), Exponential(2.0)),
        (AR1(8.0, 0.5, 0.9), AR1(2.0, 0.5, 0.9)),
        (
            Trace(TABLE, "delay"),
            Trace(replace(TABLE, columns={"delay": np.array([2.0, 4.0])}), "delay"),
        ),
    ],
)
def test_all_parts_of_a_link_s_fault_grow_along_a_ramp(full: Process, quarter: Process) -> None:
    ramp = LinkDisturbance(
        "A", "B", for_s=8.0, ramp_s=4.0, add_delay_ms=full, loss=0.4, rate_mbps=100.0
    )
    problem = with_links((ramp,), rate_mbps=400.0)
    sets, which = sets_of(problem, realise(problem, 80))
    (item,) = sets[which[100]]
    assert isinstance(item, LinkDisturbance)
    assert item.add_delay_ms == quarter
    assert item.loss == pytest.approx(0.1)
    # The time of a bit is a quarter of the way from 1/400 to 1/100.
    assert item.rate_mbps == pytest.approx(1 / (0.75 / 400 + 0.25 / 100))
    assert sets[which[400]] == (replace(ramp, for_s=math.inf, ramp_s=0.0),)


def test_a_ramp_of_a_link_without_a_rate_has_prices() -> None:
    delay = LinkDisturbance("A", "B", for_s=8.0, ramp_s=4.0, add_delay_ms=Constant(8.0))
    slow = replace(delay, add_delay_ms=None, rate_mbps=100.0)
    problem = with_links((delay, slow))
    assert expected_costs(problem, realise(problem, 80), W) == pytest.approx(0.4)


# ------------------------------------------------------------------------------------ sets


def test_beyond_the_largest_number_of_sets_the_most_similar_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    items: tuple[Disturbance, ...] = (
        NodeDisturbance("A", at_s=1.0, for_s=3.0, stress_threads=1),
        NodeDisturbance("B", at_s=3.5, for_s=0.5, stress_threads=1),
        NodeDisturbance("C", at_s=4.0, for_s=0.2, stress_threads=1),
    )
    problem = two_nodes(4.0, items)
    realisation = realise(problem, 80)
    whole, which = sets_of(problem, realisation)
    assert len(whole) == 4
    monkeypatch.setattr(oracle, "MOST_SETS", 2)
    some, nearest = sets_of(problem, realisation)
    # Nothing is on for 4.8 s, A alone for 2.5 s, A and B for 0.5 s, C alone for 0.2 s.
    names = ["".join(item.place for item in some[i]) for i in nearest[[50, 200, 360, 410, 600]]]
    assert names == ["", "A", "A", "", ""]
    for cycle in (50, 200, 600):
        assert some[nearest[cycle]] == whole[which[cycle]]


def test_an_undisturbed_cell_has_one_set() -> None:
    problem = make_problem()
    realisation = draw(problem, scenario="baseline", seed=1, windows=12)
    sets, which = sets_of(problem, realisation)
    assert (sets, set(which.tolist())) == ([()], {0})
    costs = expected_costs(problem, realisation, problem.window_cycles)
    assert costs == pytest.approx(np.repeat(costs[:1], 12, axis=0))
    other = draw(problem, scenario="baseline", seed=2, windows=12)
    assert (expected_costs(problem, other, problem.window_cycles) == costs).all()


# -------------------------------------------------------------------------- dynamic scenarios


@pytest.mark.parametrize("scenario", ["bursts", "flapping", "step", "drift", "mixture"])
def test_it_is_no_dearer_than_the_best_static_placement(scenario: str) -> None:
    differences = []
    for seed in range(1, 4):
        found = references(DYNAMIC, draw(DYNAMIC, scenario=scenario, seed=seed, windows=150))
        differences.append(found.costs[ORACLE] - found.costs[found.best_static])
        assert found.costs[ORACLE] <= found.costs[ORACLE_DWELL] + 0.05
        assert found.costs[ORACLE] == mean_cost(found.runs[ORACLE])
    assert fmean(differences) <= 2 * stdev(differences) / math.sqrt(3)
    if scenario != "flapping":
        assert fmean(differences) < -0.05
