"""What was done to a run: as it was drawn, as it was played, and where neither is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import dwell
from dwell.model import Constant, Episodes, Exponential, NodeDisturbance, Trace, TraceTable
from dwell.model.fleet import Fleet, FleetEntry
from dwell.sim.fleet import drawn, phased
from dwell.study.drawn_disturbances import disturbances_of, drawn_disturbances
from tests.cells.small import make_problem

WIND = NodeDisturbance(
    "R1", stress_threads=2, episodes=Episodes("w", Exponential(2.0), Constant(1.0))
)
STEADY = NodeDisturbance("E", at_s=1.0, for_s=2.0, stress_threads=1)


def test_episodes_of_a_run_are_those_that_its_seed_draws() -> None:
    problem = replace(make_problem(), scenarios={"windy": (WIND, STEADY)})
    run = dwell.simulate(problem, scenario="windy", policy="LOC", seed=4, windows=40)
    found = disturbances_of(run)
    assert found == drawn_disturbances(problem, "windy", 4, 40)
    assert STEADY in found
    gusts = [one for one in found if isinstance(one, NodeDisturbance) and one.node == "R1"]
    assert len(gusts) > 1
    assert {(one.for_s, one.episodes) for one in gusts} == {(1.0, None)}
    assert found != drawn_disturbances(problem, "windy", 5, 40)


def test_cells_of_a_fleet_draw_their_own_episodes_and_the_first_those_of_shared_nodes() -> None:
    scenarios = {"windy": (WIND, replace(WIND, node="E"))}
    problem = replace(make_problem(), scenarios=scenarios)
    fleet = Fleet("two", (FleetEntry(problem, 2, scenario="windy"),), ("E",), coordination="none")
    runs = dwell.simulate_fleet(fleet, policy="LOC", seed=4, windows=40).cells
    problems = dict(zip(runs, phased(fleet, 4), strict=True))
    for name, realisation in drawn(fleet, problems, 4, fleet.duration_ns(40)).items():
        changes = {(change.node, change.at_ns) for change in realisation.node_changes}
        met = disturbances_of(runs[name])
        begins = {
            (one.node, round(one.at_s * 1e9)) for one in met if isinstance(one, NodeDisturbance)
        }
        assert begins
        assert begins <= changes


def test_what_was_played_is_believed() -> None:
    problem = replace(make_problem(), scenarios={"s": (STEADY,)})
    run = dwell.simulate(problem, scenario="s", policy="LOC", seed=1, windows=20)
    told = {**run.meta["problem"]["scenarios"]["s"][0], "at_s": 1.5}
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    played = dwell.Run({**run.meta, "played": [told]}, tables)
    assert disturbances_of(played) == (replace(STEADY, at_s=1.5),)


def test_episodes_at_recorded_times_that_a_run_does_not_have_are_left_out() -> None:
    table = TraceTable("gone.csv", {"s": np.array([1.0, 2.0])})
    recorded = replace(WIND, episodes=Episodes("w", Trace(table, "s"), Constant(1.0)))
    problem = replace(make_problem(), scenarios={"windy": (recorded, STEADY)})
    run = dwell.simulate(problem, scenario="windy", policy="LOC", seed=1, windows=20)
    assert disturbances_of(run) == (STEADY,)
