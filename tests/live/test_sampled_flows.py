"""Live cells in which a task does not wait for an input, but takes the newest message."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest

from dwell.live.stage import Message
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.signing import Seals
from dwell.live.wire import channels
from dwell.live.wire.messages import RatedCompletion, RatedHeader, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from tests.live.memory_transport import NetworkConditions
from tests.live.rated_cells import P_MS, SLOW, sampling, world_of
from tests.live.small_world import MS, Passing, Staying, World, columns


@dataclass
class Log:
    """Inputs of the controller's jobs on all nodes, in the order of the calls."""

    inputs: list[Mapping[str, Message]] = field(default_factory=list)

    def stage(self, name: str) -> Passing:
        return _Controller(name, self)

    @property
    def samples(self) -> list[int | None]:
        """Cycles of the values; None for a job without one."""
        got = (inputs.get("detect") for inputs in self.inputs)
        return [None if message is None else message.cycle for message in got]


class _Controller(Passing):
    def __init__(self, name: str, log: Log) -> None:
        super().__init__(name)
        self.log = log

    def process(self, inputs: Mapping[str, Message]) -> Message:
        self.log.inputs.append(inputs)
        return Message(b"go")


def logged(problem: Problem, **more: Any) -> tuple[World, Log]:
    log = Log()
    return world_of(problem, stages={"control": log.stage}, **more), log


def require_never_older(samples: list[int | None]) -> None:
    known = [cycle for cycle in samples if cycle is not None]
    assert all(later >= earlier for earlier, later in pairwise(known))


def test_a_job_gets_the_newest_value_as_a_message_of_its_own_cycle() -> None:
    world, log = logged(sampling())
    world.run(1_000)
    steady = log.inputs[3 * SLOW :]
    assert len(steady) > 70
    for inputs in steady:
        imu, value = inputs["imu"], inputs["detect"]
        # The detection of a picture comes after the first job of its cycle has begun.
        assert value.cycle == (imu.cycle - 1) // SLOW * SLOW
        behind_ns = (imu.cycle - value.cycle) * P_MS * MS
        assert imu.released_ns - value.released_ns == pytest.approx(behind_ns, abs=10)
        assert value.age_ms - imu.age_ms == pytest.approx(behind_ns / MS, abs=1e-3)
        assert value.origins == {"camera": value.cycle}
        assert imu.origins == {"imu": imu.cycle}
    # The controller does not wait for the detector.
    assert {later - earlier for earlier, later in pairwise(world.cycles)} == {1}


def hear(world: World, channel: Any) -> list[Arrival]:
    """Return a list that gets all messages of a channel, except copies on the detour."""
    heard: list[Arrival] = []

    def tap(sample: Arrival) -> None:
        if world.keys.word(sample.key) == channel.word and world.keys.came_directly(sample.key):
            heard.append(sample)

    world.network.taps.append(tap)
    return heard


def test_hops_of_a_sampled_task_belong_to_their_own_cycle() -> None:
    world, _ = logged(sampling(), policy=Staying(), jobs=True)
    done = hear(world, channels.DONE)
    world.run(1_000)
    for sample in done:
        completion = decode(sample.payload, RatedCompletion)
        assert [hop.task for hop in completion.hops] == ["imu", "control", "act"]
    rows = columns(world, "windows", "l95_ms", "violation_rate", "unproven")
    assert len(rows) >= 3
    assert all(l95_ms < 6 and not rate and not unproven for l95_ms, rate, unproven in rows)
    numbers = [number for (number,) in columns(world, "cycles", "number")]
    jobs = [row for row in world.recorder.rows["jobs"] if row[1] == "detect"]
    assert len(jobs) > 8
    assert {numbers[int(str(row[0]))] % SLOW for row in jobs} == {0}


@pytest.mark.parametrize("seed", range(3))
def test_no_value_is_older_than_one_used_before(seed: int) -> None:
    draw = Random(seed)
    world, log = logged(sampling(), seed=seed)
    noise = NetworkConditions(
        duplication=0.2, reordering=0.3, reorder_ns=70 * MS, loss=0.05, delay_ns=MS
    )
    world.run(300)
    for node in ("R", "E"):
        world.network.impair(noise, f"detect@{node}")
    forwards = hear(world, channels.VALUE)
    for _ in range(12):
        world.run(draw.uniform(30, 150))
        world.order(draw.choice(["LOC", "AWAY", "SPLIT"]))
    world.run(200)
    require_never_older(log.samples)
    assert len({*log.samples}) > 10
    assert forwards


def run_up_to_a_picture(world: World) -> None:
    """Let time pass until just after a release of the camera."""
    world.run(2 * P_MS)
    while world.stamper.cycle % SLOW != 1:
        world.run(1)


def test_an_old_node_forwards_its_value_and_what_still_arrives() -> None:
    world, log = logged(sampling())
    world.run(500)
    slow = NetworkConditions(delay_ns=25 * MS)
    # The detection of the last picture before the move is still on its way to the old node.
    world.network.impair(slow, "detect@R", "control@R")
    run_up_to_a_picture(world)
    forwards = hear(world, channels.VALUE)
    assert world.order("AWAY") == ""
    before = len(log.inputs)
    world.run(40)
    cycles = [decode(sample.header, RatedHeader).stamp.cycle for sample in forwards]
    assert [cycle % SLOW for cycle in cycles] == [0, 0]
    assert cycles[1] - cycles[0] == SLOW
    keys = {sample.key for sample in forwards}
    assert keys == {world.keys.of(channels.VALUE, "control", "E", "R")}
    assert None not in log.samples[before + 1 :]
    require_never_older(log.samples)


def test_without_a_direct_link_there_is_no_value_until_the_next_message() -> None:
    away = {"on": "E", "initial": "AWAY"}
    world, log = logged(sampling(linked_back=False, controller=away))
    world.run(500)
    run_up_to_a_picture(world)
    world.run(P_MS)
    forwards, before = hear(world, channels.VALUE), len(log.inputs)
    assert world.order("LOC") == ""
    world.run(200)
    assert forwards == []
    without = [place for place, cycle in enumerate(log.samples) if cycle is None and place > before]
    assert 2 <= len(without) < SLOW
    assert without == list(range(without[0], without[-1] + 1))
    require_never_older(log.samples)


def test_the_first_job_after_a_return_gets_no_value_from_before_the_move() -> None:
    world, log = logged(sampling(waited=False))
    for placement in ("AWAY", "LOC", "AWAY", "LOC"):
        world.run(300)
        assert world.order(placement) == ""
    world.run(100)
    require_never_older(log.samples)


class _StatefulController(_Controller):
    def snapshot(self) -> bytes:
        return b"-"

    def restore(self, state: bytes) -> None:
        pass


def test_jobs_that_follow_a_state_get_no_value_from_before_the_move() -> None:
    on: dict[str, Any] = {"R": {"exec_ms": 1}}
    tasks: dict[str, Any] = {name: {"on": on} for name in ("imu", "detect", "act")}
    tasks["camera"] = {"every": SLOW, "on": on}
    tasks["control"] = {"state_bytes": 100, "on": {**on, "E": {"exec_ms": 1}}}
    candidates = {"LOC": {"control": "R"}, "AWAY": {"control": "E"}}
    problem, log = sampling(tasks=tasks, candidates=candidates), Log()
    stages = {"control": lambda name: _StatefulController(name, log)}
    world = world_of(problem, stages=stages, policy=Staying())
    for placement in ("AWAY", "LOC", "AWAY", "LOC"):
        world.run(500)
        world.pin(placement)
    world.run(500)
    assert world.stamper.placement == "LOC"
    require_never_older(log.samples)


def test_a_task_with_sampled_inputs_alone_runs_no_more_where_it_was() -> None:
    away = {"on": "E", "initial": "AWAY"}
    world, log = logged(sampling(waited=False, controller=away))
    world.run(300)
    assert world.order("LOC") == ""
    world.run(2 * P_MS)
    before = len(log.inputs)
    world.run(10 * P_MS)
    assert len(log.inputs) - before == 10


def test_a_task_with_sampled_inputs_alone_is_released_like_a_source() -> None:
    world, log = logged(sampling(waited=False))
    world.run(500)
    world.order("AWAY")
    world.run(500)
    assert {later - earlier for earlier, later in pairwise(world.cycles)} == {1}
    assert None not in log.samples[2 * SLOW : 45]
    assert log.samples[-1] is not None


def test_three_rates_survive_the_death_of_each_worker() -> None:
    on: dict[str, Any] = {"R": {"exec_ms": 1}}
    spare: dict[str, Any] = {"R": {"exec_ms": 1, "standby": 1}}
    tasks: dict[str, Any] = {
        "camera": {"every": 2 * SLOW, "on": on},
        "lidar": {"every": SLOW, "on": on},
        "imu": {"on": on},
        "detect": {"on": on},
        "control": {"on": spare},
    }
    flows = [
        {"from": "camera", "to": "detect"},
        {"from": "imu", "to": "control"},
        {"from": "detect", "to": "control", "sampled": True},
        {"from": "lidar", "to": "control", "sampled": True},
    ]
    problem = sampling(tasks=tasks, flows=flows, candidates={"LOC": {}}, controller={"on": "E"})
    world, log = logged(problem)
    world.run(500)
    world.kill("detect@R")
    world.run(300)
    begun = len(world.cycles)
    assert {later - earlier for earlier, later in pairwise(world.cycles)} == {1}
    assert log.samples[-1] == log.samples[-20]
    world.start("detect@R")
    world.kill("control@R")
    world.run(500)
    most = problem.controller.guard_cycles + 1
    gaps = {later - earlier - 1 for earlier, later in pairwise(world.cycles)}
    assert max(gaps) <= most
    assert len(world.cycles) > begun + 40
    assert log.inputs[-1].keys() == {"imu", "detect", "lidar"}
    assert log.samples[-1] != log.samples[-20]


def test_a_worker_that_was_frozen_uses_no_value_older_than_its_standby_did() -> None:
    on: dict[str, Any] = {"R": {"exec_ms": 1}}
    tasks: dict[str, Any] = {name: {"on": on} for name in ("imu", "detect", "act")}
    tasks["camera"] = {"every": SLOW, "on": on}
    tasks["control"] = {"on": {"R": {"exec_ms": 1, "standby": 1}}}
    problem, log = sampling(tasks=tasks, candidates={"LOC": {}}, controller={"on": "E"}), Log()
    exec_ms = dict.fromkeys(tasks, 1.0) | {"control": 0.1}
    world = World(problem, exec_ms=exec_ms, stages={"control": log.stage})
    world.run(500)
    run_up_to_a_picture(world)
    world.network.freeze("control@R")
    # What the detector sends to it meanwhile is lost, or arrives after messages of faster sources.
    late = world.network.cut("detect@R", "control@R")
    world.run(300)
    before = len(world.cycles)
    world.network.thaw("control@R")
    world.run(2.5 * P_MS)
    world.network.heal(late)
    world.run(300)
    assert {later - earlier for earlier, later in pairwise(world.cycles[before - 1 :])} == {1}
    used: dict[int, int | None] = {}
    for inputs, value in zip(log.inputs, log.samples, strict=True):
        used.setdefault(inputs["imu"].cycle, value)
    require_never_older([used[cycle] for cycle in sorted(used)])
    assert log.samples[-1] == world.stamper.cycle // SLOW * SLOW


#: Messages that arrive after those of the next run.
OVERTAKEN = NetworkConditions(reordering=1.0, reorder_ns=80 * MS)


def test_a_join_that_no_sink_waits_for_keeps_overlapping_cycles() -> None:
    on = {"R": {"exec_ms": 1}}
    tasks: dict[str, Any] = {name: {"on": on} for name in ("imu", "detect", "control")}
    tasks |= {name: {"every": SLOW, **tasks["imu"]} for name in ("camera", "lidar")}
    flows = [
        {"from": "camera", "to": "detect"},
        {"from": "lidar", "to": "detect"},
        {"from": "imu", "to": "control"},
        {"from": "detect", "to": "control", "sampled": True},
    ]
    problem = sampling(tasks=tasks, flows=flows, candidates={"LOC": {}}, controller={"on": "E"})
    ran: list[int] = []

    class Detecting(Passing):
        def process(self, inputs: Mapping[str, Message]) -> Message:
            ran.append(inputs["lidar"].cycle)
            return super().process(inputs)

    world = world_of(problem, stages={"detect": Detecting})
    world.run(300)
    run_up_to_a_picture(world)
    late = world.network.impair(OVERTAKEN, "lidar@R", "detect@R")
    world.run(P_MS)
    world.network.heal(late)
    world.run(300)
    assert ran != sorted(ran)
    assert sorted(ran) == list(range(min(ran), max(ran) + 1, SLOW))


def guarded(**changes: Any) -> Problem:
    controller = {"on": "E", "initial": "LOC", "fallbacks": ["LOC"], "probe_cycles": 10}
    return sampling(controller=controller, **changes)


@pytest.mark.parametrize("arrives", [True, False])
def test_a_probe_is_complete_when_its_sampled_output_has_arrived(arrives: bool) -> None:
    world, _ = logged(guarded(), policy="SPLIT")
    world.run(300)
    world.move_by_guard("LOC")
    if not arrives:
        world.network.cut("detect@E.shadow", "control@R")
    # Only every fifth cycle has a probe that counts.
    world.run(10 * SLOW * P_MS)
    assert world.stamper.placement == "LOC"
    world.run(1_000)
    assert world.stamper.placement == ("SPLIT" if arrives else "LOC")


CHAINS = {"see-act": {"from": "camera", "to": "act", "max_age_ms": 50}}


def test_recorded_ages_are_those_of_the_jobs(tmp_path: Path) -> None:
    world, log = logged(sampling(chains=CHAINS), policy=Staying())
    done = hear(world, channels.DONE)
    world.run(400)
    world.order("AWAY")
    world.run(600)
    sampled = {inputs["imu"].cycle: inputs.get("detect") for inputs in log.inputs}
    age_ms: dict[int, float] = {}
    reactions_ms: dict[int, list[float]] = {}
    first = origin = newest = 0
    for completion in (decode(sample.payload, RatedCompletion) for sample in done):
        stamp = completion.stamp
        first = first or stamp.released_ns - stamp.cycle * P_MS * MS
        value = sampled[stamp.cycle]
        origin = origin if value is None else value.cycle
        at_ms = (completion.done_ns - first) / MS
        age_ms[stamp.cycle] = at_ms - origin * P_MS
        waited = [at_ms - one * P_MS for one in range(newest, origin, SLOW)]
        reactions_ms[stamp.cycle], newest = waited, max(newest, origin)
    numbers = [number for (number,) in columns(world, "cycles", "number")]
    names = (f"{of}_see-act" for of in ("age_l95", "age_missed", "reaction_l95"))
    windows = columns(world, "windows", "first_cycle", *names)
    assert len(windows) >= 3
    for row, l95_ms, missed, reaction_ms in windows:
        waits = [ms for number in numbers[row : row + 20] for ms in reactions_ms[number]]
        assert reaction_ms == pytest.approx(max(waits))
        assert len(waits) >= 3
        ages = [age_ms[number] for number in numbers[row : row + 20]]
        assert l95_ms == pytest.approx(sorted(ages)[18])
        assert missed == sum(age > 50 for age in ages) / 20
    assert any(missed for _, _, missed, _ in windows)


def test_ages_after_a_move_of_the_guard_count_from_the_newest_data_before_it() -> None:
    chains = {"see-act": {"from": "camera", "to": "act"}}
    controller = {"on": "E", "initial": "AWAY", "fallbacks": ["LOC"]}
    world, log = logged(sampling(chains=chains, controller=controller), policy=Staying())
    world.run(600)
    # The first jobs after the move have no value.
    world.network.cut("control@E", "control@R")
    run_up_to_a_picture(world)
    world.run(P_MS)
    world.move_by_guard("LOC")
    world.run(500)
    assert log.samples[-60:].count(None) >= 3
    names = "placement", "lead", "age_l95_see-act"
    windows = columns(world, "windows", *names)
    (after,) = (age_ms for placed, lead, age_ms in windows if placed == "LOC" and lead)
    assert after < 2 * SLOW * P_MS


def test_a_cycle_whose_data_are_too_old_is_missed() -> None:
    world, _ = logged(sampling(chains=CHAINS), policy=Staying())
    world.run(1_000)
    windows = columns(world, "windows", "first_cycle", "violation_rate", "age_missed_see-act")
    windows = windows[1:]
    # At the command just before a new detection the picture is over 50 ms old.
    assert {missed for _, _, missed in windows} == {0.2}
    assert {rate for _, rate, _ in windows} == {0.2}
    rows = columns(world, "cycles", "number", "missed")[windows[0][0] :]
    assert {number % SLOW for number, missed in rows if missed} == {0}
    seen = columns(world, "decisions", "seen_violation_rate")
    assert max(rate for (rate,) in seen) == 0.2


def test_the_guard_leaves_a_placement_whose_detector_is_dead() -> None:
    controller = {"on": "E", "initial": "SPLIT", "fallbacks": ["LOC"]}
    world, log = logged(sampling(chains=CHAINS, controller=controller))
    world.run(600)
    assert world.stamper.moves == []
    world.kill("detect@E")
    world.run(600)
    assert world.stamper.placement == "LOC"
    # Commands continue while the detector is dead, and have new pictures behind them later.
    assert {later - earlier for earlier, later in pairwise(world.cycles)} == {1}
    newest = log.samples[-1]
    assert newest is not None
    assert newest >= world.stamper.cycle - 2 * SLOW


@pytest.fixture
def seals(tmp_path: Path) -> dict[str, Seals]:
    authority = Authority.create(tmp_path, "cell")
    for node in ("R", "E"):
        authority.issue(node, "node")
    authority.issue("controller", "controller")
    names = "R", "E", "controller"
    return {name: Seals(Keyring.open(tmp_path / name, cell="cell")) for name in names}


def test_a_forwarded_value_needs_the_signature_of_its_stamp(seals: dict[str, Seals]) -> None:
    world, log = logged(sampling(), seals=seals, policy=Staying())
    world.run(500)
    forwards = hear(world, channels.VALUE)
    world.move_by_guard("AWAY")
    world.run(300)
    assert forwards
    require_never_older(log.samples)
    worker = world.worker("control@E")
    header = decode(forwards[-1].header, RatedHeader)
    newest = max(cycle for cycle in log.samples if cycle is not None)
    for cycle, is_signed in ((header.stamp.cycle, True), (newest + 1_000, False)):
        stamp = msgspec.structs.replace(header.stamp, cycle=cycle)
        forged = encode(msgspec.structs.replace(header, stamp=stamp))
        before = worker.place.complained
        worker.receive(Arrival(forwards[-1].key, b"-", forged), world.network.now_ns)
        assert worker.place.complained == before + (not is_signed)
    world.run(50)
    assert log.samples[-1] is not None
    assert log.samples[-1] < newest + 1_000


def senders(problem: Problem, word: str) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    for chunks, names in channels.CHANNELS[word].senders(problem):
        yield tuple(chunks), sorted(names)


def test_only_old_nodes_of_a_sampling_task_may_forward_values() -> None:
    problem = sampling()
    assert dict(senders(problem, "value")) == {
        ("control", "E", "R"): ["R"],
        ("control", "R", "E"): ["E"],
    }
    may_send = dict(senders(sampling(waited=False), "in"))
    assert may_send["control", "E", "main"] == ["E", "R"]


def test_a_task_with_sampled_inputs_alone_is_proven_by_its_shadows() -> None:
    controller = {"on": "E", "initial": "AWAY", "fallbacks": ["LOC"], "probe_cycles": 10}
    world, log = logged(sampling(waited=False, controller=controller), policy="AWAY")
    world.run(300)
    world.move_by_guard("LOC")
    begun = len(log.inputs)
    world.run(8 * P_MS)
    assert world.stamper.placement == "LOC"
    # One job per cycle, and one of its shadow: the worker on the other node runs no job itself.
    assert len(log.inputs) - begun <= 16
    world.run(1_000)
    assert world.stamper.placement == "AWAY"
    assert {later - earlier for earlier, later in pairwise(world.cycles)} == {1}
