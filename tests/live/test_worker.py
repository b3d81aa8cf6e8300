"""Workers and what holds them: stages that misbehave, frames that begin cycles, gauges, logs."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import dwell
from dwell.live.agent import Gauge
from dwell.live.hosting import work
from dwell.live.loads import NodeLoad
from dwell.live.log import Log
from dwell.live.messages import Beat, Load, decode, encode
from dwell.live.role import RIVAL_BEATS, Pulse, RolePlace
from dwell.live.stage import Message
from dwell.live.stamper import Stamper
from dwell.live.supervision import Supervisor
from dwell.live.transport.transport import Arrival, Receive
from dwell.live.worker import Worker
from dwell.model import Problem
from dwell.model.document import fingerprint
from tests.live.memory_transport import Network
from tests.live.small_world import MS, Bench, Passing, World

EXEC_MS = {"sensing": 3.0, "perception": 10.0, "planning": 6.0, "control": 0.5}
PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def problem() -> Problem:
    cell = dwell.load("examples/canonical.yaml")
    return replace(cell, controller=replace(cell.controller, fallbacks=("LOC",)))


def until(done: Callable[[], object]) -> None:
    """Wait until something holds."""
    limit_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < limit_s, "it has not come about"
        time.sleep(0.005)


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
        (b"bytes", "process() returned a bytes, not a Message"),
        (Message("text"), "a str cannot be sent; send bytes, an array, or a msgspec.Struct"),
        (Message(np.array([None])), "an array of object cannot be sent"),
    ],
)
def test_a_stage_that_fails_costs_its_cycle_and_is_named(
    problem: Problem, mood: object, words: str
) -> None:
    class Once(Moody):
        moods: ClassVar = {10: mood}

    world = World(problem, exec_ms=EXEC_MS, stages={"perception": Once})
    world.run(1_000)
    worker = world.worker("perception@R1")
    assert worker.failures == 1
    (complaint,) = worker.place.complaints
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
    world = World(replace(problem, pipeline=pipeline), exec_ms=EXEC_MS, stages={"sensing": Wordy})
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

    world = World(problem, exec_ms=EXEC_MS, stages={"perception": Once})
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
    world = World(cell, exec_ms=EXEC_MS)
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


def test_other_cell_files_and_versions_are_named(problem: Problem) -> None:
    world = World(problem, exec_ms=EXEC_MS, policy="dtp")
    world.run(1_000)
    stamper = world.stamper
    digest = fingerprint(world.problem)
    key = stamper.place.keys.beat("E", "agent@E")

    def beat(cell: str, version: str) -> str:
        one = Beat("agent@E", "E", 99, 1, True, cell=cell, version=version)
        stamper.receive(Arrival(key, encode(one)), world.network.now_ns)
        return stamper.place.last_complaint

    own = dwell.__version__
    assert beat("0123", own) == (
        f"agent@E has another cell file (0123) than stamper@R1 ({digest}); "
        "copy one file to all nodes"
    )
    assert beat(digest, "7.1.0") == (
        f"agent@E runs Dwell 7.1.0, and stamper@R1 {own}; install one version on all nodes"
    )
    assert stamper.pulse.strangers.keys() == {"agent@E"}
    count = stamper.place.complained
    # A patch release says the same things.
    assert beat(digest, f"{own.rpartition('.')[0]}.99") != ""
    assert stamper.place.complained == count
    assert not stamper.pulse.strangers


def test_a_process_of_another_cell_file_is_shown_by_the_controller(problem: Problem) -> None:
    world = World(problem, exec_ms=EXEC_MS, policy="dtp")
    world.run(1_000)
    cell = world.roles["controller@E"]
    keys, now_ns = world.stamper.place.keys, world.network.now_ns
    for who, node in (("stamper@R1", "R1"), ("agent@E", "E")):
        one = Beat(who, node, 99, 1, True, cell="other", version=dwell.__version__)
        cell.receive(Arrival(keys.beat(node, who), encode(one)), now_ns)  # type: ignore[attr-defined]
    found = cell.status(now_ns)  # type: ignore[attr-defined]
    assert found["strangers"]["agent@E"].startswith("agent@E has another cell file (other)")
    # Its candidates may be others of the same names: it is ordered nothing.
    before = world.stamper.term
    world.pin("SO")
    assert cell._move is not None  # type: ignore[attr-defined]
    assert world.stamper.term == before


def test_two_processes_of_one_name_are_noticed(problem: Problem) -> None:
    end = Network(delay_ns=0, start_ns=MS).transport("me", "R1")
    place = RolePlace(problem, "stamper@R1", "R1", end)
    pulse = Pulse(place, lambda: (True, ""), hears=[("*", "*")])
    key = place.keys.beat("E", "agent@E")

    def beat(life: int, sent_ns: int) -> None:
        one = Beat("agent@E", "E", life, sent_ns, True, cell=fingerprint(problem))
        pulse.receive(Arrival(key, encode(one)), sent_ns)

    beat(1, 1)
    beat(2, 2)
    # One that was on its way when its sender died.
    beat(1, 3)
    assert place.complained == 0
    for sent_ns in range(4, 4 + RIVAL_BEATS):
        beat(1, sent_ns)
    assert place.last_complaint == (
        "two processes say that they are agent@E; end one: its agent runs twice?"
    )


def test_the_stamper_beats_between_two_releases(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(problem, exec_ms=EXEC_MS)
    stamper, period_ns = world.stamper, problem.pipeline.period_ms * MS
    beats: list[int] = []
    send = stamper.pulse.send

    def noted(now_ns: int) -> None:
        beats.append(now_ns)
        send(now_ns)

    monkeypatch.setattr(stamper.pulse, "send", noted)
    world.run(3_000)
    assert stamper.cycle > 50
    since = [(at_ns - stamper._next_ns) % period_ns / period_ns for at_ns in beats[10:]]
    assert since == pytest.approx([0.5] * len(since), abs=0.01)
    assert max(b - a for a, b in pairwise(beats)) <= 1.5 * period_ns


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
    until(lambda: any(beat.note and beat.ready for beat in wire.beats))
    stopped.set()
    thread.join()
    note = next(beat.note for beat in wire.beats if beat.note and beat.ready)
    if isinstance(stage, Camera):
        assert wire.put_keys.count(place.keys.frame()) == 3
        assert note == "sensing on R1: wait() raised OSError: the cable is off"
    else:
        assert note == "sensing on R1: no method wait(), though live.release is frames"


def test_a_flood_of_frames_makes_two_cycles_a_period(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, release="frames"))
    world = World(cell, exec_ms=EXEC_MS)
    world.run(500)
    stamper = world.stamper
    assert isinstance(stamper, Stamper)
    assert stamper.cycle == 0
    period_ms = problem.pipeline.period_ms
    key = stamper.place.keys.frame()
    for _ in range(1_000):
        stamper.receive(Arrival(key, b""), world.network.now_ns)
        world.run(period_ms / 100)
    assert 19 <= stamper.cycle <= 20
    assert stamper.skipped == 1_000 - stamper.cycle


# ---------------------------------------------------------------------------- the agent


def test_a_gauge_tells_shares_only() -> None:
    value: list[object] = [0.25]
    gauge = Gauge(lambda: value[0], every_s=0.001)  # type: ignore[arg-type,return-value]
    until(lambda: gauge.value() == 0.25)
    for wrong, words in (
        (37, "ValueError: 37 is no share from 0 to 1"),
        (float("nan"), "ValueError: nan is no share"),
        (None, "TypeError: "),
    ):
        value[0] = wrong
        until(lambda words=words: words in gauge.trouble())  # type: ignore[misc]
        assert gauge.value() == -1.0
    value[0] = 1
    until(lambda: gauge.value() == 1.0)
    assert gauge.trouble() == ""


def test_an_accelerator_counts_as_long_as_it_was_busy() -> None:
    load = NodeLoad()
    for at_ns, busy in ((0, -1.0), (100, 0.5), (300, 1.0), (400, -1.0)):
        load.report(Load("E", 1, at_ns, 0, 0, 0, busy))
    assert load.at(400)[3] - load.at(0)[3] == 250
    assert load.at(200)[3] - load.at(0)[3] == 150


LEAK = (
    "import time\nkept = []\nwhile True:\n    kept.append(bytearray(1 << 20)); time.sleep(0.01)\n"
)
SPEAK = "while True: print('x' * 1000, flush=True)"


def test_memory_that_grows_is_reported(tmp_path: Path) -> None:
    said: list[str] = []
    supervisor = Supervisor(tmp_path, said.append, warm_s=0.2, growth_bytes=8 << 20)
    supervisor.keep("perception@E", [sys.executable, "-c", LEAK])
    try:
        supervisor.step()

        def grown() -> bool:
            supervisor.tend()
            return bool(supervisor.notes())

        until(grown)
    finally:
        supervisor.stop()
    assert supervisor.notes().startswith("perception@E: its memory has grown from ")
    assert supervisor.notes() in said


def test_a_log_does_not_grow_for_ever(tmp_path: Path) -> None:
    supervisor = Supervisor(tmp_path, print, log_bytes=100_000)
    child = supervisor.keep("perception@E", [sys.executable, "-c", SPEAK])
    older = tmp_path / "perception@E.log.1"
    try:
        supervisor.step()

        def began_anew() -> bool:
            supervisor.tend()
            return older.exists()

        until(began_anew)
        until(lambda: child.log.stat().st_size > 0)
    finally:
        supervisor.stop()
    assert older.stat().st_size > 100_000
    # What is appended after the cut follows no hole.
    assert child.log.read_bytes()[:1] != b"\0"


def test_a_log_leaves_out_floods() -> None:
    lines: list[str] = []
    now_s = 0.0
    log = Log(lines.append, every_s=1.0, clock=lambda: now_s)
    for number in range(30):
        log(f"line {number}")
        now_s += 0.125
    assert [line.split(" (")[0] for line in lines] == ["line 0", "line 8", "line 16", "line 24"]
    assert lines[1] == "line 8 (and 7 lines before it)"
