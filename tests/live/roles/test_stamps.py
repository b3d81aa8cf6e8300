"""Stamps of sources on their way to the actuator, and what stages report between their calls."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

import dwell
from dwell.live.roles.sink import Sink
from dwell.live.stage import CellActuator, Message, StageReport, TopicRates
from tests.live.small_world import Passing, World, canonical

#: Ends of stamps: each source is a task, by its clock.
OFFSETS_NS = {"overview_camera": 5_000, "wrist_camera": 2_000}


class Stamping(Passing):
    """A source that stamps its frames."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        cycle = inputs["stamper"].cycle
        return Message(b"-", stamp_ns=cycle * 1_000_000 + OFFSETS_NS.get(self.name, 0))


class Repeating(Passing):
    """A stage that hands on its whole input."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        assert all(message.stamp_ns is None for message in inputs.values())
        return next(iter(inputs.values()))


class Keeping(CellActuator):
    """An actuator that keeps cycles and stamps."""

    def __init__(self, stamp_from: str = "") -> None:
        self.stamp_from = stamp_from
        self.stamps: list[tuple[int, int | None]] = []

    def apply(self, command: Message) -> None:
        self.stamps.append((command.cycle, command.stamp_ns))


@pytest.mark.parametrize(("stamp_from", "offset_ns"), [("", 2_000), ("overview_camera", 5_000)])
def test_command_has_the_oldest_stamp_behind_it(stamp_from: str, offset_ns: int) -> None:
    problem = dwell.load("examples/fan-in.yaml")
    stages = dict.fromkeys(problem.pipeline.tasks, Repeating)
    exec_ms = dict.fromkeys(problem.pipeline.tasks, 0.5)
    world = World(
        problem, exec_ms=exec_ms, stages={**stages, **dict.fromkeys(OFFSETS_NS, Stamping)}
    )
    kept = Keeping(stamp_from)
    (role,) = (one for who, one in world.roles.items() if who.startswith("sink.act@"))
    assert isinstance(role, Sink)
    role.actuator = kept
    world.run(2_000)
    assert len(kept.stamps) > 10
    for cycle, stamp_ns in kept.stamps:
        assert stamp_ns == cycle * 1_000_000 + offset_ns


def test_without_stamps_there_is_none() -> None:
    world = World(canonical(20))
    world.sink.actuator = kept = Keeping()
    world.run(1_000)
    assert kept.stamps
    assert {stamp for _, stamp in kept.stamps} == {None}


class Reporting(Passing):
    """A source with a topic, which falls silent."""

    silent = False

    def report(self) -> StageReport:
        note = "/image: no message for 0.6 s" if self.silent else ""
        return StageReport(not self.silent, note, TopicRates("/image", 29.5, 1.25, 3, 12.0))


def test_status_has_the_topic_and_the_reason_of_its_silence() -> None:
    world = World(canonical(20), stages={"sensing": Reporting}, policy="LOC")
    world.run(2_000)
    assert world.status["health"] == "ok"
    (row,) = world.status["topics"].values()
    assert row["topic"] == "/image"
    assert (row["rate_hz"], row["jitter_ms"], row["lost"]) == (29.5, 1.25, 3)
    assert row["period_ms"] == world.problem.pipeline.period_ms
    assert row["stamp_ms"] is None
    Reporting.silent = True
    try:
        world.run(1_000)
    finally:
        Reporting.silent = False
    assert world.status["health"] == "degraded"
    assert "sensing@R1 is not ready: sensing on R1: /image: no message" in world.status["headline"]


def test_sink_reports_what_its_actuator_lacks() -> None:
    class Waiting(Keeping):
        def report(self) -> StageReport:
            return StageReport(False, "/cmd_vel: no router")

    world = World(canonical(20), policy="LOC")
    world.sink.actuator = Waiting()
    world.run(1_500)
    process = world.status["processes"]["sink.control@R2"]
    assert not process["ready"]
    assert process["note"] == "/cmd_vel: no router"
