"""What a controller says is wrong with its cell, on the in-memory network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from dwell.live.health import diagnose, silent_after_ns, window_late_ns
from dwell.live.stage import Message
from dwell.live.wiring import roles
from dwell.model import Problem
from tests.live.small_world import MS, Passing, World, canonical


class Raising(Passing):
    """A stage that sees nothing."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        raise ValueError("no light")


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(20, fallbacks=("LOC", "HYB", "SO"), estimator="profile")


def running(problem: Problem, **more: Any) -> World:
    world = World(problem, policy="LOC", **more)
    world.run(5_000)
    return world


def silence_ms(world: World) -> float:
    return silent_after_ns(world.problem) / MS


def test_a_cell_that_is_well_has_no_headline(problem: Problem) -> None:
    for mode in ("control", "advise"):
        world = running(replace(problem, live=replace(problem.live, mode=mode)))
        found = world.status
        assert (found["health"], found["headline"]) == ("ok", None)
        assert found["window"]["age_ms"] <= problem.window_cycles * problem.pipeline.period_ms
        assert all(one["heard"] and one["ready"] for one in found["processes"].values())


def test_without_the_relay_the_controller_says_that_it_hears_nobody(problem: Problem) -> None:
    world = running(problem)
    world.kill("agent@E")
    world.run(silence_ms(world) / 2)
    assert world.status["health"] == "ok"
    world.run(silence_ms(world))
    found = world.status
    assert found["health"] == "silent"
    assert "the controller hears nobody since" in found["headline"]
    assert "the relay, agent E, is silent" in found["headline"]
    assert not any(one["ready"] for one in found["processes"].values())
    world.start("agent@E")
    world.run(2_000)
    assert world.status["headline"] is None


def test_what_was_never_heard_counts_from_the_controllers_beginning(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    for role in roles(world.problem):
        if role.kind != "controller":
            world.kill(role.who)
    world.run(window_late_ns(world.problem) / MS + 1_000)
    found = world.status
    assert found["health"] == "silent"
    assert "no window since" in found["headline"]


@pytest.mark.parametrize("who", ["perception@E", "agent@R1"])
def test_a_frozen_process_is_named_and_windows_go_on(problem: Problem, who: str) -> None:
    world = running(problem)
    world.network.freeze(who)
    world.run(silence_ms(world) + 2_000)
    found = world.status
    assert found["health"] == "degraded"
    assert found["headline"].startswith(f"{who} is silent since ")
    world.network.thaw(who)
    world.run(2_000)
    assert world.status["health"] == "ok"


def test_a_node_that_is_gone_is_named_once(problem: Problem) -> None:
    world = running(problem)
    there = [role.who for role in roles(world.problem) if role.node == "R2"]
    for who in there:
        world.kill(who)
    world.run(window_late_ns(world.problem) / MS)
    headline = world.status["headline"]
    assert "nothing is heard of R2 since" in headline
    assert not any(who in headline for who in there)


def test_without_a_stamper_there_is_no_window(problem: Problem) -> None:
    world = running(problem)
    world.kill("stamper@R1")
    world.run(window_late_ns(world.problem) / MS + 2_000)
    found = world.status
    assert found["health"] == "stalled"
    assert "no window since" in found["headline"]
    assert "stamper@R1 is silent since" in found["headline"]


def test_windows_that_stop_are_told_though_everybody_is_heard(problem: Problem) -> None:
    world = World(
        replace(problem, live=replace(problem.live, release="frames")),
        policy="LOC",
    )
    # No frame ever comes.
    world.run(window_late_ns(world.problem) / MS + 2_000)
    found = world.status
    assert all(one["heard"] for one in found["processes"].values())
    assert found["health"] == "stalled"
    assert "no window since" in found["headline"]


def test_windows_without_a_completed_cycle_are_told_with_a_reason(problem: Problem) -> None:
    world = World(problem, policy="LOC", stages={"control": Raising})
    world.run(8_000)
    found = world.status
    assert found["health"] == "stalled"
    assert "no light" in found["headline"]


def test_a_process_that_is_not_ready_is_told_with_a_reason(problem: Problem) -> None:
    world = running(problem)
    found = world.status
    found["processes"]["planning@E"] |= {"ready": False, "note": "no model\nand more"}
    health, headline = diagnose(world.problem, found)
    assert (health, headline) == ("degraded", "planning@E is not ready: no model")


def test_who_differs_is_named_and_not_called_silent(problem: Problem) -> None:
    world = running(problem)
    found = world.status
    found["processes"]["agent@R1"] |= {"heard": False, "ready": False}
    found["strangers"] = {"agent@R1": "agent@R1 has another cell file"}
    assert diagnose(world.problem, found) == ("degraded", "agent@R1 has another cell file")


def test_of_a_node_that_is_drained_nothing_need_be_heard(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, relay="R1"))
    world = running(cell)
    role = world.cell
    role.drained.add("E")
    for process in roles(world.problem):
        if process.node == "E" and process.kind != "controller":
            world.kill(process.who)
    world.run(silence_ms(world) + 2_000)
    assert world.status["headline"] is None


def test_a_headline_names_a_few_and_counts_the_others(problem: Problem) -> None:
    world = running(problem)
    found = world.status
    workers = [who for who in found["processes"] if who.startswith(("perception", "planning"))]
    for who in workers:
        found["processes"][who] |= {"ready": False}
    _, headline = diagnose(world.problem, found)
    assert headline is not None
    assert f"and {len(workers) - 3} more" in headline
