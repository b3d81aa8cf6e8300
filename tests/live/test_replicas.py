"""Live cells whose cycles have two copies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any, TypeAlias

import numpy as np
import polars as pl
import polars.testing
import pytest

from dwell.control import overtaken_cycles
from dwell.live.roles.run_rows import columns_of
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.permissions import senders
from dwell.live.trust.signing import Seals
from dwell.live.wire import channels
from dwell.live.wire.messages import (
    ACTUATED,
    BEHIND,
    CANCELLED,
    LATE,
    Completion,
    Hop,
    Stamp,
    encode,
)
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import roles
from dwell.model.instants import NEVER_NS
from dwell.model.placement import Copy
from tests.live.memory_transport import NetworkConditions
from tests.live.replayed import (
    SYNCHRONOUS,
    Clocks,
    Event,
    Played,
    completing,
    loads_of,
    recorded,
    replay,
    simulate,
    stamping,
)
from tests.live.replicated_cells import ReplicatedWorld, replicated
from tests.live.small_world import Alternating, Counting, columns, stateful

#: Tasks of the two copies that differ, with their nodes.
FIRST = "perception@R1", "planning@R2"
SECOND = "perception@E", "planning@E"
#: Jobs of a simulated run, by cycle, task and node.
Jobs: TypeAlias = Mapping[tuple[int, str, str], Mapping[str, Any]]


def steps(cycles: list[int]) -> set[int]:
    return {later - earlier for earlier, later in pairwise(cycles)}


def test_each_cycle_runs_in_both_copies_and_commands_once() -> None:
    world = ReplicatedWorld(replicated(window_cycles=10), policy="BOTH", jobs=True)
    world.run(900)
    count = len(world.cycles)
    assert count > 22
    assert steps(world.cycles) == {1}
    for who in (*FIRST, *SECOND):
        assert world.inputs_of(who) >= count
        assert world.worker(who).place.complaints == {}
    # The copies meet at the sink's task, where the later message is dropped and counted.
    assert world.inputs_of("control@R2") >= 2 * count - 1
    assert world.outcomes("control", "R2") == {"late": pytest.approx(count, abs=1)}
    windows = columns(world, "windows", "placement", "late_copies", "violation_rate")
    assert {*windows} == {("BOTH", 10, 0.0)}
    # The record has the jobs of both copies.
    order = list(columns_of(world.cell.controller, jobs=True)["jobs"])
    places = [order.index(name) for name in ("task", "node", "outcome", "second")]
    jobs = [tuple(row[i] for i in places) for row in world.recorder.rows["jobs"]]
    sites = [*(one.split("@") for one in (*FIRST, *SECOND)), ["sensing", "R1"], ["control", "R2"]]
    assert {*jobs} == {(*site, "done", "@".join(site) in SECOND) for site in sites}


@pytest.mark.parametrize(("after_ms", "is_sent"), [(10.0, True), (25.0, False)])
def test_the_second_copy_is_sent_unless_the_cycle_is_done_by_then(
    after_ms: float, is_sent: bool
) -> None:
    world = ReplicatedWorld(replicated(after_ms=after_ms), policy="BOTH")
    world.run(600)
    assert steps(world.cycles) == {1}
    assert bool(world.inputs_of("perception@E")) is is_sent
    assert bool(world.inputs_of("planning@E")) is is_sent
    at_ms = [at_ms for name, at_ms in world.inputs if name == "perception@E"]
    assert at_ms == pytest.approx([after_ms] * len(at_ms), abs=0.01)


def test_a_slow_copy_is_cancelled_where_it_waits_and_where_it_runs() -> None:
    slow = {("perception", "E"): 25.0, ("perception", "R1"): 5.0}
    world = ReplicatedWorld(replicated(), slow, policy="BOTH")
    world.run(1_000)
    assert steps(world.cycles) == {1}
    # The job that ran when the completion arrived has ended without an output.
    assert world.outcomes("perception", "E")["cancelled"] == pytest.approx(len(world.cycles), abs=1)
    assert world.inputs_of("planning@E") == 0
    # Its work counts on its node.
    (used,) = {*columns(world, "windows", "u_E", "late_copies")[-1:]}
    assert used[1] == 0


def test_a_cycle_is_done_by_the_copy_that_arrives() -> None:
    lossy = replicated()
    world = ReplicatedWorld(lossy, policy="BOTH", seed=3)
    world.run(200)
    world.network.impair(
        NetworkConditions(loss=0.5), "sensing@R1", key=f"{world.keys.root}/in/perception/**"
    )
    world.run(2_000)
    missing = 1 - len(world.cycles) / (world.cycles[-1] + 1)
    # Each copy loses half of its cycles.
    assert 0.1 < missing < 0.4


def test_no_command_comes_twice_while_the_cell_moves_and_messages_are_lost() -> None:
    tour = Alternating("LOC", "BOTH", "SO", "BOTH", "LOC", "SO")
    problem = replicated(initial="LOC", window_cycles=5, min_dwell=0)
    world = ReplicatedWorld(problem, policy=tour, seed=11)
    harm = NetworkConditions(loss=0.1, duplication=0.3, reordering=0.3, reorder_ns=8_000_000)
    world.network.impair(harm)
    world.run(6_000)
    placed = {name for _, name, _ in world.stamper.moves}
    assert placed == {"LOC", "BOTH", "SO"}
    cycles = world.cycles
    assert len(cycles) > 80
    assert cycles == sorted({*cycles})


def test_the_death_of_the_second_node_costs_no_cycle() -> None:
    world = ReplicatedWorld(replicated(on="R2"), policy="BOTH")
    there = [role.who for role in roles(world.problem) if role.node == "E"]
    draw = Random(5)
    world.run(500)
    for _ in range(40):
        world.run(draw.uniform(0, 34))
        for who in there:
            world.kill(who)
        world.run(draw.uniform(40, 200))
        for who in there:
            world.start(who)
        world.run(100)
    assert steps(world.cycles) == {1}
    assert world.stamper.moves == []
    assert {missed for (missed,) in columns(world, "cycles", "missed")} == {False}


def test_the_guard_leaves_replicas_of_which_no_copy_completes() -> None:
    world = ReplicatedWorld(replicated(fallbacks=["HYB"], on="R2", probe_cycles=5), policy="BOTH")
    world.run(500)
    broken = "perception@R1", "planning@E"
    for who in broken:
        world.kill(who)
        world.run(300)
    # The first death cost no cycle, so the guard moved after the second one.
    assert [name for _, name, _ in world.stamper.moves] == ["HYB"]
    # A probe goes through one copy, and proves both.
    world.start("perception@R1")
    world.run(1_500)
    assert [(name, by) for _, name, by in world.stamper.moves[1:]] == [("BOTH", "order")]
    assert world.cycles[-1] > world.stamper.cycle - 3


def test_shadows_go_through_no_member_while_both_copies_run() -> None:
    world = ReplicatedWorld(replicated(fallbacks=["HYB"]))
    world.stamper.shadow_fraction = 0.5
    world.run(600)
    shadows = [done for done in world.ended if done.outcome == "shadow"]
    assert len(shadows) > 5
    assert {done.stamp.shadow for done in shadows} == {"HYB"}
    # A task with two nodes is apart from its shadow, even on a node of one of the copies.
    for done in shadows:
        assert {"perception@E", "planning@R2"} <= {f"{hop.task}@{hop.node}" for hop in done.hops}
    assert steps(world.cycles) == {1}


@pytest.fixture
def seals(tmp_path: Path) -> dict[str, Seals]:
    authority = Authority.create(tmp_path, "canonical")
    nodes = "R1", "E", "R2"
    for node in nodes:
        authority.issue(node, "node")
    authority.issue("controller", "controller")
    names = *nodes, "controller"
    return {name: Seals(Keyring.open(tmp_path / name, cell="canonical")) for name in names}


def test_only_signed_completions_end_a_cycle(seals: dict[str, Seals]) -> None:
    world = ReplicatedWorld(replicated(after_ms=25), policy="BOTH", seals=seals)
    world.run(500)
    assert steps(world.cycles) == {1}
    assert world.inputs_of("perception@E") == 0
    # A worker of either copy may send to the task at which the copies meet.
    may = senders(world.problem)[world.keys.of(channels.INPUT, "control", "R2", "main")]
    assert may == {"R2", "E"}
    # A completion that the sink's node has not signed is no reason to drop held messages.
    worker = world.worker("sensing@R1")
    world.run(10)
    held_ns = worker.copies.due_ns
    assert held_ns < NEVER_NS
    stamp = Stamp(world.stamper.run, world.stamper.cycle - 1, 1, "BOTH", 0)
    forged = encode(Completion(stamp, "control", 0, ACTUATED, (), "R2"))
    key = world.keys.of(channels.DONE, "control")
    world.worker("sensing@R1").receive(Arrival(key, bytes(64) + forged), world.network.now_ns)
    assert worker.copies.due_ns == held_ns
    assert worker.place.complained == 1


def test_the_added_node_gets_the_state() -> None:
    problem = stateful(replicated(initial="LOC"), "planning", 100)
    world = ReplicatedWorld(problem, policy="LOC", stages={"planning": Counting})
    world.run(1_000)
    for name in ("BOTH", "SO"):
        world.pin(name)
        world.run(1_000)
        assert world.stamper.placement == name
    assert steps(world.cycles) == {1}
    # Both copies counted every cycle, and the state moved once.
    assert {count - cycle for cycle, count in world.arm.counts} == {1}


def reports_of(
    stamp: Stamp,
    copy: Copy,
    jobs: Jobs,
    arrived_ns: Sequence[int],
    others_ns: Sequence[int],
    applied: str = ACTUATED,
) -> Iterator[Event]:
    """Yield the report of one copy of a cycle of a simulated chain, at its last arrival or job.

    `others_ns` are the arrivals of the other copy, `applied` is the outcome at the gate.
    """
    hops: list[Hop] = []
    for task, at_ns in zip(copy, arrived_ns, strict=True):
        node, inputs = copy[task], ((hops[-1].task, at_ns),) if hops else ()
        job = jobs.get((stamp.cycle, task, node))
        if job is not None and at_ns < 0 and job["ready_ns"] not in others_ns:
            # The message arrived after the end of its window.
            at_ns = job["ready_ns"]
        if job is None or (hops and job["ready_ns"] != at_ns):
            if at_ns >= 0:
                hops.append(Hop(task, node, at_ns, -1, -1, inputs))
                yield at_ns, 1, completing(Completion(stamp, task, at_ns, LATE, (*hops,), node))
                return
            break
        if job["outcome"] == "replaced":
            hops.append(Hop(task, node, at_ns, -1, -1, inputs))
            done = Completion(stamp, task, at_ns, "replaced", (*hops,), node)
            yield at_ns, 1, completing(done)
            return
        if job["outcome"] != "done":
            # It waited until the cycle was done.
            hops.append(Hop(task, node, at_ns, -1, -1, inputs))
            yield at_ns, 1, completing(Completion(stamp, task, at_ns, CANCELLED, (*hops,), node))
            return
        times = job["ready_ns"], job["start_ns"], job["end_ns"]
        hops.append(Hop(task, node, *times, inputs))
    if hops:
        end = hops[-1]
        outcome = applied if end.task == "control" else CANCELLED
        done = Completion(stamp, end.task, end.ended_ns, outcome, (*hops,), end.node)
        yield end.ended_ns, 1, completing(done)


def messages_of_copies(played: Played) -> Iterator[Event]:
    """Yield the messages of a live cell's processes in a simulated run of the canonical cell."""
    candidates, run = played.problem.candidates, played.run
    arrived: dict[int, list[int]] = {}
    for first, evidence in zip(played.seen.firsts, played.seen.evidence, strict=True):
        rows = evidence.cycles.arrived_ns.tolist()
        arrived |= {first + number: row for number, row in enumerate(rows)}
    known: Jobs = {
        (job["cycle"], job["task"], job["node"]): job for job in run.jobs.iter_rows(named=True)
    }
    table = run.arrays("cycles")
    overtaken = overtaken_cycles(table["release_ns"], table["latency_ns"])
    term, before = 1, None
    for entry in run.cycles.iter_rows(named=True):
        cycle, name, released_ns = entry["cycle"], entry["placement"], entry["release_ns"]
        term += before is not None and name != before
        before = name
        stamp = Stamp(7, cycle, term, name, released_ns)
        yield released_ns, 3, stamping(stamp)
        first_ns, second_ns = (arrived.get(cycle, [-1] * 6)[i : i + 3] for i in (0, 3))
        both = (first_ns, second_ns), (second_ns, first_ns)
        for copy, (ways, others) in zip(candidates[name].copies, both, strict=False):
            applied = BEHIND if overtaken[cycle] else ACTUATED
            yield from reports_of(stamp, copy, known, (released_ns, *ways), others, applied)
    yield from loads_of(played, Clocks())


@pytest.mark.parametrize(
    ("after_ms", "every", "initial", "fallbacks"),
    [(0.0, 20, "LOC", ()), (15.0, 6, "BOTH", ("HYB",)), (22.0, 20, "BOTH", ())],
)
def test_a_simulated_run_with_replicas_is_decided_on_in_the_same_way_live(
    after_ms: float, every: int, initial: str, fallbacks: tuple[str, ...], tmp_path: Path
) -> None:
    cell = replicated(
        after_ms=after_ms,
        initial=initial,
        decide_cycles=every,
        estimator="tests.live.replayed:Dated",
        min_dwell=0,
        min_improvement=0.0,
        order_lead_cycles=2,
        fallbacks=fallbacks,
    )
    played = simulate(cell, "robot-cpu-stress", windows=12, seed=0, guard=bool(fallbacks))
    _, controller, _, evidence, rows = replay(played, SYNCHRONOUS, messages_of_copies(played))
    live, simulated = recorded(tmp_path, controller, rows), played.run
    assert {"BOTH", "LOC"} <= {*simulated.windows["placement"]}
    names = [name for name in simulated.decisions.columns if name in live.decisions.columns]
    count = live.decisions.height
    assert count >= simulated.decisions.height - 1 >= 10
    pl.testing.assert_frame_equal(
        live.decisions.select(names), simulated.decisions.select(names)[:count], abs_tol=1e-6
    )
    windows = simulated.windows[: live.windows.height]
    # The evidence, from which the messages are made, lacks copies that are later than its window.
    late = pl.col("late_copies")
    names = [name for name in windows.columns if name != late.meta.output_name()]
    pl.testing.assert_frame_equal(live.windows.select(names), windows.select(names), abs_tol=1e-6)
    more = windows.select(late) - live.windows.select(late)
    assert more["late_copies"].is_between(0, 2).all()
    cycles = simulated.cycles[: live.cycles.height].select("outcome", "missed", "latency_ns")
    assert live.cycles.select("outcome", "missed", "latency_ns").equals(cycles)
    # Estimators get both copies, and do not take what was cancelled for lost.
    whole = zip(evidence, played.seen.evidence, strict=False) if every == 20 else ()
    for here, there in whole:
        done = there.cycles.end_ns[:, 3] >= 0
        # Live, a copy without a report counts as lost, but no estimator counts young losses.
        done[-2:] = False
        for name, least in (("ready_ns", -2), ("end_ns", -2), ("arrived_ns", -1)):
            found = (getattr(one.cycles, name)[done] for one in (here, there))
            here_ns, there_ns = (np.maximum(one, least).tolist() for one in found)
            assert here_ns == there_ns, name
