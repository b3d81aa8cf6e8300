"""A live cell with a deadline beyond the period: several cycles are under way at a time."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import polars as pl
import pytest

import dwell
from dwell.live.roles.run_rows import columns_of
from dwell.model import Problem
from tests.live.memory_transport import NetworkConditions
from tests.live.small_world import MS, World, canonical, on


def within(problem: Problem, deadline_ms: float) -> Problem:
    return replace(problem, pipeline=replace(problem.pipeline, deadline_ms=deadline_ms))


def table(world: World, name: str, first: int) -> pl.DataFrame:
    """Return the newest rows of a table of the record, from a cycle or window on."""
    columns = columns_of(world.cell.controller)[name]
    rows = pl.DataFrame(world.recorder.rows[name], schema=[*columns], orient="row")
    number = rows.columns[0]
    return rows.unique(number, keep="last").sort(number).filter(pl.col(number) >= first)


def fan_in(deadline_ms: float) -> World:
    """Return a cell in which one of two branches holds messages back, so that others overtake."""
    problem = within(dwell.load("examples/fan-in.yaml"), deadline_ms)
    often = replace(problem.controller, decide_cycles=10)
    problem = on(replace(problem, window_cycles=20, controller=often), "PARTS")
    world = World(problem, exec_ms=dict.fromkeys(problem.pipeline.tasks, 1.0), policy="PARTS")
    held = NetworkConditions(reordering=0.3, reorder_ns=120 * MS)
    world.network.impair(held, "find_parts@E", "fuse@R2", key="dwell/*/in/**")
    return world


def test_a_chain_longer_than_the_period_misses_nothing() -> None:
    # Four stages of 25 ms at P = 33.3 ms.
    problem = within(canonical(window_cycles=10), 120)
    exec_ms = dict.fromkeys(problem.pipeline.tasks, 25.0)
    world = World(problem, exec_ms=exec_ms, policy="LOC")
    world.run(5_000)
    cycles, windows = table(world, "cycles", 0), table(world, "windows", 0)
    assert len(windows) >= 10
    assert set(cycles["outcome"]) == {"done"}
    assert cycles["latency_ns"].min() > 100 * MS  # type: ignore[operator]
    assert cycles["missed"].sum() == windows["seen_violation_rate"].sum() == 0
    assert windows["overtaken"].sum() == 0


def test_a_join_keeps_cycles_that_a_later_one_overtakes() -> None:
    world = fan_in(240)
    world.run(12_000)
    cycles, windows = table(world, "cycles", 20), table(world, "windows", 1)
    assert set(cycles["outcome"]) == {"done"}
    assert cycles["missed"].sum() == 0
    # No older command is applied after a newer one; each overtaken cycle is counted.
    for arm in world.arms.values():
        assert all(earlier < later for (earlier, _), (later, _) in pairwise(arm.applied))
    assert 0 < windows["overtaken"].sum() == (~cycles.filter(~cycles["lead"])["actuated"]).sum()


def test_with_a_deadline_within_the_period_a_later_cycle_evicts_an_earlier_one() -> None:
    world = fan_in(45)
    world.run(6_000)
    assert "dropped" in table(world, "cycles", 20)["outcome"].to_list()


@pytest.mark.parametrize(("deadline_ms", "most"), [(30, 4), (100, 6)])
def test_a_dead_node_costs_g_and_the_open_cycles(deadline_ms: float, most: int) -> None:
    problem = within(on(canonical(fallbacks=("LOC",)), "SO"), deadline_ms)
    world = World(problem)
    world.run(2_000)
    assert world.stamper.placement == "SO"
    before = world.arm.applied[-1][0]
    for who in ("perception@E", "planning@E"):
        world.network.freeze(who)
    world.run(2_000)
    assert world.stamper.placement == "LOC"
    cycles = [cycle for cycle, _ in world.arm.applied if cycle >= before]
    lost = max(later - earlier - 1 for earlier, later in pairwise(cycles))
    assert 0 < lost <= most
