"""The live protocol on the in-memory network: what holds when things die, by rule and number."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dwell.live.roles.state_transfer import Chore
from dwell.live.stage import Message
from dwell.live.wire import channels
from dwell.live.wire.messages import Completion, Order, Stamp, State, encode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from tests.live.memory_transport import Clock, NetworkConditions
from tests.live.small_world import MS, Counting, Passing, World, canonical, on, stateful

EDGE = ("perception@E", "perception@E.shadow", "planning@E", "planning@E.shadow", "agent@E")


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC", "HYB", "SO"))


def longest_gap(cycles: list[int], last: int) -> int:
    """Most consecutive cycles without an actuation, those at the end included."""
    return max(later - earlier - 1 for earlier, later in pairwise([*cycles, last]))


def lost(world: World) -> int:
    """Most consecutive cycles that were lost; the last two may be on their way."""
    return longest_gap(world.cycles, world.stamper.cycle - 2)


def running(problem: Problem, candidate: str, ms: float = 1_000) -> World:
    """A cell that has run on a candidate for a while, with nobody who gives orders."""
    world = World(on(problem, candidate))
    world.run(ms)
    return world


def require_ordered(world: World) -> None:
    assert world.cycles == sorted(set(world.cycles)), "an actuation twice, or out of order"


Fault = Callable[[World], None]


def freeze(*names: str) -> Fault:
    def apply(world: World) -> None:
        for who in names:
            world.network.freeze(who)

    return apply


def kill(*names: str) -> Fault:
    def apply(world: World) -> None:
        for who in names:
            world.kill(who)

    return apply


def cut(source: str, target: str) -> Fault:
    def apply(world: World) -> None:
        world.network.cut(source, target)

    return apply


SINGLE_FAULTS: dict[str, tuple[str, Fault]] = {
    "E frozen": ("SO", freeze(*EDGE)),
    "E dead": ("SO", kill(*EDGE)),
    "E dead under HYB": ("HYB", kill(*EDGE)),
    "perception on E frozen": ("SO", freeze("perception@E")),
    "planning on E killed": ("SO", kill("planning@E")),
    "R1 to E cut": ("SO", cut("R1", "E")),
    "E to R1 cut": ("SO", cut("E", "R1")),
    "E to R2 cut": ("SO", cut("E", "R2")),
    "R2 to E cut": ("HYB", cut("R2", "E")),
    "R1 to R2 cut": ("LOC", cut("R1", "R2")),
    "R2 to R1 cut": ("LOC", cut("R2", "R1")),
    "perception on R1 frozen": ("LOC", freeze("perception@R1")),
    "perception on R1 killed": ("LOC", kill("perception@R1")),
    "planning on R2 frozen": ("LOC", freeze("planning@R2")),
    "agent of E killed": ("SO", kill("agent@E")),
    "agent of R1 killed": ("LOC", kill("agent@R1")),
}


@pytest.mark.parametrize("name", SINGLE_FAULTS)
@settings(max_examples=4)
@given(phase=st.floats(0, 1))
def test_rule_5_bounds_what_a_single_fault_costs(problem: Problem, name: str, phase: float) -> None:
    candidate, fault = SINGLE_FAULTS[name]
    period_ms = problem.pipeline.period_ms
    world = running(problem, candidate, (30 + phase) * period_ms)
    assert world.stamper.placement == candidate
    assert len(world.cycles) >= 28
    fault(world)
    world.run(30 * period_ms)
    require_ordered(world)
    missing = lost(world)
    assert missing <= problem.controller.guard_cycles + 1
    harmless = name.startswith("agent")
    assert (world.stamper.placement == candidate) == (harmless or not missing)


SECOND_FAULTS: dict[str, tuple[Fault, str]] = {
    "perception on R1 frozen": (freeze("perception@R1"), "HYB"),
    "planning on R2 killed": (kill("planning@R2"), "SO"),
}


@pytest.mark.parametrize("name", SECOND_FAULTS)
@settings(max_examples=4)
@given(phase=st.floats(0, 1))
def test_rule_5_bounds_a_fault_after_the_guards_own_move_too(
    problem: Problem, name: str, phase: float
) -> None:
    # Nobody confirms the fallback: it may be what the controller wants, or there is none.
    fault, expected = SECOND_FAULTS[name]
    world = running(problem, "SO")
    world.network.freeze("perception@E")
    world.run(500)
    assert world.stamper.placement == "LOC"
    assert world.stamper.guard.resting
    world.network.thaw("perception@E")
    rest = problem.controller.probe_cycles
    world.run((rest + phase) * problem.pipeline.period_ms)
    guard = world.stamper.guard
    assert guard.on_fallback
    assert not guard.resting
    before = len(world.cycles)
    fault(world)
    world.run(30 * problem.pipeline.period_ms)
    assert world.stamper.placement == expected
    gap = longest_gap(world.cycles[before - 1 :], world.stamper.cycle - 2)
    assert 0 < gap <= problem.controller.guard_cycles + 1
    require_ordered(world)


def test_rule_5_the_guard_rests_after_its_own_move(problem: Problem) -> None:
    world = running(problem, "SO")
    world.network.freeze("perception@E")
    world.run(500)
    world.network.freeze("perception@R1")
    world.run(500)
    assert world.stamper.placement == "LOC"
    world.network.thaw("perception@E")
    world.run(2 * problem.controller.probe_cycles * problem.pipeline.period_ms)
    # Cycles that were released after its rest, still under the silence, are waited for.
    assert world.stamper.placement == "HYB"
    assert world.stamper.guard.on_fallback


class Broken(Passing):
    """A stage that raises in every cycle, if it is told to."""

    broken = False

    def process(self, inputs: Mapping[str, Message]) -> Message:
        if self.broken:
            raise ValueError("no plan")
        return super().process(inputs)


def break_stage(world: World, who: str, *, broken: bool = True) -> None:
    stage = world.worker(who).stage
    assert isinstance(stage, Broken)
    stage.broken = broken


def test_rule_5_a_stage_that_fails_on_one_node_is_left_behind(problem: Problem) -> None:
    """LOC and HYB need the planner on R2, SO does not; all that lives goes on beating."""
    world = World(on(problem, "LOC"), stages={"planning": Broken})
    world.run(1_000)
    break_stage(world, "planning@R2")
    world.run(2_000)
    guard_cycles = problem.controller.guard_cycles
    assert world.stamper.placement == "SO"
    assert [name for _, name, _ in world.stamper.moves] in (["SO"], ["HYB", "SO"])
    assert lost(world) <= 2 * (guard_cycles + 1)
    beat = world.stamper.pulse.detector.last("planning@R2")
    assert beat is not None
    assert not beat.ready
    assert "calls in a row" in beat.note
    # It is worth a try when nothing has been heard to fail for ten seconds.
    world.run(11_000)
    beat = world.stamper.pulse.detector.last("planning@R2")
    assert beat is not None
    assert beat.ready


def test_one_success_makes_a_worker_ready_again(problem: Problem) -> None:
    unguarded = replace(problem, controller=replace(problem.controller, fallbacks=()))
    world = World(on(unguarded, "LOC"), stages={"perception": Broken})
    world.run(1_000)
    break_stage(world, "perception@R1")
    world.run(500)
    assert world.order("HYB") == ""
    assert world.order("LOC").startswith("not ready: perception@R1")
    world.run(500)
    break_stage(world, "perception@R1", broken=False)
    # A failure or two are no more than a cycle or two each.
    world.run(10_000)
    assert world.order("LOC") == ""
    break_stage(world, "perception@R1")
    world.run(500)
    beat = world.stamper.pulse.detector.last("perception@R1")
    assert beat is not None
    assert not beat.ready
    break_stage(world, "perception@R1", broken=False)
    world.run(2.5 * problem.pipeline.period_ms)
    beat = world.stamper.pulse.detector.last("perception@R1")
    assert beat is not None
    assert (beat.ready, world.stamper.placement) == (True, "LOC")


def test_rule_5_images_that_do_not_arrive_are_no_sign_of_life(problem: Problem) -> None:
    """Beats pass from R1 to E, images do not: HYB and SO are tried once, LOC when it is back."""
    world = running(problem, "LOC")
    world.network.cut("R1", "E", key="**/in/**")
    world.network.freeze("perception@R1")
    world.run(1_000)
    tried = [name for _, name, _ in world.stamper.moves]
    assert tried == ["HYB", "SO"]
    begun = world.stamper.cycle
    world.network.thaw("perception@R1")
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    last = [cycle for cycle in world.cycles if cycle >= begun]
    # A beat, the move, and the cycle that is on its way.
    assert last[0] - begun <= problem.controller.guard_cycles + 1
    require_ordered(world)


def test_rule_5_what_shadows_fail_through_is_not_whole(problem: Problem) -> None:
    controller = replace(problem.controller, fallbacks=("SO", "HYB"))
    world = running(replace(problem, controller=controller), "LOC")
    stamper = world.stamper
    stamper.shadow_fraction = 0.4
    world.network.cut("E", "E", key="**/in/planning/E/shadow")
    world.run(2_000)
    assert stamper.guard.presence.whole("SO", world.network.now_ns)
    world.kill("perception@R1")
    world.run(1_000)
    assert [name for _, name, _ in stamper.moves] == ["HYB"]
    assert lost(world) <= problem.controller.guard_cycles + 1


def test_rule_5_a_cycle_of_the_placement_before_says_nothing_of_this_one(problem: Problem) -> None:
    world = running(problem, "SO")
    world.network.cut(key="**/in/**")
    while world.stamper.placement == "SO":
        world.run(1)
    world.run(1.5 * problem.pipeline.period_ms)
    stamper = world.stamper
    cycle = stamper.cycle - 1
    for placement, carries in (("SO", False), (stamper.placement, True)):
        stamp = Stamp(stamper.run, cycle, stamper.term, placement, world.network.now_ns)
        done = Completion(stamp, "control", world.network.now_ns, "actuated", (), "R2")
        arrival = Arrival(world.keys.of(channels.DONE, "control"), encode(done))
        stamper._partial.clear()
        stamper.receive(arrival, world.network.now_ns)
        assert stamper.guard.carries == carries


def test_rule_5_holds_without_a_controller(problem: Problem) -> None:
    world = running(problem, "SO", 3_000)
    assert lost(world) == 0
    assert world.stamper.placement == "SO"


def test_rule_6_leaves_a_fallback_only_by_proof(problem: Problem) -> None:
    world = running(problem, "SO")
    cuts = [world.network.cut("R1", "E"), world.network.cut("E", "R1")]
    world.run(500)
    assert world.stamper.placement == "LOC"
    assert world.order("SO").startswith("not ready")
    for rule in cuts:
        world.network.heal(rule)
    world.run(500)
    assert world.order("SO").startswith("not proven")
    probes = world.stamper.guard.probation.needed
    world.run((probes - 5) * problem.pipeline.period_ms)
    assert world.order("SO").startswith("not proven")
    world.run(10 * problem.pipeline.period_ms)
    assert not world.order("SO")
    world.run(500)
    assert world.stamper.placement == "SO"
    require_ordered(world)


def test_rule_6_doubles_the_proof_after_a_relapse(problem: Problem) -> None:
    world = running(problem, "SO")
    before = world.stamper.guard.probation.needed
    world.network.freeze("perception@E")
    world.run(500)
    world.network.thaw("perception@E")
    world.run(500)
    world.order("SO")
    world.run((before + 10) * problem.pipeline.period_ms)
    world.order("SO")
    world.run(200)
    assert world.stamper.placement == "SO"
    world.network.freeze("perception@E")
    world.run(500)
    assert world.stamper.guard.probation.needed == 2 * before


def test_rule_1_numbers_grow_across_restarts_of_the_stamper(problem: Problem) -> None:
    world = running(problem, "HYB")
    last = world.cycles[-1]
    world.kill("stamper@R1")
    world.run(200)
    world.start("stamper@R1")
    world.run(1_000)
    assert world.cycles[-1] > last + 20
    assert world.stamper.placement == "HYB"
    require_ordered(world)


def test_rule_1_a_stamper_that_lost_its_book_begins_a_later_run(problem: Problem) -> None:
    world = running(problem, "LOC")
    count = len(world.cycles)
    world.kill("stamper@R1")
    world.book.entry = None
    world.run_id += 1
    world.start("stamper@R1")
    world.run(1_000)
    assert len(world.cycles) > count + 20


def test_rule_2_orders_die_with_their_term(problem: Problem) -> None:
    world = running(problem, "LOC")
    term = world.stamper.term
    assert not world.order("SO")
    assert world.order("HYB", term=term).startswith("stale term")
    assert world.order("HYB", run=77).startswith("stale run")
    assert world.order("NOWHERE").startswith("infeasible")
    assert world.stamper.placement == "SO"


def test_rule_2_an_order_twice_is_one_order(problem: Problem) -> None:
    world = running(problem, "LOC")
    order = Order(5, "me", world.stamper.run, world.stamper.term, "SO")
    answers = [world.answer(order) for _ in range(3)]
    assert len(world.stamper.moves) == 1
    assert not answers[0].refused
    assert answers == [answers[0]] * 3


def test_rule_2_a_second_controller_is_refused_by_name(problem: Problem) -> None:
    world = running(problem, "LOC")
    assert not world.order("SO")
    refused = world.order("LOC", controller="other")
    assert refused == "another controller: me is in charge"
    world.run(2_000)
    assert not world.order("LOC", controller="other")


@pytest.mark.parametrize("candidate", ["LOC", "SO", "HYB"])
def test_rule_7_a_restarted_sink_replays_nothing(problem: Problem, candidate: str) -> None:
    world = running(problem, candidate)
    world.kill("sink.control@R2")
    world.run(60)
    world.start("sink.control@R2")
    world.run(1_000)
    require_ordered(world)
    assert world.cycles[-1] > 50


def test_rule_7_the_watchdog_speaks_when_no_command_comes(problem: Problem) -> None:
    world = running(problem, "LOC")
    assert world.arm.silences == 0
    world.kill("control@R2")
    world.run(1_000)
    assert world.arm.silences == 1


def test_rule_7_a_sink_that_takes_over_is_impatient_at_once(problem: Problem) -> None:
    world = running(problem, "LOC")
    world.kill("sink.control@R2")
    world.kill("control@R2")
    assert world.arm.silences == 0
    world.start("sink.control@R2")
    world.run(1_000)
    assert world.arm.silences == 1


def test_rule_7_an_old_command_is_never_applied(problem: Problem) -> None:
    world = running(problem, "SO")
    stalled = world.network.stall("E", "R2")
    world.run(70)
    world.network.heal(stalled)
    world.run(1_000)
    limit_ms = 2 * problem.pipeline.period_ms
    assert max(age_ms for _, age_ms in world.arm.applied) <= limit_ms
    require_ordered(world)


@pytest.mark.parametrize("offset_s", [0, 3_600, -86_400 * 365])
def test_rule_11_ages_hold_whatever_the_clocks_show(problem: Problem, offset_s: int) -> None:
    clocks = {"R2": Clock(offset_s * 1_000 * MS, 80.0), "E": Clock(5 * MS, -50.0)}
    world = World(on(problem, "SO"), clocks=clocks)
    world.run(3_000)
    assert longest_gap(world.cycles[3:], world.stamper.cycle - 2) == 0
    assert max(age_ms for _, age_ms in world.arm.applied[10:]) < 30


@pytest.mark.parametrize("who", ["control@R2", "perception@R1"])
def test_rule_12_a_standby_takes_over(problem: Problem, who: str) -> None:
    task, _, node = who.partition("@")
    tasks = dict(problem.pipeline.tasks)
    on_nodes = {**tasks[task].on, node: replace(tasks[task].on[node], standby=1)}
    tasks[task] = replace(tasks[task], on=on_nodes)
    cell = on(replace(problem, pipeline=replace(problem.pipeline, tasks=tasks)), "LOC")
    cell = replace(cell, controller=replace(cell.controller, fallbacks=()))
    world = World(cell)
    world.run(1_000)
    assert not world.worker(f"{who}.1").active
    world.network.freeze(who)
    frozen_ns = world.network.now_ns
    while not world.worker(f"{who}.1").active:
        world.run(1)
    # Its last beat is up to a period old, and the standby looks with the next input.
    silent = (world.network.now_ns - frozen_ns) / (problem.pipeline.period_ms * MS)
    assert 1 <= silent <= 3
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    assert lost(world) <= 4
    world.network.thaw(who)
    world.run(1_000)
    assert lost(world) <= 4
    require_ordered(world)


def test_rule_2_an_order_moves_nothing_after_a_later_one(problem: Problem) -> None:
    world = running(problem, "LOC")
    world.number = 7
    assert world.order("") == ""
    world.number = 3
    assert world.order("SO") == "stale order: 4, after 8"
    assert world.stamper.placement == "LOC"
    world.number = 8
    assert world.order("SO") == ""
    assert world.stamper.placement == "SO"


def counting(problem: Problem, candidate: str, **more: Any) -> World:
    """A world whose planning counts its cycles, and whose cell file says that it has a state."""
    cell = on(stateful(problem, "planning", 100), candidate)
    return World(cell, stages={"planning": Counting}, policy=candidate, **more)


def far_apart(problem: Problem, delay_ms: float) -> World:
    """A world in which a migration takes longer than its controller is silent."""
    controller = replace(problem.controller, fallbacks=())
    live = replace(problem.live, max_age_ms=10_000.0)
    slow = replace(problem, controller=controller, live=live)
    return counting(slow, "LOC", delay_ms=delay_ms)


def test_rule_8_a_state_moves_without_losing_a_cycle(problem: Problem) -> None:
    world = counting(problem, "LOC")
    world.run(2_000)
    world.pin("SO")
    world.run(2_000)
    assert world.stamper.placement == "SO"
    assert lost(world) == 0
    require_whole(world)


def test_rule_8_what_is_in_a_state_already_is_not_replayed(problem: Problem) -> None:
    world = counting(problem, "LOC")
    world.run(2_000)
    # The state is asked for late, so that inputs of cycles that are in it have been forked.
    late = NetworkConditions(delay_ns=300 * MS)
    world.network.impair(late, "controller@E", "planning@R2", key="**/snapshot/**")
    world.pin("SO")
    world.run(3_000)
    assert world.stamper.placement == "SO"
    require_whole(world)


def require_whole(world: World) -> None:
    """What the commands say is how many cycles the planner has seen: none is missing or twice."""
    assert len(world.arm.counts) > 50
    assert [count for _, count in world.arm.counts] == [cycle + 1 for cycle in world.cycles]


@pytest.mark.parametrize("seed", range(4))
def test_rule_8_a_state_is_whole_wherever_it_is_sent_to_and_fro(
    problem: Problem, seed: int
) -> None:
    """Migrations that take longer than the controller is silent, some of them given up."""
    rng = random.Random(seed)
    world = far_apart(problem, rng.uniform(20, 80))
    world.run(2_000)
    seen = set()
    for _ in range(16):
        world.pin(rng.choice(["LOC", "SO"]))
        world.run(rng.uniform(100, 3_000))
        seen.add(world.stamper.placement)
    assert seen == {"LOC", "SO"}
    require_whole(world)


def test_rule_8_a_state_is_whole_after_a_migration_that_was_given_up(problem: Problem) -> None:
    world = far_apart(problem, 60)
    world.run(1_000)
    world.pin("SO")
    target = world.worker("planning@E")
    while target.transfer.at < (0, 0):
        world.run(1)
    # It has the state, and follows; who would order the placement is gone.
    world.kill("controller@E")
    world.run(1_000)
    world.start("controller@E")
    world.run(2_000)
    assert world.stamper.placement == "LOC"
    world.pin("SO")
    world.run(2_000)
    assert world.stamper.placement == "SO"
    require_whole(world)


def test_rule_8_a_state_that_comes_too_late_replaces_nothing(problem: Problem) -> None:
    world = counting(problem, "SO")
    world.run(1_000)
    worker = world.worker("planning@E")
    run, cycle = worker.transfer.at
    late = State(run, cycle - 5, "planning", "R2", number=7)
    key = world.stamper.place.keys.of(channels.STATE, "planning", "E", "R2")
    worker.receive(Arrival(key, b"3", encode(late)), world.network.now_ns)
    world.run(1_000)
    require_whole(world)
    # Nor where it is handed to the worker itself.
    chore = Chore(number=late.number, state=late, data=b"3")
    now_ns = world.network.now_ns
    worker.finish_chore(chore, *worker.do_chore(chore), now_ns, now_ns)
    world.run(1_000)
    require_whole(world)


def false_state(world: World, to: str, source: str, ahead: int, number: int) -> None:
    """Have a node send a state that nobody has asked it for, of a cycle so far ahead."""
    stamper = world.stamper
    state = State(stamper.run, stamper.cycle + ahead, "planning", source, number)
    arrival = Arrival(
        world.keys.of(channels.STATE, "planning", to, source), b"1000000", encode(state)
    )
    world.worker(f"planning@{to}").receive(arrival, world.network.now_ns)


@pytest.mark.parametrize("ahead", [-1, 0, 1_000_000])
def test_rule_8_a_state_that_nobody_asked_for_is_not_taken(problem: Problem, ahead: int) -> None:
    world = counting(problem, "LOC")
    world.run(2_000)
    for number in (1, 7, 10**6):
        false_state(world, "R2", "E", ahead, number)
        world.run(200)
    require_whole(world)
    assert world.cycles[-1] >= world.stamper.cycle - 3
    world.pin("SO")
    world.run(2_000)
    assert world.stamper.placement == "SO"
    require_whole(world)


@pytest.mark.parametrize(("source", "ahead"), [("R1", 0), ("R2", 1_000_000)])
def test_rule_8_a_state_is_of_who_was_asked_and_of_no_cycle_beyond_the_newest(
    problem: Problem, source: str, ahead: int
) -> None:
    tasks = dict(problem.pipeline.tasks)
    planning = tasks["planning"]
    tasks["planning"] = replace(planning, on={**planning.on, "R1": planning.on["R2"]})
    wider = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
    world = far_apart(wider, 60)
    world.run(1_000)
    world.pin("SO")
    target = world.worker("planning@E")
    while target.transfer.awaited is None:
        world.run(1)
    false_state(world, "E", source, ahead, target.transfer.awaited.number)
    world.run(3_000)
    assert world.stamper.placement == "SO"
    require_whole(world)


@pytest.mark.parametrize("ahead", [-1, 1_000_000])
@pytest.mark.parametrize("run", [0, 1])
def test_rule_8_no_false_checkpoint_keeps_a_good_one_from_being_used(
    problem: Problem, ahead: int, run: int
) -> None:
    world = counting(problem, "SO")
    world.run(3_000)
    stamper, every = world.stamper, problem.live.checkpoint_cycles
    state = State(stamper.run + run, stamper.cycle + ahead, "planning", "E")
    if (run, ahead) == (0, -1):
        state = msgspec.structs.replace(state, node="R1")
    key = world.keys.of(channels.STATE, "planning", "R2", "E")
    world.worker("planning@R2").receive(
        Arrival(key, b"1000000", encode(state)), world.network.now_ns
    )
    world.run((every + 1) * problem.pipeline.period_ms)
    kill(*EDGE)(world)
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    cycle, count = world.arm.counts[-1]
    assert cycle + 1 - 2 * every <= count <= cycle + 1


def test_rule_8_a_checkpoint_of_a_cycle_to_come_is_not_used(problem: Problem) -> None:
    world = counting(problem, "SO")
    world.run(3_000)
    state = State(world.stamper.run, world.stamper.cycle + 1_000, "planning", "E")
    key = world.keys.of(channels.STATE, "planning", "R2", "E")
    world.worker("planning@R2").receive(
        Arrival(key, b"1000000", encode(state)), world.network.now_ns
    )
    cycle = world.stamper.cycle
    kill(*EDGE)(world)
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    last, count = world.arm.counts[-1]
    assert last >= count - 1
    assert last > cycle + 10


@pytest.mark.parametrize("state_bytes", [100, 100_000])
@pytest.mark.parametrize(("here", "there"), [("LOC", "SO"), ("SO", "LOC")])
def test_rule_8_a_state_finds_its_way_beside_images(
    problem: Problem, here: str, there: str, state_bytes: int
) -> None:
    cell = on(stateful(problem, "perception", state_bytes), here)
    world = World(cell, stages={"perception": Counting}, policy=here)
    world.run(2_000)
    world.pin(there)
    world.run(3_000)
    assert world.stamper.placement == there
    require_whole(world)


def test_rule_8_a_checkpoint_survives_its_node(problem: Problem) -> None:
    world = counting(problem, "SO")
    world.run(3_000)
    kill(*EDGE)(world)
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    every = problem.live.checkpoint_cycles
    cycle, count = world.arm.counts[-1]
    assert cycle + 1 - 2 * every <= count <= cycle + 1
    require_ordered(world)


def test_rule_9_a_frozen_peer_costs_others_nothing(problem: Problem) -> None:
    world = running(problem, "LOC")
    freeze(*EDGE)(world)
    world.run(2_000)
    assert lost(world) == 0
    assert world.stamper.placement == "LOC"


def test_rule_4_the_detour_carries_completions(problem: Problem) -> None:
    world = running(problem, "SO")
    world.network.cut("R2", "R1")
    world.run(2_000)
    assert world.stamper.placement == "SO"
    assert lost(world) == 0
