"""References: what was planned is what is simulated, and regret may be negative."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from polars.testing import assert_frame_equal

from dwell.errors import SimulationError
from dwell.model import (
    Caps,
    Constant,
    ControllerSettings,
    Execution,
    Fabric,
    Node,
    NodeDisturbance,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Scenario,
    Targets,
    Task,
    Weights,
)
from dwell.sim import Realisation, draw, simulate_realisation
from dwell.study.reference import (
    CLAIRVOYANT,
    CLAIRVOYANT_DWELL,
    REFERENCES,
    few_misses,
    mean_cost,
    references,
    regret,
    share_kept,
    window_costs,
)
from dwell.study.script import Script
from dwell.study.summary import summarise
from tests.cells.late_cycles import late_problem, late_run, without_late_cycles
from tests.cells.once import once
from tests.cells.small import make_problem

W = 10
SETTINGS = ControllerSettings(on="C", min_dwell=1)


def two_nodes(
    exec_ms: float,
    scenario: Scenario = (),
    *,
    candidates: dict[str, str] | None = None,
    switching: float = 0.3,
    controller: ControllerSettings = SETTINGS,
) -> Problem:
    """Return a cell of one task that takes `exec_ms` of its period of 10 ms, on A or on B."""
    nodes = {name: Node(name, "edge", 1) for name in ("A", "B", "C")}
    on = {name: Execution(Constant(exec_ms)) for name in ("A", "B")}
    # A cold migration takes more than three windows.
    work = Task("work", on, start_ms=350.0)
    placed = candidates or {"A": "A", "B": "B"}
    return Problem(
        name="two-nodes",
        pipeline=Pipeline(tasks={"work": work}, flows=(), period_ms=10.0, deadline_ms=10.0),
        fabric=Fabric(nodes=nodes, links={}),
        candidates={name: Placement({"work": node}) for name, node in placed.items()},
        objective=Objective(
            weights=Weights(latency=1, violations=3, robot=0, edge=0, switching=switching),
            targets=Targets(latency_ms=10.0),
            caps=Caps(latency_ms=1000.0, utilisation=1.0),
            tiers=dict.fromkeys(nodes, "edge"),
        ),
        scenarios={"given": scenario},
        controller=once(controller, W),
        window_cycles=W,
        warmup_windows=2,
    )


def realise(problem: Problem, windows: int, scenario: str = "given") -> Realisation:
    return draw(problem, scenario=scenario, seed=1, windows=windows)


def stressed(*spans: tuple[str, int, int]) -> Scenario:
    """Stress a node in whole windows: node, first window, number of windows."""
    return tuple(
        NodeDisturbance(node, at_s=first * 0.1, for_s=count * 0.1, stress_threads=1)
        for node, first, count in spans
    )


TURNS = stressed(("B", 0, 6), ("A", 6, 4), ("B", 10, 2), ("A", 12, 3), ("B", 15, 5))


def test_a_sequence_follows_the_better_node() -> None:
    problem = two_nodes(4.0, TURNS)
    found = references(problem, realise(problem, 20))
    free = found.runs[CLAIRVOYANT].windows["placement"].to_list()
    assert free == ["A"] * 6 + ["B"] * 4 + ["A"] * 2 + ["B"] * 3 + ["A"] * 5
    # J is 0.4 alone, and 0.8 with stress on the node, where a job takes twice its time.
    assert found.costs[CLAIRVOYANT] == pytest.approx(0.4 + 4 * 0.3 / 18)
    assert found.costs["A"] == pytest.approx((0.8 * 7 + 0.4 * 11) / 18)
    assert found.name == CLAIRVOYANT
    assert found.cost == found.costs[CLAIRVOYANT]
    assert found.best_static == "A"


def test_promises_are_kept_where_nothing_is_carried_over() -> None:
    problem = two_nodes(4.0, TURNS)
    found = references(problem, realise(problem, 20))
    assert found.promised.keys() == found.runs.keys() == set(REFERENCES)
    for name, promised in found.promised.items():
        assert found.costs[name] == pytest.approx(promised, rel=1e-12)


@pytest.mark.parametrize(
    "controller",
    [
        SETTINGS,
        replace(SETTINGS, order_delay_ms=25.0, order_lead_cycles=4),
        replace(SETTINGS, migration="cold"),
    ],
)
def test_plans_are_simulated_as_they_are_whatever_orders_take(
    controller: ControllerSettings,
) -> None:
    problem = two_nodes(4.0, TURNS, controller=controller)
    found = references(problem, realise(problem, 20))
    names = tuple(problem.candidates)
    for title, plan in found.sequences.items():
        run = found.runs[title]
        assert run.windows["placement"].to_list() == [names[i] for i in plan.choice]
        assert run.windows["first_cycle"].to_list() == [W * k for k in range(20)]
        assert run.decisions["migrated"].sum() == 4


def test_the_dwell_is_that_of_the_problem() -> None:
    spans = [("AB"[k % 4 == 1], k, 2) for k in range(3, 15, 2)]
    problem = two_nodes(4.0, stressed(("B", 0, 3), *spans), switching=0.1)
    realisation = realise(problem, 15)

    def moves(min_dwell: int) -> list[int]:
        controller = replace(problem.controller, min_dwell=min_dwell)
        found = references(replace(problem, controller=controller), realisation)
        free, bound = (found.sequences[title].choice for title in (CLAIRVOYANT, CLAIRVOYANT_DWELL))
        assert (np.flatnonzero(np.diff(free)) + 1).tolist() == [3, 5, 7, 9, 11, 13]
        return [int(k) + 1 for k in np.flatnonzero(np.diff(bound))]

    assert moves(1) == [3, 5, 7, 9, 11, 13]
    assert min(np.diff([0, *moves(2)])) >= 3
    assert moves(20) == []


def test_taking_turns_beats_two_overloaded_nodes_and_the_reference() -> None:
    # 12 ms of work in every 10 ms: alone, either node falls behind for ever. In turns, each has
    # time to catch up, which nobody can know who has seen them alone.
    problem = two_nodes(12.0)
    realisation = realise(problem, 20)
    found = references(problem, realisation)
    assert found.name == "A"
    turns = Script([("A", "B")[k % 2] for k in range(20)], problem, realisation)
    run = simulate_realisation(problem, realisation, policy=turns)
    assert regret(mean_cost(run), found.cost) < -0.4
    assert regret(mean_cost(run), found.cost) == mean_cost(run) / found.costs["A"] - 1
    assert regret(found.cost, found.cost) == 0.0


def test_a_node_that_is_left_recovers_and_the_promise_is_too_dear() -> None:
    # Alone, A is behind for ever after its stress. In the sequence it has nothing to do from
    # window 1 until B is behind, too.
    problem = two_nodes(9.0, stressed(("A", 0, 4), ("B", 8, 4)))
    found = references(problem, realise(problem, 20))
    plan = found.sequences[CLAIRVOYANT].choice.tolist()
    assert (plan[0], plan[1:8], plan[-1]) == (0, [1] * 7, 0)
    assert found.costs[CLAIRVOYANT] < 0.5 * found.promised[CLAIRVOYANT]


def test_statics_are_the_runs_of_static_policies() -> None:
    problem = make_problem()
    realisation = realise(problem, 12, "network-impairment")
    found = references(problem, realisation)
    assert tuple(found.statics) == tuple(problem.candidates)
    for name, run in found.statics.items():
        usual = simulate_realisation(problem, realisation, policy=name)
        assert_frame_equal(run.windows, usual.windows)
        row = summarise(usual, problem, {"seed": 1}).row
        assert found.costs[name] == mean_cost(usual) == row["cost"]
    assert tuple(found.costs) == (*problem.candidates, *REFERENCES)
    asked = (*problem.candidates, CLAIRVOYANT, CLAIRVOYANT_DWELL)
    assert found.cost == min(found.costs[name] for name in asked)


@pytest.mark.parametrize("scenario", ["baseline", "robot-cpu-stress", "network-impairment"])
def test_no_policy_beats_it_where_little_is_carried_over(scenario: str) -> None:
    problem = make_problem(warmup_windows=0)
    realisation = realise(problem, 40, scenario)
    found = references(problem, realisation)
    for policy in ("dtp", "latency-first", "work-function"):
        run = simulate_realisation(problem, realisation, policy=policy)
        assert regret(mean_cost(run), found.cost) >= 0.0


def test_the_warm_up_is_free_but_not_wasted() -> None:
    # B is better from window 1 on, but not by what a move costs that is paid for.
    problem = two_nodes(4.0, stressed(("A", 1, 9)), switching=3.7)
    problem = replace(problem, warmup_windows=3)
    found = references(problem, realise(problem, 10))
    assert found.sequences[CLAIRVOYANT].choice.tolist() == [0] + [1] * 9
    assert found.name == "B"
    assert found.costs["B"] == found.costs[CLAIRVOYANT]


def test_windows_that_the_controller_does_not_see_have_their_price() -> None:
    outage = NodeDisturbance("C", at_s=0.55, for_s=0.6, down=True)
    down = two_nodes(12.0, (outage,))
    # The same cell with its controller where nothing happens.
    up = two_nodes(12.0, (outage,), controller=replace(SETTINGS, on="A"))
    realisation = realise(down, 16)
    for name in down.candidates:
        unseen, seen = (
            simulate_realisation(problem, realisation, policy=name) for problem in (down, up)
        )
        assert unseen.windows["cost"].null_count() == 6
        assert window_costs(unseen, down, realisation).tolist() == seen.windows["cost"].to_list()
        assert window_costs(seen, up, realisation).tolist() == seen.windows["cost"].to_list()


def test_nothing_moves_while_the_controller_is_down() -> None:
    # No decision at the closes of windows 5 to 10. Of the windows before the next move A is
    # stressed in 6 to 9, B in 10 and 11 (and in 5): B costs less, and is taken in time.
    outage = NodeDisturbance("C", at_s=0.55, for_s=0.6, down=True)
    problem = two_nodes(4.0, (*TURNS, outage), switching=0.1)
    found = references(problem, realise(problem, 20))
    run = found.runs[CLAIRVOYANT]
    assert run.windows["placement"].to_list() == ["A"] * 5 + ["B"] * 10 + ["A"] * 5
    assert run.windows["cost"].is_null().to_numpy().nonzero()[0].tolist() == list(range(5, 11))
    assert found.costs[CLAIRVOYANT] == pytest.approx(found.promised[CLAIRVOYANT], rel=1e-12)


def test_equal_placements_one_candidate_and_one_window() -> None:
    twins = two_nodes(4.0, TURNS, candidates={"A": "A", "also-A": "A"})
    for initial in (0, 1):
        settings = replace(SETTINGS, initial=tuple(twins.candidates)[initial])
        found = references(replace(twins, controller=settings), realise(twins, 20))
        assert found.sequences[CLAIRVOYANT].choice.tolist() == [initial] * 20
        assert found.name == "A"
    alone = two_nodes(4.0, TURNS, candidates={"A": "A"})
    found = references(alone, realise(alone, 20))
    assert found.cost == found.costs["A"] == found.costs[CLAIRVOYANT]
    once = replace(alone, warmup_windows=0)
    found = references(once, realise(once, 1))
    assert found.sequences[CLAIRVOYANT_DWELL].choice.tolist() == [0]


def test_what_cannot_be_compared_is_refused() -> None:
    problem = two_nodes(4.0)
    with pytest.raises(SimulationError, match="ask for more windows"):
        references(problem, realise(problem, 2))
    blind = two_nodes(4.0, (NodeDisturbance("C", down=True),))
    with pytest.raises(SimulationError, match="controller saw"):
        references(blind, realise(blind, 5))
    for name in REFERENCES:
        clash = two_nodes(4.0, candidates={name: "A", "B": "B"})
        with pytest.raises(SimulationError, match=f"{name} has the name of a reference"):
            references(clash, realise(clash, 5))


def test_what_is_kept_is_counted_where_the_reference_keeps_it() -> None:
    # A job takes 5.5 of 10 ms, and 11 with stress on its node: then it is late.
    problem = two_nodes(5.5, TURNS)
    found = references(problem, realise(problem, 20))
    assert found.name == CLAIRVOYANT
    assert found.run is found.runs[CLAIRVOYANT]
    asked = few_misses(found.run, problem)
    assert share_kept(asked, asked) == 1.0
    # The reference is late in no window (but where it moves); A is from 6 to 9 and from 12 to 14.
    reference = found.run.windows["violation_rate"].to_numpy()[2:] <= 0.05
    alone = found.statics["A"].windows["violation_rate"].to_numpy()[2:] <= 0.05
    assert 0 < alone[reference].mean() < 1
    mine = few_misses(found.statics["A"], problem)
    assert share_kept(mine, asked) == pytest.approx(alone[reference].mean())
    # Runs may end some cycles apart.
    assert share_kept(mine[:-1], asked) == share_kept(mine[:-1], asked[:-1])
    # Cycles after the last window count for neither run.
    late, run = late_problem(), late_run()
    without = without_late_cycles(run)
    assert few_misses(run, late).tolist() == few_misses(without, late).tolist()
    # Nothing is asked where the reference keeps nothing.
    assert share_kept(mine, few_misses(found.run, problem, limit=-1.0)) == 1.0
