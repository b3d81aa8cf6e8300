"""A live cell with two sources on two nodes, a join and two sinks."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

import dwell
from dwell.model import Problem
from tests.live.memory_transport import Clock
from tests.live.small_world import MS, Counting, World

EXEC_MS = {
    "overview_camera": 3.0,
    "wrist_camera": 2.0,
    "find_parts": 8.0,
    "find_gripper": 5.0,
    "fuse": 2.0,
    "plan": 6.0,
}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load("examples/fan-in.yaml")


def world_of(problem: Problem, clocks: dict[str, Clock] | None = None, **more: Any) -> World:
    exec_ms = {name: EXEC_MS.get(name, 0.5) for name in problem.pipeline.tasks}
    return World(problem, exec_ms=exec_ms, clocks=clocks, **more)


@pytest.mark.parametrize("offset_s", [0, 777])
def test_both_sources_begin_a_cycle_together(problem: Problem, offset_s: int) -> None:
    world = world_of(problem, {"R2": Clock(offset_s * 1_000 * MS, 30.0)})
    world.run(3_010)
    for arm in world.arms.values():
        cycles = [cycle for cycle, _ in arm.applied]
        assert len(cycles) > 50
        assert all(later - earlier == 1 for earlier, later in pairwise(cycles[5:]))
    source = world.worker("wrist_camera@R2")._source
    assert source is not None
    last = source._last
    assert last is not None
    # The stamp was there before its cycle began: the source has waited for that instant.
    assert last.stamp.cycle >= world.stamper.cycle - 1


def test_a_completed_cycle_is_one_that_every_sink_has_reported(problem: Problem) -> None:
    world = world_of(problem)
    world.run(2_000)
    newest = world.stamper.guard.newest
    assert newest > 30
    sinks = list(world.arms)
    assert len(sinks) == 2
    world.network.freeze(f"sink.{sinks[1]}@{next(iter(problem.pipeline.tasks[sinks[1]].on))}")
    world.run(500)
    assert world.stamper.guard.newest <= newest + 2


def test_a_source_without_stamps_goes_on_for_a_while_by_itself(problem: Problem) -> None:
    world = world_of(problem)
    world.run(2_000)
    rule = world.network.cut("stamper@R1", "wrist_camera@R2")
    world.run(60 + 3 * problem.pipeline.period_ms)
    before = world.arm.applied[-1][0]
    # The join has the other camera's stamp, so that its cycles go where they should.
    assert before >= world.stamper.cycle - 3
    world.network.heal(rule)
    world.run(1_000)
    cycles = world.cycles
    assert all(later > earlier for earlier, later in pairwise(cycles))
    assert cycles[-1] >= world.stamper.cycle - 2


def test_a_move_of_the_guard_reaches_all_sources(problem: Problem) -> None:
    world = world_of(problem)
    world.run(2_000)
    other = next(name for name in problem.candidates if name != world.stamper.placement)
    assert not world.order(other)
    world.run(1_000)
    assert world.stamper.placement == other
    cycles = world.cycles
    assert all(later - earlier == 1 for earlier, later in pairwise(cycles[5:]))


def test_a_state_moves_whole_although_stamps_are_drawn_early(problem: Problem) -> None:
    tasks = dict(problem.pipeline.tasks)
    tasks["plan"] = replace(tasks["plan"], state_bytes=100)
    pipeline, live = replace(problem.pipeline, tasks=tasks), replace(problem.live, max_age_ms=1e4)
    controller = replace(problem.controller, fallbacks=())
    cell = replace(problem, pipeline=pipeline, live=live, controller=controller)
    world = world_of(cell, stages={"plan": Counting}, policy="LOC", delay_ms=20)
    for ms in (2_000, 2_010, 2_020, 2_030, 2_040):
        world.run(ms)
        candidate = "LOC" if world.stamper.placement == "EDGE" else "EDGE"
        world.pin(candidate)
        world.run(1_000)
        assert world.stamper.placement == candidate
    counts = world.arms["act"].counts
    first = counts[0][0] - counts[0][1]
    assert [cycle - count for cycle, count in counts] == [first] * len(counts)
