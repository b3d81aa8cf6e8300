"""Live cells whose tasks run in every n-th cycle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import polars as pl
import polars.testing
import pytest

import dwell
from dwell.estimators import Evidence
from dwell.estimators.measured import Message, Meter
from dwell.live.roles.run_rows import columns_of
from dwell.live.wire import channels
from dwell.live.wire.messages import State, decode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from dwell.model.scenario import LinkDisturbance
from tests.live.rated_cells import SLOW, document, rated, world_of
from tests.live.replayed import SYNCHRONOUS, Clocks, messages_of, recorded, replay, simulate
from tests.live.small_world import Counting, Staying, World, canonical, columns

GUARDED = {"on": "E", "initial": "EDGE", "fallbacks": ["LOC"]}


def steps(numbers: list[int]) -> set[int]:
    return {later - earlier for earlier, later in pairwise(numbers)}


def test_each_sink_gets_the_commands_of_its_rate() -> None:
    world = world_of(rated(controller=GUARDED))
    world.run(1_000)
    arm, wheels = ([cycle for cycle, _ in world.arms[name].applied] for name in ("arm", "wheels"))
    assert len(wheels) > 80
    assert steps(wheels) == {1}
    assert steps(arm) == {SLOW}
    assert {cycle % SLOW for cycle in arm} == {0}
    # Cycles that only the wheels take part in are complete, too.
    assert world.stamper.guard.newest == wheels[-1]
    assert world.stamper.moves == []


def test_idle_cycles_are_recorded_and_count_in_no_metric() -> None:
    world = world_of(rated(idle=True), policy=Staying())
    world.run(1_500)
    rows = columns(world, "cycles", "number", "outcome", "latency_ns", "missed")
    idle = [row for row in rows if row[0] % SLOW]
    assert {row[1:] for row in idle} == {("idle", None, False)}
    done = [row for row in rows if not row[0] % SLOW]
    assert {(outcome, missed) for _, outcome, _, missed in done} == {("done", False)}
    assert len(idle) > 3 * len(done) > 30
    windows = columns(world, "windows", "violation_rate", "l95_ms", "unproven")
    assert len(windows) >= 5
    assert all(rate == 0 and 3 < l95_ms < 6 and not proven for rate, l95_ms, proven in windows)
    assert {*columns(world, "decisions", "reason")} == {("hold",)}
    assert (world.status["health"], world.status["headline"]) == ("ok", None)


def test_a_cycle_is_actuated_if_all_sinks_have_applied_it() -> None:
    world = world_of(rated(), policy=Staying())
    world.run(500)
    world.kill("sink.arm@R")
    dead = world.stamper.cycle
    world.run(500)
    rows = columns(world, "cycles", "number", "actuated")
    late = [actuated for number, actuated in rows if number > dead and not number % SLOW]
    assert late == [False] * len(late)
    assert len(late) > 2
    assert all(actuated for number, actuated in rows if number % SLOW)


def test_jobs_that_send_no_message_are_known() -> None:
    world = world_of(rated(idle=True), policy=Staying(), jobs=True)
    world.run(1_000)
    jobs = [row for row in world.recorder.rows["jobs"] if row[1] == "imu"]
    rows = [int(str(row[0])) for row in jobs]
    assert steps(rows) == {1}
    assert len(rows) > 50
    order = list(columns_of(world.cell.controller, jobs=True)["jobs"])
    assert {row[order.index("outcome")] for row in jobs} == {"done"}
    # Their work is the cell's own.
    assert all(row[order.index("cpu_ns")] is not None for row in jobs)


def test_cycles_that_a_later_cycle_of_a_faster_sink_overtakes_are_counted() -> None:
    controller = {"on": "E", "initial": "LOC"}
    tasks = document()["tasks"]
    tasks["fuse"]["on"] = {node: {"exec_ms": 25} for node in ("R", "E")}
    problem = rated(deadline_ms=45, tasks=tasks, controller=controller)
    exec_ms = dict.fromkeys(problem.pipeline.tasks, 1.0) | {"fuse": 25.0}
    world = World(problem, exec_ms=exec_ms, policy="LOC")
    world.run(1_500)
    simulated = dwell.simulate(problem, policy="LOC", seed=1, windows=3).windows["overtaken"]
    # Each command of the arm takes longer than the next commands of the wheels.
    assert simulated.to_list() == [20 // SLOW] * 3
    counts = [count for (count,) in columns(world, "windows", "overtaken")]
    assert {*counts} == {20 // SLOW}
    assert len(counts) >= 4


def test_decisions_without_a_due_sink_are_missed() -> None:
    controller = {"on": "E", "initial": "EDGE", "decide_cycles": 2}
    world = world_of(rated(idle=True, controller=controller), policy=Staying())
    world.run(1_500)
    lasts = [last for (last,) in columns(world, "decisions", "last_cycle")]
    # A window of W cycles has a cycle with a due sink; only the first ones are shorter.
    assert len(lasts) > 40
    assert steps(lasts[12:]) == {2}


@pytest.mark.parametrize("stateful", [True, False])
def test_a_move_loses_no_run_of_a_slow_task(stateful: bool) -> None:
    stages = {"fuse": Counting} if stateful else None
    world = world_of(rated(state_bytes=100 * stateful), stages=stages, policy=Staying())
    world.run(1_000)
    world.pin("LOC")
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    arm = world.arms["arm"]
    assert steps([cycle for cycle, _ in arm.applied]) == {SLOW}
    if stateful:
        runs = [cycle // SLOW for cycle, _ in arm.counts]
        counts = [count for _, count in arm.counts]
        assert {count - run for run, count in zip(runs, counts, strict=True)} == {
            counts[0] - runs[0]
        }


def test_checkpoints_count_the_runs_of_their_task() -> None:
    live = {"checkpoint_cycles": 4}
    world = world_of(
        rated(controller=GUARDED, live=live, state_bytes=100), stages={"fuse": Counting}
    )
    states: list[int] = []

    def hear(sample: Arrival) -> None:
        if f"/{channels.STATE.word}/" in sample.key:
            states.append(decode(sample.header, State).cycle)

    world.network.taps.append(hear)
    world.run(1_000)
    assert len(states) >= 4
    assert steps(states) == {4 * SLOW}
    assert {cycle % (4 * SLOW) for cycle in states} == {0}


def test_a_standby_takes_over_the_last_runs_of_a_slow_task() -> None:
    problem = rated()
    tasks = dict(problem.pipeline.tasks)
    on = {node: replace(one, standby=1) for node, one in tasks["fuse"].on.items()}
    tasks["fuse"] = replace(tasks["fuse"], on=on)
    world = world_of(replace(problem, pipeline=replace(problem.pipeline, tasks=tasks)))
    world.run(1_002)
    world.network.freeze("fuse@E")
    world.run(500)
    # The inputs of the run at which the worker froze are still there when its silence is noticed.
    assert steps([cycle for cycle, _ in world.arms["arm"].applied]) == {SLOW}


def test_a_slow_source_guesses_a_stamp_that_was_lost() -> None:
    world = world_of(rated(lidar="E"))
    world.run(1_000)
    cut = world.network.cut("stamper@R", "lidar@E")
    world.run(SLOW * 10)
    world.network.heal(cut)
    world.run(500)
    assert steps([cycle for cycle, _ in world.arms["arm"].applied]) == {SLOW}


def test_a_source_that_moves_is_proven_by_its_shadows() -> None:
    tasks = document()["tasks"]
    tasks["lidar"]["on"] = tasks["fuse"]["on"]
    nodes = {"LOC": "R", "EDGE": "E"}
    candidates = {name: {"fuse": node, "lidar": node} for name, node in nodes.items()}
    problem = rated(tasks=tasks, candidates=candidates, controller=GUARDED | {"probe_cycles": 4})
    world = world_of(problem, policy="EDGE")
    world.run(300)
    world.move_by_guard("LOC")
    world.run(1_500)
    assert world.stamper.placement == "EDGE"
    assert steps([cycle for cycle, _ in world.arms["arm"].applied]) == {SLOW}


def every_other(problem: Problem) -> Problem:
    """Return a cell whose first source runs in every second cycle, and so all its tasks."""
    tasks = dict(problem.pipeline.tasks)
    tasks["sensing"] = replace(tasks["sensing"], every=2)
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))


@pytest.mark.parametrize(("seed", "every"), [(0, 3), (1, 20)])
def test_a_simulated_run_with_idle_cycles_is_decided_on_in_the_same_way_live(
    seed: int, every: int, tmp_path: Path
) -> None:
    settings = {"min_dwell": 0, "min_improvement": 0.0, "order_lead_cycles": 2, "fallbacks": ()}
    initial = Random(seed).choice(["LOC", "SO", "HYB"])
    cell = canonical(
        20, decide_cycles=every, estimator="tests.live.replayed:Dated", initial=initial, **settings
    )
    played = simulate(every_other(cell), "robot-cpu-stress", windows=15, seed=seed)
    _, controller, _, evidence, rows = replay(played, SYNCHRONOUS, messages_of(played, Clocks()))
    live, simulated = recorded(tmp_path, controller, rows), played.run
    count = live.decisions.height
    assert count >= simulated.decisions.height - 1 > 10
    names = [name for name in simulated.decisions.columns if name in live.decisions.columns]
    pl.testing.assert_frame_equal(
        live.decisions.select(names), simulated.decisions.select(names)[:count], abs_tol=1e-6
    )
    windows = simulated.windows[: live.windows.height]
    names = [name for name in windows.columns if not name.startswith("shadow_")]
    pl.testing.assert_frame_equal(live.windows.select(names), windows.select(names), abs_tol=1e-6)
    cycles = simulated.cycles[: live.cycles.height].select("outcome", "missed", "latency_ns")
    assert live.cycles.select("outcome", "missed", "latency_ns").equals(cycles)
    # Estimators know which jobs were not due, as in the simulator, also in earlier cycles.
    both = [*zip(evidence, played.seen.evidence, strict=False)]
    assert [here.close_ns for here, _ in both] == [there.close_ns for _, there in both]
    before = [(here.earlier, there.earlier) for here, there in both]
    earlier = [(here, there) for here, there in before if here is not None and there is not None]
    assert before[1:] == earlier
    for here, there in both + earlier:
        assert (here.release_ns == there.release_ns).all()
        assert (here.placement == there.placement).all()
        assert ((here.cycles.end_ns == -2) == (there.cycles.end_ns == -2)).all()
        assert ((here.cycles.arrived_ns == -2) == (there.cycles.arrived_ns == -2)).all()
    for here, there in earlier:
        # The cycles before have reached their sinks.
        known = here.cycles.end_ns >= 0
        assert known.mean() > 0.4
        assert (here.cycles.end_ns[known] == there.cycles.end_ns[known]).all()


def counted_losses(problem: Problem, evidence: Sequence[Evidence]) -> int:
    """Return how many messages an estimator counts as lost."""
    meter, lost = Meter(problem), 0
    for one in evidence:
        times = meter.times(one).items()
        lost += sum(int(np.isinf(ms).sum()) for part, ms in times if isinstance(part, Message))
    return lost


@pytest.mark.parametrize("every", [3, 5, 7, 20])
def test_the_losses_of_slow_tasks_count_as_in_the_simulator(every: int) -> None:
    settings = {"min_dwell": 0, "min_improvement": 0.0, "order_lead_cycles": 3, "fallbacks": ()}
    cell = canonical(20, decide_cycles=every, estimator="tests.live.replayed:Dated", **settings)
    tasks = dict(cell.pipeline.tasks)
    tasks["sensing"] = replace(tasks["sensing"], every=5)
    impaired = cell.scenario("network-impairment")
    lossy = tuple(replace(one, loss=0.3) for one in impaired if isinstance(one, LinkDisturbance))
    scenarios = {**cell.scenarios, "network-impairment": lossy}
    pipeline = replace(cell.pipeline, tasks=tasks)
    problem = replace(cell, pipeline=pipeline, scenarios=scenarios)
    played = simulate(problem, "network-impairment", windows=40, seed=2)
    evidence = replay(played, SYNCHRONOUS, messages_of(played, Clocks()))[3]
    seen = played.seen.evidence
    live, alike, simulated = (
        counted_losses(problem, of) for of in (evidence, seen[: len(evidence)], seen)
    )
    lost = played.run.cycles.filter(pl.col("outcome") == "dropped").height
    # Live, a loss counts from the release of its cycle; so one may count a decision earlier.
    assert alike <= live <= simulated
    assert 0.85 * lost < live <= lost
