"""Jobs of live runs: instants, CPU time, shadows, what was replaced; what processes took."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import dwell
from dwell.live.roles.control_group import Counts
from dwell.live.roles.controlled_cell import ControlledCell
from dwell.live.roles.run_rows import Rows, columns_of
from dwell.live.roles.sink import Sink
from dwell.live.wire import payloads
from dwell.model import Problem
from dwell.record import column_types
from tests.cells.once import with_windows
from tests.live.small_world import EXEC_MS, MS, Recorded, World

CPU_NS = 1_234_567
OTHERS_NS = 70_000


@pytest.fixture(scope="module")
def problem() -> Problem:
    cell = dwell.load("examples/canonical.yaml")
    cell = replace(
        cell,
        controller=replace(cell.controller, fallbacks=(), close_grace_ms=40),
        pipeline=replace(cell.pipeline, deadline_ms=33.0),
    )
    return with_windows(cell, 20)


class Spent:
    """A clock of CPU time that goes on by a fixed time between two looks."""

    def __init__(self, each_ns: int = CPU_NS) -> None:
        self.at_ns, self.each_ns = 0, each_ns

    def __call__(self) -> int:
        self.at_ns += self.each_ns
        return self.at_ns


def world_of(problem: Problem, policy: str, **more: Any) -> World:
    """Return a cell whose controller keeps the jobs."""
    return World(problem, policy=policy, jobs=True, **more)


def frames(problem: Problem, rows: Rows | dict[str, list[tuple[object, ...]]]) -> pl.DataFrame:
    """Return the jobs as a table."""
    names = [*column_types("jobs", problem, ["live"])]
    return pl.DataFrame(rows["jobs"], schema=names, orient="row")


def test_jobs_are_those_of_the_simulator(problem: Problem) -> None:
    world, group = world_of(problem, "LOC"), Spent(OTHERS_NS)

    def counted() -> Counts:
        at_ns = group()
        return Counts(at_ns, at_ns)

    for role in world.roles.values():
        worker = getattr(role, "worker", None)
        if worker is not None:
            worker.cpu_clock = Spent()
            if worker.place.node == "R2":
                worker.group_clock = counted
        elif isinstance(role, Sink):
            role.group_clock = group
    world.run(4_000)
    jobs = frames(problem, world.recorder.rows)
    simulated = dwell.simulate(problem, policy="LOC", seed=1, windows=2, jobs=True).jobs
    spent = ["cpu_ns", "others_ns", "handover_ns", "ending_ns"]
    assert jobs.columns == [*simulated.columns, "shadow", *spent]

    nodes = {"sensing": "R1", "perception": "R1", "planning": "R2", "control": "R2"}
    cycles = sorted(set(jobs["cycle"]))
    assert cycles == list(range(len(cycles)))
    assert len(cycles) >= 3 * problem.window_cycles
    assert jobs["cycle"].is_sorted()
    settled = jobs.filter(pl.col("cycle") > 5)
    for cycle, of in settled.group_by("cycle"):
        assert of["task"].to_list() == list(nodes), cycle
        assert of["node"].to_list() == list(nodes.values())
        assert of["ready_ns"].to_list()[1:] >= of["end_ns"].to_list()[:-1]
    assert set(settled["outcome"]) == {"done"}
    assert not settled["shadow"].any()
    assert settled["cpu_ns"].unique().to_list() == [CPU_NS]
    # Only where something counts them.
    assert settled.select("node", "others_ns").unique().sort("node").rows() == [
        ("R1", None),
        ("R2", OTHERS_NS),
    ]
    # From the end of a job to the start of the next on the same node; the stamper's has no count.
    handed = settled.select("task", "handover_ns").unique(maintain_order=True).rows()
    assert dict(handed) == {**dict.fromkeys(nodes), "control": OTHERS_NS}
    # From the end of a sink's job to the hand-over of its command.
    ended = settled.select("task", "ending_ns").unique(maintain_order=True).rows()
    assert dict(ended) == {**dict.fromkeys(nodes), "control": OTHERS_NS}
    took = settled.with_columns(took=pl.col("end_ns") - pl.col("start_ns"))
    for task, exec_ms in EXEC_MS.items():
        assert took.filter(pl.col("task") == task)["took"].unique().to_list() == [exec_ms * MS]

    # The latency of a cycle runs from its release to the end of its last job.
    order = [*columns_of(world.cell.controller)["cycles"]]
    table = pl.DataFrame(world.recorder.rows["cycles"], schema=order, orient="row")
    table = table.unique("cycle", keep="last")
    ends = settled.group_by("cycle").agg(pl.col("end_ns").max())
    both = ends.join(table, on="cycle")
    over = both["latency_ns"] - (both["end_ns"] - both["release_ns"])
    # Until the sink has handed the command to the arm.
    assert 0 <= over.min() <= over.max() < MS  # type: ignore[operator]


def test_reading_its_inputs_is_part_of_a_jobs_cpu_time(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    spent_ns = [0]

    def reading(*arguments: Any) -> object:
        spent_ns[0] += CPU_NS
        return payloads.read_payload(*arguments)

    monkeypatch.setattr("dwell.live.roles.worker.read_payload", reading)
    world = world_of(problem, "LOC")
    for role in world.roles.values():
        if hasattr(role, "worker"):
            role.worker.cpu_clock = lambda: spent_ns[0]
    world.run(2_000)
    jobs = frames(problem, world.recorder.rows)
    assert set(jobs["task"]) == set(EXEC_MS)
    assert jobs["cpu_ns"].unique().to_list() == [CPU_NS]


def cell_of(world: World) -> ControlledCell:
    """Return the controller's side of the cell."""
    cell = world.roles[f"controller@{world.problem.controller_node}"]
    assert isinstance(cell, ControlledCell)
    return cell


def test_a_job_that_was_replaced_is_known_without_instants(problem: Problem) -> None:
    world = world_of(problem, "LOC")
    for role in world.roles.values():
        if getattr(getattr(role, "worker", None), "task", "") == "perception":
            role.exec_ns = 80 * MS  # type: ignore[attr-defined]
    world.run(4_000)
    jobs = frames(problem, world.recorder.rows)
    replaced = jobs.filter(pl.col("outcome") == "replaced")
    assert len(replaced) > 20
    assert set(replaced["task"]) == {"perception"}
    assert replaced["start_ns"].null_count() == replaced["cpu_ns"].null_count() == len(replaced)
    behind = set(jobs.filter(pl.col("task") == "planning")["cycle"])
    assert behind.isdisjoint(replaced["cycle"])


def test_shadow_jobs_are_told_apart(problem: Problem) -> None:
    settings = replace(problem.controller, estimator="corrected", shadow_fraction=0.25)
    world = world_of(replace(problem, controller=settings), "LOC")
    world.run(6_000)
    jobs = frames(problem, world.recorder.rows)
    shadows = jobs.filter(pl.col("shadow"))
    assert set(shadows["task"]) == {"perception", "planning"}
    assert "E" in set(shadows["node"])
    assert set(shadows["task"]).isdisjoint(["sensing", "control"])
    own = jobs.filter(~pl.col("shadow"))
    # Nothing is told twice, and what both share belongs to the cycle.
    assert len(own.unique(["cycle", "task"])) == len(own)
    shared = set(own.filter(pl.col("task") == "sensing")["cycle"])
    assert set(shadows["cycle"]) <= shared


def test_what_processes_take_is_kept_by_window(problem: Problem) -> None:
    world = world_of(problem, "LOC")
    world.run(4_000)
    names = [*column_types("processes", problem, ["live"])]
    found = pl.DataFrame(world.recorder.rows["processes"], schema=names, orient="row")
    agents = {f"agent@{node}" for node in problem.fabric.nodes}
    assert set(found["process"]) == {*agents, "controller@E"}
    assert found["cpu_ns"].min() >= 0  # type: ignore[operator]
    windows = sorted(set(found["window"].to_list()))
    assert windows == list(range(len(windows)))
    assert len(windows) >= 3


def test_jobs_survive_in_the_folder(problem: Problem, tmp_path: Path) -> None:
    world = Recorded(problem, tmp_path, jobs=True)
    world.run(4_000)
    run = dwell.open_run(world.finish())
    assert run.has_jobs
    assert run.has_processes
    in_windows = run.cycles.filter(~pl.col("lead"))["cycle"]
    # At the end nothing is held back.
    assert set(run.jobs["cycle"]) == set(in_windows)
    assert run.processes["window"].max() == run.windows["window"].max()
