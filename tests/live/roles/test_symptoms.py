"""What the cycles of a cell say is wrong with it."""

from __future__ import annotations

import pytest

from dwell.live.wire.wiring import Role
from dwell.model import Problem
from tests.live.small_world import MS, World, canonical, on


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(20, estimator="profile", fallbacks=())


def symptoms(world: World) -> dict[str, object]:
    assert world.cell.windows is not None
    return world.cell.windows.symptoms(world.network.now_ns)


@pytest.mark.parametrize(
    ("placement", "source", "target"),
    [
        ("LOC", "perception@R1", "planning@R2"),
        ("HYB", "sensing@R1", "perception@E"),
        ("SO", "sensing@R1", "perception@E"),
    ],
)
def test_of_a_lost_cycle_the_first_image_to_another_node_is_missed(
    problem: Problem, placement: str, source: str, target: str
) -> None:
    world = World(on(problem, placement), policy=placement)
    world.run(3_000)
    cut = world.network.cut(source, target, key="**/in/**")
    world.run(2_000)
    found = symptoms(world)["recent"]
    assert isinstance(found, dict)
    assert found["unreached"] == (source, target)
    assert max(found["violation_rates"]) > 0.5
    world.network.heal(cut)
    world.run(4_000)
    found = symptoms(world)["recent"]
    assert isinstance(found, dict)
    assert (found["violation_rates"], found["unreached"]) == ([0.0] * 3, None)
    assert (found["silences"], found["applied"]) == ([0] * 3, [1.0] * 3)


def test_the_last_command_that_was_applied_has_an_age(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    world.run(3_000)
    found = symptoms(world)
    assert found["begun_ms"] > 2_000  # type: ignore[operator]
    sinks = found["sinks"]
    assert isinstance(sinks, dict)
    assert sinks["control"]["outcome"] == "actuated"
    assert sinks["control"]["applied_age_ms"] <= problem.pipeline.period_ms
    world.network.cut("*", "sink.control@R2", key="**/sink/**")
    world.run(1_000)
    sinks = symptoms(world)["sinks"]
    assert isinstance(sinks, dict)
    assert 900 < sinks["control"]["applied_age_ms"] < 1_100


def test_silences_count_although_the_sink_cannot_reach_the_controller(problem: Problem) -> None:
    world = World(on(problem, "LOC"), policy="LOC")
    world.run(3_000)
    world.network.cut("R2", "E")
    cut = world.network.cut("R1", "R2", key="**/in/**")
    world.run(500)
    world.network.heal(cut)
    world.run(2_000)
    found = symptoms(world)
    recent = found["recent"]
    assert isinstance(recent, dict)
    assert world.sink.counts["silences"] == 1
    assert (found["silences"], sum(recent["silences"])) == (1, 1)


def test_shadows_of_long_ago_say_nothing(problem: Problem) -> None:
    cell = canonical(20, estimator="shadow", shadow_fraction=0.2)
    world = World(cell, policy="LOC")
    world.run(3_000)
    assert symptoms(world)["failing"] == {}
    world.network.cut("sensing@R1", "perception@E.shadow", key="**/in/**")
    world.run(2_000)
    failing = symptoms(world)["failing"]
    assert isinstance(failing, dict)
    k = cell.controller.guard_cycles + 1
    lacking = {"shadows": k, "unreached": ("sensing@R1", "perception@E")}
    assert failing == {"SO": lacking, "HYB": lacking}
    # Nobody orders any more of them.
    world.network.cut("controller@E", "stamper@R1")
    world.run(10)
    world.stamper.shadow_fraction = 0.0
    world.run(3 * 20 * cell.pipeline.period_ms)
    assert symptoms(world)["failing"] == {}


def test_shadows_that_were_replaced_are_no_lost_messages(problem: Problem) -> None:
    class Slow(World):
        def exec_ns_of(self, role: Role) -> int:
            return 90 * MS if role.who == "perception@E.shadow" else super().exec_ns_of(role)

    cell = canonical(20, estimator="shadow", shadow_fraction=0.5)
    world = Slow(cell, policy="LOC")
    world.run(3_000)
    for _ in range(30):
        world.run(100)
        for one in symptoms(world)["failing"].values():  # type: ignore[attr-defined]
            assert one["unreached"] != ("perception@E", "planning@R2")
