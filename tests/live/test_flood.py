"""Floods and overload: the loop goes on, queues keep to their bounds, and the oldest is dropped."""

from __future__ import annotations

import copy
import random
import tracemalloc
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

import dwell
from dwell.live.host.agent import Agent
from dwell.live.roles.joins import MAX_JOINS
from dwell.live.roles.loads import MOST_PROCESSES, ProcessLoads
from dwell.live.roles.role import MAX_COMPLAINTS
from dwell.live.wire import channels
from dwell.live.wire.messages import MAX_CONTROL_BYTES, Carried, Stamped, decode, encode
from dwell.live.wire.relay_batch import LONGEST_MESSAGE, MOST_MESSAGES, RelayBatch
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from tests.fuzz.targets import seeds
from tests.live.small_world import EXEC_MS, Bench, World, queued

MS = 1_000_000
KB = 1 << 10


def cell(**inputs: int) -> Problem:
    """The canonical cell; some tasks with that many inputs waiting at most."""
    problem = dwell.load("examples/canonical.yaml")
    tasks = {
        name: replace(task, depth=inputs.get(name, task.depth))
        for name, task in problem.pipeline.tasks.items()
    }
    settings = replace(problem.controller, fallbacks=("LOC",), initial="LOC")
    pipeline = replace(problem.pipeline, tasks=tasks)
    return replace(problem, pipeline=pipeline, controller=settings)


# ------------------------------------------------------------------------------- floods


class Flood:
    """Junk under every key a role may hear, at an instant every so often."""

    def __init__(self, world: World, every_ms: float, seed: int = 7) -> None:
        self.world, self.every_ns = world, round(every_ms * MS)
        self.random = random.Random(seed)
        self.wholes = seeds("roles")
        self.count = 0
        self.step()

    def step(self) -> None:
        world = self.world
        # Nobody's keys, and nobody's cell: what would be one's own is no junk.
        for data in self.random.sample(self.wholes, 20):
            junk = bytearray(data)
            junk[self.random.randrange(4, len(junk))] ^= 1 << self.random.randrange(8)
            key = self.random.choice(KEYS).format(root=world.stamper.place.keys.root)
            sample = Arrival(key, self.random.choice([b"\xc1" + bytes(junk), bytes(200)]), b"\xc1")
            for role in world.roles.values():
                role.receive(sample, world.network.now_ns)  # type: ignore[attr-defined]
            self.count += 1
        world.network.call_at(world.network.now_ns + self.every_ns, self.step)


KEYS = (
    *("{root}/in/perception/E/main", "{root}/in/perception/R1/main", "{root}/in/control/R2/main"),
    *("{root}/sink/control", "{root}/done/control", "{root}/ended", "{root}/stamped"),
    *("{root}/order", "{root}/accepted", "{root}/load/E", "{root}/snapshot/planning/E"),
    *("{root}/beat/E/agent@E", "{root}/beat/R1/stamper@R1", "{root}/ask", "{root}/carried"),
    *("{root}/gathered", "{root}/relay/beat/E/agent@E", "{root}/relay/done/control"),
)


def test_a_flood_of_junk_costs_the_loop_no_cycle_and_takes_no_memory() -> None:
    quiet, flooded = (World(cell(), policy="dtp") for _ in range(2))
    for world in (quiet, flooded):
        world.run(500)
    flood = Flood(flooded, every_ms=4.0)
    quiet.run(3_000)
    flooded.run(1_500)
    tracemalloc.start()
    try:
        before = tracemalloc.take_snapshot()
        flooded.run(1_500)
        after = tracemalloc.take_snapshot()
    finally:
        tracemalloc.stop()
    assert flood.count > 12_000
    # The same cycles at the same ages, to the nanosecond.
    assert flooded.arm.applied == quiet.arm.applied
    assert flooded.stamper.moves == quiet.stamper.moves
    ours = [
        tracemalloc.Filter(True, "*/dwell/live/*"),
        tracemalloc.Filter(False, "*/memory_transport.py"),
    ]
    grown = after.filter_traces(ours).compare_to(before.filter_traces(ours), "filename")
    # A second and a half of the cell itself is in it: cycles and windows that are remembered.
    assert sum(one.size_diff for one in grown) < 600 * KB
    for role in flooded.roles.values():
        place = role.worker.place if isinstance(role, Bench) else role.place  # type: ignore[attr-defined]
        assert len(place.complaints) <= MAX_COMPLAINTS


def relay_of(world: World) -> Agent:
    problem = world.problem
    found = world.roles[f"agent@{problem.relay_node}"]
    assert isinstance(found, Agent)
    return found


@pytest.mark.parametrize(
    ("key", "payload"),
    [
        ("done/control", bytes(LONGEST_MESSAGE)),
        ("done/control", bytes(MAX_CONTROL_BYTES)),
        ("done/control", b"x"),
        ("done/" + "x" * 401, b"x"),
        ("order", b"x"),
        ("beat/" + "y" * 500, b"x"),
    ],
)
def test_who_floods_the_relay_does_not_silence_the_detour(key: str, payload: bytes) -> None:
    world = World(cell())
    world.run(100)
    relay, network = relay_of(world), world.network
    bundles: list[tuple[str, bytes]] = []
    keys = relay.place.keys
    ear = network.transport("ear@E", "E")
    network.reach = None
    for one in (keys.of(channels.CARRIED), keys.of(channels.GATHERED)):
        ear.subscribe(one, lambda sample: bundles.append((sample.key, sample.payload)))

    def flood() -> None:
        for _ in range(2_000):
            relay.receive(Arrival(keys.relay(key), payload), network.now_ns)
        network.call_at(network.now_ns + 5 * MS, flood)

    flood()
    world.run(500)
    assert len(bundles) > 20
    carried: set[str] = set()
    for _, bundle in bundles:
        carried |= {one for one, _ in decode(bundle, Carried).messages}
    node, who = relay.place.stamper
    assert {f"beat/{node}/{who}", "done/control", f"load/{node}"} <= carried
    assert "order" not in carried


def test_a_bundle_is_always_short_enough_to_be_read() -> None:
    draw = random.Random(1)
    for newest in (False, True):
        for length in (0, 100, LONGEST_MESSAGE):
            bundle = RelayBatch(newest=newest)
            for number in range(3 * MOST_MESSAGES):
                key = f"done/{number % draw.choice([3, 5_000])}"
                bundle.add(key, bytes(draw.randint(0, length)))
            kept = bundle.taken()
            assert 0 < len(kept) <= MOST_MESSAGES
            assert 2 * len(encode(Carried(tuple(kept)))) <= MAX_CONTROL_BYTES
            assert not bundle.taken()
    bundle = RelayBatch(newest=True)
    for payload in (b"old", b"new"):
        assert bundle.add("beat/E/a", payload)
    assert bundle.taken() == [("beat/E/a", b"new")]


def test_processes_that_a_node_makes_up_are_not_remembered() -> None:
    loads = ProcessLoads()
    for number in range(20):
        loads.report("E", number, [(f"{number}-{each}", 1) for each in range(1_000)])
    known = loads._of
    assert len(known) == len(loads._read) == MOST_PROCESSES
    loads.report("R1", 1, [("sensing@R1", 5)])
    assert ("R1", "sensing@R1") in known


def test_the_controller_believes_no_placement_that_is_no_candidate() -> None:
    world = World(cell(), policy="dtp")
    world.run(500)
    controller: Any = next(r for who, r in world.roles.items() if who.startswith("controller"))
    course = copy.copy(controller.course)
    stamp = Stamped(course.run, 99, course.term + 5, "none", 0)
    controller.receive(
        Arrival(controller.place.keys.of(channels.STAMPED), encode(stamp)), world.network.now_ns
    )
    assert controller.course == course
    assert "'none' holds, which is no candidate" in controller.place.last_complaint


# ----------------------------------------------------------------------------- overload


@pytest.mark.parametrize("depth", [1, 3, 0])
def test_twice_what_a_stage_can_carry_drops_the_oldest(depth: int) -> None:
    """Perception takes two periods; so every other cycle comes through, or none waits for long."""
    problem = cell(perception=depth)
    period_ms = problem.pipeline.period_ms
    live = replace(problem.live, max_age_ms=1e6)
    world = World(
        replace(problem, live=live, controller=replace(problem.controller, fallbacks=())),
        exec_ms={**EXEC_MS, "perception": 2 * period_ms},
        policy="LOC",
    )
    most = 0
    for _ in range(120):
        world.run(period_ms)
        most = max(most, *queues(world))
    limit = depth or 10 * MAX_JOINS
    assert most <= limit
    applied = world.cycles
    assert applied == sorted(set(applied))
    # It carries on at half the rate.
    assert 45 <= len(applied) <= 61
    if depth:
        # What came through waited for `depth` others at most, each two periods, and its own.
        ages_ms = [age_ms for _, age_ms in world.arm.applied]
        assert max(ages_ms) <= (2 * depth + 3) * period_ms + 20
        steps = [later - before for before, later in pairwise(applied)]
        assert set(steps[depth + 3 :]) <= {1, 2, 3}
        assert world.worker("perception@R1").replaced >= 50


def queues(world: World) -> list[int]:
    """How many jobs wait, or inputs of jobs, at every worker."""
    found = []
    for role in world.roles.values():
        if isinstance(role, Bench):
            jobs, forked, joins = queued(role.worker)
            found += [jobs, forked, *joins]
    return found
