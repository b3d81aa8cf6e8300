"""How a cell returns from the guard's fallback, on the in-memory network: whoever wants it to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import pytest

import dwell
from dwell.model import Problem
from dwell.model.qos import QoS
from tests.live.small_world import Staying, World

PERIOD_MS = 100.0


class Wanting(Staying):
    """Wants to be at one place."""

    def __init__(self, home: str) -> None:
        self.home = home

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        self.name = self.home
        return self.name


def slow_cell(
    window_cycles: int, *fallbacks: str, mode: Literal["control", "advise"] = "control"
) -> Problem:
    """The canonical cell, on SO, at a period at which h probes take 3 s."""
    cell = dwell.load("examples/canonical.yaml")
    settings = replace(
        cell.controller,
        fallbacks=fallbacks or ("LOC",),
        initial="SO",
        decide_cycles=window_cycles,
        min_dwell=1,
        estimator="profile",
    )
    pipeline = replace(cell.pipeline, period_ms=PERIOD_MS, deadline_ms=PERIOD_MS)
    live: Any = replace(cell.live, mode=mode)
    return replace(
        *(cell,), pipeline=pipeline, controller=settings, live=live, window_cycles=window_cycles
    )


def cycles_until(world: World, placement: str, most: int) -> int:
    """Let time pass until a placement holds; returns how many cycles that took."""
    begun = world.stamper.cycle
    for _ in range(most):
        if world.stamper.placement == placement:
            break
        world.run(PERIOD_MS)
    assert world.stamper.placement == placement, world.status
    return world.stamper.cycle - begun


def on_fallback(problem: Problem, policy: Any = None, *, ended: str = "perception@E") -> World:
    """A cell whose guard has left SO, where all is well again."""
    world = World(problem, policy=policy or Staying())
    world.run(3_000)
    world.kill(ended)
    world.run(8 * PERIOD_MS)
    world.start(ended)
    world.run(8 * PERIOD_MS)
    assert world.stamper.guard.on_fallback
    return world


@pytest.mark.parametrize("window_cycles", [5, 15, 20, 40])
def test_a_pin_is_carried_out_once_h_probes_have_come_through(window_cycles: int) -> None:
    world = on_fallback(slow_cell(window_cycles))
    needed = world.problem.controller.probe_cycles
    world.ask("pin", "SO")
    # What it says of itself takes a quarter of a second, and so does what it is told.
    assert needed <= cycles_until(world, "SO", 2 * needed) <= needed + 8
    world.run(5_000)
    assert world.stamper.placement == "SO"
    assert not world.stamper.guard.on_fallback
    assert [why for _, _, why in world.stamper.moves] == ["guard", "order"]


@pytest.mark.parametrize("policy", ["SO", Wanting("SO")], ids=["static", "one that wants to leave"])
@pytest.mark.parametrize("window_cycles", [5, 15, 40])
def test_who_wants_to_be_elsewhere_is_there_at_the_first_close_after_the_proof(
    policy: Any, window_cycles: int
) -> None:
    world = on_fallback(slow_cell(window_cycles), policy)
    needed = world.problem.controller.probe_cycles
    cycles_until(world, "SO", 2 * needed + 3 * window_cycles)
    world.run(5_000)
    assert [to for _, to, _ in world.stamper.moves] == ["LOC", "SO"]
    assert world.status["wanted"] is None


def test_a_pin_goes_before_what_the_policy_wants() -> None:
    world = on_fallback(slow_cell(5), Wanting("SO"))
    world.ask("pin", "HYB")
    cycles_until(world, "HYB", 60)
    world.run(5_000)
    assert [to for _, to, _ in world.stamper.moves] == ["LOC", "HYB"]


def test_a_pin_to_where_it_cannot_be_is_not_carried_out_before_it_can() -> None:
    world = on_fallback(slow_cell(15))
    world.kill("planning@E")
    world.ask("pin", "SO")
    world.run(12_000)
    assert world.stamper.placement == "LOC"
    found = world.status
    assert (found["pinned"], found["moving_to"]) == ("SO", None)
    # The shadow has proven it, and its worker is not there.
    assert found["refused"].startswith("not ready: planning@E")
    windows = found["windows"]
    world.run(6_000)
    assert world.status["windows"] > windows
    world.start("planning@E")
    cycles_until(world, "SO", 60)


def test_a_pin_that_is_taken_back_leaves_the_cell_where_it_is() -> None:
    world = on_fallback(slow_cell(15))
    world.ask("pin", "SO")
    world.run(15 * PERIOD_MS)
    assert world.status["proving"]["candidate"] == "SO"
    world.ask("unpin")
    world.run(6_000)
    assert world.status["proving"] is None
    assert world.stamper.placement == "LOC"
    assert world.stamper.guard.probation.wanted is None
    # And another begins anew.
    world.ask("pin", "SO")
    assert cycles_until(world, "SO", 60) >= world.problem.controller.probe_cycles


def test_a_pin_to_the_fallback_itself_probes_nothing() -> None:
    world = on_fallback(slow_cell(5), Wanting("SO"))
    world.ask("pin", "LOC")
    world.run(8_000)
    assert (world.stamper.placement, world.status["proving"]) == ("LOC", None)


@pytest.mark.parametrize("window_cycles", [5, 15, 40])
@pytest.mark.parametrize("mode", ["control", "advise"])
def test_a_fallback_that_is_drained_is_left_for_what_is_proven(
    window_cycles: int, mode: Literal["control", "advise"]
) -> None:
    problem = slow_cell(window_cycles, "HYB", "LOC", mode=mode)
    world = on_fallback(problem, ended="planning@E")
    assert world.stamper.placement == "HYB"
    world.ask("drain", "E")
    needed = problem.controller.probe_cycles
    assert needed <= cycles_until(world, "LOC", 2 * needed) <= needed + 8
    world.run(5_000)
    assert world.stamper.placement == "LOC"


def test_it_says_how_far_the_proof_is_and_calls_nothing_a_move_before() -> None:
    world = on_fallback(slow_cell(15))
    assert world.status["proving"] is None
    world.ask("pin", "SO")
    done, moving = [], []
    while world.stamper.placement == "LOC":
        found = world.status
        proving = found["proving"]
        moving.append(found["moving_to"])
        if proving is not None:
            assert (proving["candidate"], proving["needed"]) == ("SO", 30)
            done.append(proving["done"])
        world.run(PERIOD_MS)
        assert len(moving) < 60
    assert done == sorted(done)
    assert (done[0], done[-1]) == (0, max(done))
    assert max(done) >= 27
    assert set(moving[:-1]) == {None}
    world.run(1_000)
    assert (world.status["proving"], world.status["moving_to"]) == (None, None)


def test_probes_that_are_lost_begin_the_count_anew_and_the_pin_holds() -> None:
    world = on_fallback(slow_cell(15))
    world.ask("pin", "SO")
    world.run(20 * PERIOD_MS)
    before = world.status["proving"]["done"]
    world.kill("planning@E.shadow")
    world.run(8 * PERIOD_MS)
    assert before > world.status["proving"]["done"] == 0
    world.start("planning@E.shadow")
    assert cycles_until(world, "SO", 60) >= world.problem.controller.probe_cycles


@pytest.mark.parametrize("who", ["stamper@R1", "controller@E"])
def test_a_static_policy_is_carried_out_though_a_process_starts_again(who: str) -> None:
    world = on_fallback(slow_cell(15), "SO")
    world.run(20 * PERIOD_MS)
    world.kill(who)
    world.run(5 * PERIOD_MS)
    world.start(who)
    cycles_until(world, "SO", 120)


def test_a_pin_is_carried_out_though_the_stamper_starts_again() -> None:
    world = on_fallback(slow_cell(15))
    world.ask("pin", "SO")
    world.run(20 * PERIOD_MS)
    world.kill("stamper@R1")
    world.run(5 * PERIOD_MS)
    world.start("stamper@R1")
    cycles_until(world, "SO", 80)


def test_the_record_has_no_move_that_was_none() -> None:
    world = on_fallback(slow_cell(5))
    world.ask("pin", "SO")
    cycles_until(world, "SO", 60)
    world.run(3_000)
    from dwell.live.roles.run_rows import columns_of

    names = list(columns_of(world.cell.controller)["decisions"])
    rows = [dict(zip(names, row, strict=True)) for row in world.recorder.rows["decisions"]]
    # The policy has wanted to stay all the time, and nothing of that was held back.
    moved = [(row["placement"], row["reason"]) for row in rows if row["migrated"]]
    assert moved == [("LOC", "guard"), ("SO", "pinned")]
    assert {row["refused"] for row in rows} <= {None}


@pytest.mark.parametrize("lossy", [0.1, 0.3])
def test_a_pin_is_carried_out_where_orders_and_answers_are_lost(lossy: float) -> None:
    world = on_fallback(slow_cell(15))
    for one, other in (("controller@E", "stamper@R1"), ("stamper@R1", "controller@E")):
        world.network.impair(world.losing(lossy), one, other)
    world.ask("pin", "SO")
    cycles_until(world, "SO", 80)
