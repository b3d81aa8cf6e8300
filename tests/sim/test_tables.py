"""Tables of a run: what they promise, on the example cells under every policy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import polars as pl
import pytest

import dwell
from dwell.errors import RunError
from dwell.kernels.realisation import NodeChange
from dwell.model import Constant, Execution, Node, Problem, Task
from dwell.model.fleet import Fleet, FleetEntry
from tests.cells.generated import MS, make_problem, make_realisation
from tests.cells.late_cycles import CLOSED, DRAWN, W, late_run
from tests.cells.two_nodes import Script, two_nodes


def runs_of(cells: Mapping[str, Problem]) -> list[tuple[Problem, dwell.Run]]:
    """Return a run of every cell and scenario under two policies."""
    return [
        (problem, dwell.simulate(problem, scenario=scenario, policy=policy, seed=3, windows=15))
        for problem in cells.values()
        for scenario in problem.scenarios
        for policy in ("dtp", "latency-first")
    ]


def test_every_cycle_is_done_lost_or_in_flight(cells: Mapping[str, Problem]) -> None:
    for problem, run in runs_of(cells):
        # Orders take time: the last window may be incomplete.
        count = run.windows["first_cycle"][-1] + problem.window_cycles
        assert 14 * problem.window_cycles <= count <= 15 * problem.window_cycles
        assert run.cycles["cycle"].to_list() == list(range(run.cycles.height))
        assert (run.cycles["release_ns"].diff().drop_nulls() > 0).all()
        cycles, after = run.cycles[:count], run.cycles[count:]
        assert after["lead"].all()
        assert not after["missed"].any()
        done = cycles["outcome"] == "done"
        assert (cycles["latency_ns"].is_not_null() == done).all()
        assert cycles.filter(~done)["missed"].all()
        deadline_ns = round(problem.pipeline.deadline_ms * MS)
        assert cycles.filter(pl.col("latency_ns") > deadline_ns)["missed"].all()
        # Nothing hangs: what is in flight was released near the end.
        flying = cycles.filter(pl.col("outcome") == "in_flight")["cycle"]
        assert (flying >= count - 2 * problem.window_cycles).all()


def test_latency_is_compute_queue_and_network(cells: Mapping[str, Problem]) -> None:
    for _, run in runs_of(cells):
        parts = run.cycles.select("compute_ns", "queue_ns", "network_ns")
        done = run.cycles.filter(pl.col("outcome") == "done")
        assert (
            done["compute_ns"] + done["queue_ns"] + done["network_ns"] == done["latency_ns"]
        ).all()
        assert (parts.min_horizontal().drop_nulls() >= 0).all()
        lost = run.cycles.filter(pl.col("outcome") != "done")
        nulls = lost.select("latency_ns", "compute_ns", "queue_ns", "network_ns").null_count()
        assert set(nulls.row(0)) == {lost.height}


def test_windows_say_what_their_cycles_say(cells: Mapping[str, Problem]) -> None:
    for problem, run in runs_of(cells):
        width = problem.window_cycles
        for row in run.windows.iter_rows(named=True):
            mine = run.cycles[row["first_cycle"] : row["first_cycle"] + width]
            assert mine.height == width
            assert row["placement"] == mine["placement"][0]
            assert row["mixed"] == (mine["placement"].n_unique() > 1)
            assert row["violation_rate"] == mine["missed"].mean()
            latencies = sorted(
                math.inf if value is None else value / MS for value in mine["latency_ns"].to_list()
            )
            assert row["l95_ms"] == latencies[math.ceil(0.95 * width) - 1]
            assert row["warmup"] == (row["window"] < problem.warmup_windows)
            for node in problem.fabric.nodes:
                assert 0 <= row[f"u_{node}"] <= 1


def test_windows_follow_one_another(cells: Mapping[str, Problem]) -> None:
    for problem, run in runs_of(cells):
        moved = run.decisions.filter(pl.col("migrated"))["window"].to_list()
        gaps = run.windows["first_cycle"].diff().to_list()[1:]
        for window, gap in enumerate(gaps):
            if window in moved:
                assert gap >= problem.window_cycles
            else:
                assert gap == problem.window_cycles


def test_decisions_say_what_was_stamped(cells: Mapping[str, Problem]) -> None:
    for _, run in runs_of(cells):
        placed = dict(run.windows.select("window", pl.col("placement").cast(str)).rows())
        for row in run.decisions.iter_rows(named=True):
            assert row["incumbent"] == placed[row["window"]]
            assert row["migrated"] == (row["placement"] != row["incumbent"])
            if row["window"] + 1 in placed:
                assert placed[row["window"] + 1] == row["placement"]


def test_costs_are_finite_whatever_is_lost(cells: Mapping[str, Problem]) -> None:
    for _, run in runs_of(cells):
        assert run.windows["cost"].drop_nulls().is_finite().all()
        assert run.windows["seen_l95_ms"].drop_nulls().is_finite().all()


def test_a_job_ends_when_it_completes_or_is_lost() -> None:
    # One worker takes 25 ms a job; one more may wait. R is down from 30 to 45 ms.
    node = Node("R", "robot", scheduler="fifo")
    task = Task("A", {"R": Execution(Constant(25.0))}, depth=1)
    problem = make_problem([node], [task], period_ms=10)
    down = [NodeChange(30 * MS, "R", 0, True), NodeChange(45 * MS, "R", 0, False)]
    real = make_realisation(problem, windows=6, node_changes=down)
    jobs = dwell.simulate_realisation(problem, real, policy="LOC", jobs=True).jobs
    assert jobs is not None
    at_ms = jobs.sort("cycle").select(
        pl.col("ready_ns", "start_ns", "end_ns") // MS, pl.col("outcome").cast(pl.String)
    )
    assert at_ms.rows() == [
        (0, 0, 25, "done"),
        (10, None, 20, "replaced"),
        (20, 25, 30, "node_down"),
        (30, None, 30, "node_down"),
        (40, None, 40, "node_down"),
        (50, 50, None, "in_flight"),
    ]


def test_cycles_released_while_the_cell_migrates_are_lead() -> None:
    run = late_run()
    assert run.windows.height == CLOSED
    assert run.cycles.height == DRAWN * W
    assert run.last_window_end == CLOSED * W
    assert run.cycles["lead"].to_list() == [False] * CLOSED * W + [True] * (DRAWN - CLOSED) * W
    # Every cycle took 30 of 20 ms; the windows of the last ones have not closed.
    assert run.cycles["missed"].to_list() == (~run.cycles["lead"]).to_list()
    assert set(run.jobs["cycle"]) == set(run.cycles["cycle"])
    late = run.cycles[CLOSED * W :]
    assert late["latency_ns"].drop_nulls().unique().to_list() == [30 * MS]
    assert late["outcome"].cast(pl.String).to_list()[-1] == "in_flight"


def test_cycles_released_before_a_late_close_are_lead() -> None:
    # A window closes 50 ms after the release beyond it; an order takes effect after that.
    problem = two_nodes(close_grace_ms=50.0)
    for jobs in (False, True):
        run = dwell.simulate(
            problem, policy=Script("LOC", "OFF"), seed=1, windows=4, jobs=jobs, guard=False
        )
        firsts = run.windows["first_cycle"].to_list()
        assert firsts == [0, 10, 23]
        lead = run.cycles.filter("lead")["cycle"].to_list()
        assert lead == [20, 21, 22, *range(33, run.cycles.height)]
        # The last close is 50 ms after the release of cycle 33.
        assert run.cycles.height == 36


def test_a_cell_of_a_fleet_keeps_the_cycles_after_its_last_window() -> None:
    quick = replace(two_nodes(), name="quick")
    slow = replace(two_nodes(window_cycles=20), name="slow")
    fleet = Fleet("pair", (FleetEntry(quick), FleetEntry(slow)), ("E",), phases="sync")
    run = dwell.simulate_fleet(fleet, seed=1, windows=3, policy="OFF", jobs=True)
    for cell in run.cells.values():
        assert set(cell.jobs["cycle"]) <= set(cell.cycles["cycle"])


def test_jobs_are_where_their_cycles_were_placed(canonical: Problem) -> None:
    run = dwell.simulate(canonical, policy=Script("SO", "LOC", "HYB"), seed=1, windows=6, jobs=True)
    placed = run.cycles.select("cycle", pl.col("placement").cast(str))
    jobs = run.jobs.with_columns(pl.col("task", "node").cast(str)).join(placed, on="cycle")
    for task, node, candidate in jobs.select("task", "node", "placement").unique().iter_rows():
        assert canonical.candidates[candidate][task] == node
    finished = jobs.filter(pl.col("end_ns").is_not_null() & pl.col("start_ns").is_not_null())
    assert (finished["ready_ns"] <= finished["start_ns"]).all()
    assert (finished["start_ns"] <= finished["end_ns"]).all()
    with pytest.raises(RunError):
        _ = dwell.simulate(canonical, seed=1, windows=1).jobs
