"""Workers and what holds them: stages that misbehave, frames that begin cycles, gauges, logs."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import msgspec
import numpy as np
import pytest

from dwell.live.host.hosting import work
from dwell.live.roles.role import RolePlace
from dwell.live.roles.worker import Worker
from dwell.live.stage import Message
from dwell.live.wire import channels
from dwell.live.wire.messages import Beat, Header, Snapshot, Stamp, decode, encode
from dwell.live.wire.routing import STAMPER
from dwell.live.wire.transport import Arrival, Receive
from dwell.model import Problem
from tests.live.replicated_cells import replicated
from tests.live.small_world import MS, Bench, Counting, Passing, World, canonical, stateful
from tests.waiting import PATIENCE_S, wait_until


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC",))


class Detection(msgspec.Struct):
    score: object


class Moody(Passing):
    """A stage that does at some cycles what it should not."""

    moods: ClassVar[Mapping[int, object]] = {}

    def process(self, inputs: Mapping[str, Message]) -> Message:
        cycle = next(iter(inputs.values())).cycle
        mood = self.moods.get(cycle)
        if isinstance(mood, Exception):
            raise mood
        return super().process(inputs) if mood is None else mood  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("mood", "words"),
    [
        (ValueError("no light"), "process() raised ValueError: no light"),
        (MemoryError("for an image"), "process() raised MemoryError: for an image"),
        (b"bytes", "process() returned a bytes, not a Message"),
        (Message("text"), "a str cannot be sent; send bytes, an array, or a msgspec.Struct"),
        (Message(np.array([None])), "an array of object cannot be sent"),
        (Message(Detection(np.zeros(2))), "Detection.score: a ndarray cannot be sent in a struct"),
    ],
)
def test_a_stage_that_fails_costs_its_cycle_and_is_named(
    problem: Problem, mood: object, words: str
) -> None:
    class Once(Moody):
        moods: ClassVar = {10: mood}

    world = World(problem, stages={"perception": Once})
    world.run(1_000)
    worker = world.worker("perception@R1")
    ((complaint, count),) = worker.place.complaints.items()
    assert count == 1
    assert complaint.startswith(f"perception on R1: cycle 10: {words}")
    assert set(range(5, 20)) - set(world.cycles) == {10}
    assert world.stamper.placement == "LOC"


@pytest.mark.parametrize(
    ("declared", "length", "sent"),
    [(0, 262_144, True), (0, 262_145, False), (100_000, 400_000, True), (100_000, 400_001, False)],
)
def test_an_output_may_be_four_times_as_long_as_declared_and_256_kb_anyway(
    problem: Problem, declared: int, length: int, sent: bool
) -> None:
    class Wordy(Passing):
        def process(self, inputs: Mapping[str, Message]) -> Message:
            return Message(bytes(length))

    flows = tuple(
        replace(flow, payload_bytes=declared) if flow.source == "sensing" else flow
        for flow in problem.pipeline.flows
    )
    pipeline = replace(problem.pipeline, flows=flows)
    world = World(replace(problem, pipeline=pipeline), stages={"sensing": Wordy})
    world.run(1_000)
    complaints = world.worker("sensing@R1").place.complaints
    if sent:
        assert not complaints
        return
    assert not world.cycles
    told = f"its output of {length} bytes is not sent: at most {length - 1} are; raise the flow's"
    assert all(told in complaint for complaint in complaints)


def test_what_went_wrong_stands_in_the_beats_for_a_while(problem: Problem) -> None:
    class Once(Moody):
        moods: ClassVar = {10: ValueError("no light")}

    world = World(problem, stages={"perception": Once})
    world.run(1_000)
    beat = world.stamper.pulse.detector.last("perception@R1")
    assert beat is not None
    assert (beat.ready, beat.note) == (
        True,
        "perception on R1: cycle 10: process() raised ValueError: no light",
    )
    world.run(11_000)
    beat = world.stamper.pulse.detector.last("perception@R1")
    assert beat is not None
    assert beat.note == ""


def test_a_stage_that_hangs_says_so_and_the_guard_moves(problem: Problem) -> None:
    cell = replace(problem, controller=replace(problem.controller, initial="SO"))
    world = World(cell)
    world.run(1_000)
    bench = world.roles["perception@E"]
    assert isinstance(bench, Bench)
    bench.exec_ns = 10_000 * MS
    world.run(3_000)
    beat = world.stamper.pulse.detector.last("perception@E")
    assert beat is not None
    assert not beat.ready
    assert "perception on E: cycle " in beat.note
    assert "process() has not returned for 3 s" in beat.note
    assert world.stamper.placement == "LOC"
    assert world.cycles[-1] >= world.stamper.cycle - 2
    assert world.order("SO").startswith("not ready: perception@E not heard")


# ------------------------------------------------------------------------------- frames


class Wire:
    """A transport that keeps what is put."""

    def __init__(self) -> None:
        self.put_keys: list[str] = []
        self.beats: list[Beat] = []

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: str = "control"
    ) -> None:
        self.put_keys.append(key)
        if "/beat/" in key and "/relay/" not in key:
            self.beats.append(decode(bytes(payload), Beat))

    def subscribe(self, key: str, receive: Receive) -> None:
        pass

    def close(self) -> None:
        pass


class Camera(Passing):
    """Brings three frames, then fails."""

    def __init__(self) -> None:
        super().__init__("sensing")
        self.frames = 3

    def wait(self) -> None:
        if not self.frames:
            raise OSError("the cable is off")
        self.frames -= 1


@pytest.mark.parametrize("stage", [Camera(), Passing("sensing")])
def test_frames_begin_cycles(problem: Problem, stage: Passing) -> None:
    cell = replace(problem, live=replace(problem.live, release="frames"))
    wire = Wire()
    place = RolePlace(cell, "sensing@R1", "R1", wire)
    worker = Worker(place, "sensing", stage)
    stopped = threading.Event()
    thread = threading.Thread(target=work, args=(worker, wire), kwargs={"stopped": stopped})
    thread.start()
    wait_until(lambda: any(beat.note and beat.ready for beat in wire.beats))
    stopped.set()
    thread.join()
    note = next(beat.note for beat in wire.beats if beat.note and beat.ready)
    if isinstance(stage, Camera):
        assert wire.put_keys.count(place.keys.of(channels.FRAME)) == 3
        assert note == "sensing on R1: wait() raised OSError: the cable is off"
    else:
        assert note == "sensing on R1: no method wait(), though live.release is frames"


class Slow(Counting):
    """A stage whose snapshot takes until it is released."""

    def __init__(self) -> None:
        super().__init__("planning")
        self.released = threading.Event()

    def snapshot(self) -> bytes:
        self.released.wait(PATIENCE_S)
        return super().snapshot()


def test_a_worker_s_beats_go_on_while_its_stage_writes_its_state(problem: Problem) -> None:
    cell = stateful(problem, "planning", 100)
    wire, stage = Wire(), Slow()
    place = RolePlace(cell, "planning@R2", "R2", wire)
    worker = Worker(place, "planning", stage)
    worker.transfer.at = 1, 5
    asked = Snapshot(7, "planning", "R2", "E", 1, 6)
    worker.receive(Arrival(place.keys.of(channels.SNAPSHOT, "planning", "R2"), encode(asked)), 0)
    stopped = threading.Event()
    thread = threading.Thread(target=work, args=(worker, wire), kwargs={"stopped": stopped})
    thread.start()
    wait_until(lambda: sum(beat.moving and beat.ready for beat in wire.beats) > 5)
    key = place.keys.of(channels.STATE, "planning", "E", "R2")
    assert key not in wire.put_keys
    stage.released.set()
    wait_until(lambda: key in wire.put_keys and not wire.beats[-1].moving)
    stopped.set()
    thread.join()


class Blocked(Passing):
    """A stage whose second job takes until it is released."""

    def __init__(self) -> None:
        super().__init__("sensing")
        self.jobs, self.released = 0, threading.Event()

    def process(self, inputs: Mapping[str, Message]) -> Message:
        self.jobs += 1
        if self.jobs == 2:
            self.released.wait(PATIENCE_S)
        return super().process(inputs)


def test_a_held_message_is_sent_while_the_stage_works() -> None:
    wire, stage = Wire(), Blocked()
    place = RolePlace(replicated(after_ms=20), "sensing@R1", "R1", wire)
    worker = Worker(place, "sensing", stage)
    key = place.keys.of(channels.INPUT, "sensing", "R1", "main")
    begin_ns = time.monotonic_ns()
    for cycle in (1, 2):
        stamp = Stamp(1, cycle, 1, "BOTH", begin_ns + cycle * MS)
        head = encode(Header(stamp, STAMPER, "R1", "none"))
        worker.receive(Arrival(key, b"", head), begin_ns)
    stopped = threading.Event()
    thread = threading.Thread(target=work, args=(worker, wire), kwargs={"stopped": stopped})
    thread.start()
    first, second = (
        place.keys.of(channels.INPUT, "perception", node, "main") for node in ("R1", "E")
    )
    wait_until(lambda: second in wire.put_keys)
    assert stage.jobs == 2
    assert wire.put_keys.count(first) == 1
    stage.released.set()
    wait_until(lambda: wire.put_keys.count(second) == 2)
    stopped.set()
    thread.join()


# ---------------------------------------------------------------------------- the agent


def test_a_source_at_work_is_woken_for_its_beats_only(problem: Problem) -> None:
    world = World(problem)
    world.run(1_000)
    worker, stamper, now_ns = world.worker("sensing@R1"), world.stamper, world.network.now_ns
    worker.busy_since_ns = now_ns
    stamp = Stamp(stamper.run, stamper.cycle + 1, stamper.term, stamper.placement, now_ns)
    key = world.keys.of(channels.INPUT, "sensing", "R1", "main")
    head = encode(Header(stamp, STAMPER, "R1", "none"))
    worker.receive(Arrival(key, b"", head), now_ns)
    assert worker.wake(now_ns + MS) > now_ns + MS
