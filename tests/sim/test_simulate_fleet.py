"""Fleets: cells that share nodes, each decided on by its own controller."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from polars.testing import assert_frame_equal

import dwell
from dwell import simulate_fleet
from dwell.cost import hamming
from dwell.errors import DwellError
from dwell.model import NodeDisturbance, Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun

EXAMPLES = Path(__file__).parents[2] / "examples"
TABLES = ("cycles", "windows", "decisions")


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load(EXAMPLES / "canonical.yaml")


def hall(problem: Problem, count: int, scenario: str = "baseline", **more: object) -> Fleet:
    entry = FleetEntry(problem, count, scenario)
    settings = {"phases": "sync", "coordination": "none", **more}
    return Fleet("hall", (entry,), ("E",), **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("scenario", ["baseline", "robot-cpu-stress", "edge-cpu-stress"])
@pytest.mark.parametrize(
    ("policy", "guard"), [("dtp", False), ("cusum+corrected", False), ("dtp+shadow", True)]
)
def test_a_fleet_of_one_is_that_cell(
    canonical: Problem, scenario: str, policy: str, guard: bool
) -> None:
    alone = dwell.simulate(
        canonical, scenario=scenario, policy=policy, seed=3, windows=12, guard=guard, jobs=True
    )
    fleet = simulate_fleet(
        hall(canonical, 1, scenario), policy=policy, seed=3, windows=12, guard=guard, jobs=True
    )
    (run,) = fleet.cells.values()
    for table in (*TABLES, "jobs"):
        assert_frame_equal(getattr(run, table), getattr(alone, table))
    assert {**run.meta, "problem": None} == {**alone.meta, "problem": None}


def test_cells_that_share_nothing_are_as_alone(canonical: Problem) -> None:
    fleet = replace(hall(canonical, 3, "robot-cpu-stress"), shared=())
    together = simulate_fleet(fleet, policy="cusum+corrected", seed=1, windows=8)
    first = dwell.simulate(
        canonical, scenario="robot-cpu-stress", policy="cusum+corrected", seed=1, windows=8
    )
    for table in TABLES:
        assert_frame_equal(getattr(together.cells["canonical-01"], table), getattr(first, table))
    latencies = [run.cycles["latency_ns"].to_list() for run in together.cells.values()]
    assert latencies[0] != latencies[1] != latencies[2]


def test_the_edge_is_one_for_all(canonical: Problem) -> None:
    """As long as all of them are there."""
    few, many = (
        simulate_fleet(hall(canonical, count), policy="SO", estimator="profile", windows=6)
        for count in (2, 10)
    )
    for run in (few, many):
        shares = [one.windows["u_E"].to_list() for one in run.cells.values()]
        assert all(share == pytest.approx(shares[0], abs=0.01) for share in shares)
    mean = [float(run.windows["u_E"].mean()) for run in (few, many)]  # type: ignore[arg-type]
    assert mean[1] > 2 * mean[0]
    rates = [float(run.windows["violation_rate"].mean()) for run in (few, many)]  # type: ignore[arg-type]
    assert rates[1] > rates[0]


def test_tables_of_all_have_the_cells_name(canonical: Problem) -> None:
    fleet = simulate_fleet(hall(canonical, 2), policy="LOC", windows=5)
    assert fleet.windows.group_by("cell", maintain_order=True).len().rows() == [
        ("canonical-01", 5),
        ("canonical-02", 5),
    ]
    assert fleet.decisions.columns[0] == "cell"
    assert fleet.windows.height == 10


def test_phases_are_of_the_cells(canonical: Problem) -> None:
    period_ms = canonical.pipeline.period_ms

    def phases(how: object) -> list[float]:
        fleet = simulate_fleet(hall(canonical, 4, phases=how), policy="LOC", windows=5)
        first = [run.cycles["release_ns"][0] / 1e6 for run in fleet.cells.values()]
        return [float(one) for one in first]

    assert phases("sync") == [0.0] * 4
    assert phases("even") == pytest.approx([period_ms * i / 4 for i in range(4)])
    assert phases((0.0, 5.0, 10.0, 30.0)) == pytest.approx([0.0, 5.0, 10.0, 30.0])
    drawn = phases("random")
    assert len(set(drawn)) == 4
    assert all(0 <= phase < period_ms for phase in drawn)
    assert phases("random") == drawn


@pytest.mark.parametrize(
    ("of_cell", "of_entry", "expected"),
    [
        ("phase_ms: 0", "", 0.0),
        ("phase_ms: 5", "", 5.0),
        ("phase_ms: 5", ", phase_ms: 0", 0.0),
        ("phase_ms: 0", ", phase_ms: 5", 5.0),
        ("", "", 10.0),
    ],
)
def test_a_phase_of_a_cell_is_kept_and_0_is_a_phase(
    tmp_path: Path, of_cell: str, of_entry: str, expected: float
) -> None:
    (tmp_path / "cell.yaml").write_text(
        "dwell: 1\nperiod_ms: 20\nnodes: {E: {tier: edge}}\n"
        f"tasks: {{a: {{on: {{E: {{exec_ms: 2}}}}}}}}\ncandidates: {{SO: {{}}}}\n{of_cell}\n"
    )
    (tmp_path / "fleet.yaml").write_text(
        "dwell-fleet: 1\nname: two\nphases: [10, 10]\n"
        f"cells: [{{cell: cell.yaml, count: 2{of_entry}}}]\n"
    )
    fleet = dwell.load_fleet(tmp_path / "fleet.yaml")
    result = simulate_fleet(fleet, windows=2, coordination="none")
    assert list(result.phases_ms.values()) == [expected] * 2
    first_ns = [run.cycles["release_ns"][0] for run in result.cells.values()]
    assert first_ns == [round(expected * 1e6)] * 2
    # Runs of the fleet read their cells again with the same phase.
    for name, run in result.cells.items():
        assert run.problem.pipeline.phase_ms == result.phases_ms[name]


def test_without_coordination_a_fleet_herds_and_chance_breaks_it(canonical: Problem) -> None:
    """Robots that are stressed at once all leave at once, and come back at once."""

    def moves(coordination: str) -> tuple[int, int]:
        fleet = simulate_fleet(
            hall(canonical, 12, "robot-cpu-stress", coordination=coordination),
            policy="dtp",
            estimator="shadow",
            windows=30,
        )
        moved = fleet.decisions.filter(pl.col("migrated"))
        return moved.height, int(moved.group_by("window").len()["len"].max() or 0)  # type: ignore[arg-type]

    alone, by_chance = moves("none"), moves("random")
    assert alone[1] == 12
    assert by_chance[1] < 12
    assert by_chance[0] < alone[0]


def crowded(problem: Problem, *more: NodeDisturbance) -> Problem:
    """Return a cell with stressed robots and an edge of four cores that nobody else uses."""
    nodes = dict(problem.fabric.nodes)
    nodes["E"] = replace(nodes["E"], cores=4, bursts=None)
    stress = NodeDisturbance(node="R1", stress_threads=4)
    fabric = replace(problem.fabric, nodes=nodes)
    return replace(problem, fabric=fabric, scenarios={"change": (stress, *more)})


def on_edge(run: FleetRun) -> list[int]:
    """How many cells are on the edge at each window."""
    placed = run.windows.group_by("window").agg((pl.col("placement") != "LOC").sum())
    return [int(count) for _, count in placed.sort("window").rows()]


def test_under_a_ledger_each_move_is_worth_what_it_costs_and_none_goes_back(
    canonical: Problem,
) -> None:
    problem = crowded(canonical)
    fleet = hall(problem, 6, "change", phases="even", coordination="ledger")
    run = simulate_fleet(fleet, policy="dtp", estimator="corrected", windows=20)
    moved = run.decisions.filter("migrated")
    objective, least = problem.objective, problem.controller.min_improvement
    # The moves of a round are a set: together they are worth what all of them cost.
    owed: defaultdict[tuple[int, float, float], float] = defaultdict(float)
    for row in moved.to_dicts():
        here, there = (problem.candidates[row[name]] for name in ("incumbent", "placement"))
        of_round = row["round"], row["phi_before"], row["phi_after"]
        owed[of_round] += least + objective.weights.switching * hamming(there, here)
    assert all(before - after > due for (_, before, after), due in owed.items())
    assert moved["round"].n_unique() == len(owed)
    # The last windows of cells that have moved are not whole.
    counts = on_edge(run)[:-2]
    # All cells on HYB are the best of all placements.
    assert counts[-1] == 6
    assert counts == sorted(counts)
    refused = run.decisions.filter(pl.col("refused").is_not_null())
    assert not refused["migrated"].any()
    assert refused["refused"].str.contains("ledger: Φ would|cap of canonical-0").all()


def _append(to: list[tuple[int, int]], done: int, total: int) -> None:
    to.append((done, total))


@pytest.mark.parametrize("phases", ["random", "even"])
def test_seeds_of_a_fleet_share_one_table_of_loads(canonical: Problem, phases: str) -> None:
    cell = replace(canonical, name=f"alone-{phases}")
    fleet = hall(cell, 3, phases=phases, coordination="ledger")
    windows = 6 * len(fleet.cells)
    totals: list[set[int]] = []
    for seed in (1, 2, 3):
        told: list[tuple[int, int]] = []
        simulate_fleet(fleet, seed=seed, windows=6, progress=partial(_append, told))
        totals.append({total for _, total in told})
    # Levels of the table are counted before windows.
    assert [found == {windows} for found in totals] == [False, True, True]


def test_a_ledger_of_cells_that_never_move_makes_no_table_of_loads(canonical: Problem) -> None:
    cell = replace(canonical, name="fixed")
    fleet = hall(cell, 3, policy="SO", coordination="ledger")
    told: list[tuple[int, int]] = []
    run = simulate_fleet(fleet, windows=6, progress=partial(_append, told))
    assert {total for _, total in told} == {6 * len(fleet.cells)}
    assert run.decisions["round"].null_count() == 0


def test_when_the_edge_is_back_nobody_tramples_it(canonical: Problem) -> None:
    problem = crowded(canonical, NodeDisturbance(node="E", at_s=60.0, for_s=8.0, down=True))
    # No guard moves a cell onto the edge because its robot is slow.
    problem = replace(problem, controller=replace(problem.controller, fallbacks=("LOC",)))
    fleet = hall(problem, 6, "change", phases="even", coordination="ledger")
    run = simulate_fleet(fleet, policy="dtp", estimator="corrected", windows=36, guard=True)
    counts = on_edge(run)
    assert counts[16] > counts[19] == 0
    assert counts[20:] == sorted(counts[20:])
    assert counts[28] >= counts[16]
    by_guard = run.decisions.filter((pl.col("reason") == "guard") & pl.col("migrated"))
    assert by_guard["window"].max() == 18
    late = pl.concat([one.cycles for one in run.cells.values()])
    seconds = (pl.col("release_ns") / 10_000_000_000).floor()
    missed = dict(late.group_by(seconds).agg(pl.col("missed").mean()).rows())
    # At first all are on their robots, as they were in the first ten seconds.
    assert missed[7] <= missed[0]
    assert missed[7] > missed[8] > missed[9] > missed[10]
    assert missed[10] <= missed[5]


def test_cells_take_turns_in_sending_shadows_to_the_edge(canonical: Problem) -> None:
    fleet = hall(crowded(canonical), 4, "change", phases="even", coordination="ledger")
    run = simulate_fleet(fleet, policy="LOC", estimator="shadow", windows=12)
    alone = simulate_fleet(
        hall(crowded(canonical), 1, "change"), policy="LOC", windows=12, estimator="shadow"
    )
    sent = run.windows.group_by("window").agg(pl.col("shadow_cycles").sum())["shadow_cycles"].max()
    most = alone.windows["shadow_cycles"].max()
    assert 0 < int(str(sent)) <= int(str(most)) + 2
    assert all(one.windows["shadow_cycles"].sum() > 0 for one in run.cells.values())


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"phases": "evn"}, "phases: 'evn' is not allowed.*did you mean 'even'?"),
        ({"phases": [1.0, 2.0, 3.0]}, "phases: 3 phases for 2 cells; give one for each"),
        ({"coordination": "legder"}, "coordination: 'legder' is not allowed.*none, random, ledger"),
        ({"policy": "dpt"}, "unknown policy 'dpt'; did you mean 'dtp'?"),
        ({"estimator": "corected"}, "unknown estimator 'corected'; did you mean 'corrected'?"),
        ({"windows": 0}, "windows is 0"),
    ],
)
def test_what_is_unknown_is_told(canonical: Problem, given: dict[str, Any], told: str) -> None:
    with pytest.raises(DwellError, match=told):
        simulate_fleet(hall(canonical, 2), **{"windows": 3, **given})


@pytest.mark.parametrize("coordination", ["none", "random", "ledger"])
@pytest.mark.parametrize("policy", ["SO", "dtp"])
def test_a_fleet_of_one_may_be_coordinated(
    canonical: Problem, policy: str, coordination: str
) -> None:
    fleet = hall(canonical, 1, coordination=coordination)
    run = simulate_fleet(fleet, policy=policy, estimator="profile", windows=7)
    assert 6 <= run.decisions.height <= 7
    rounds = run.decisions["round"]
    assert (rounds.null_count() == 0) == (coordination == "ledger")
    assert {"phi_before", "phi_after"} <= set(run.decisions.columns)
