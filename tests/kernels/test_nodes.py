"""Nodes: quotas and their ticks, turns, wakes and backgrounds, in whole runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.kernels.advance import LoggedCycles, play
from dwell.kernels.arrays import CellArrays, lay_out
from dwell.kernels.codes import Status
from dwell.kernels.realisation import NodeChange
from dwell.model import (
    Constant,
    Execution,
    Node,
    NodeDisturbance,
    Quota,
    Task,
)
from dwell.record import Run
from dwell.sim import Phase
from tests.cells.generated import MS, make_problem, make_realisation


@pytest.mark.parametrize(("exec_ms", "latency_ms"), [(3.0, 3.0), (5.0, 5.0), (8.0, 13.0)])
def test_a_quota_stops_a_job_whose_bucket_is_empty(exec_ms: float, latency_ms: float) -> None:
    # 5 ms of one core in every 10 ms; releases fall on the begins of periods.
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(0.5, 10.0))],
        [Task("work", {"R": Execution(Constant(exec_ms))})],
        period_ms=20.0,
        window_cycles=10,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    assert set(run.cycles["latency_ns"].to_list()) == {round(latency_ms * MS)}


def test_a_core_keeps_some_of_what_it_has_drawn() -> None:
    # As above, but 1 ms outlasts the period: from the second job on 6 ms are there at its begin.
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(0.5, 10.0, slack_ms=1.0))],
        [Task("work", {"R": Execution(Constant(8.0))})],
        period_ms=20.0,
        window_cycles=10,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    latency_ms = [ns / MS for ns in run.cycles["latency_ns"]]
    assert latency_ms == [13.0, *[12.0] * 19]


def test_a_quota_is_noticed_at_ticks_and_its_overrun_paid_back() -> None:
    # 2 ms in every 4; periods begin with the releases, and 3 ms after a tick.
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(0.5, 4.0, tick_ms=4.0))],
        [Task("work", {"R": Execution(Constant(6.0))})],
        period_ms=40.0,
        window_cycles=10,
    )
    real = replace(
        dwell.draw(problem, scenario="disturbed", seed=1, windows=1), phases={"R": Phase(0, 3 * MS)}
    )
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    # It runs from 0 to 5: 1 of 2 ms are left at the first tick, and 1 too many of 4 are used at the
    # second. The refill at 8 pays that debt, and in the ms that it leaves the job ends.
    assert set(run.cycles["latency_ns"].to_list()) == {9 * MS}


def test_threads_take_turns_from_tick_to_tick() -> None:
    stress = NodeDisturbance(node="R", at_s=0.0, stress_threads=1)
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(1.0, 4.0, tick_ms=4.0))],
        [Task("work", {"R": Execution(Constant(6.0))})],
        period_ms=40.0,
        window_cycles=10,
        scenario=[stress],
    )
    real = replace(
        dwell.draw(problem, scenario="disturbed", seed=1, windows=1), phases={"R": Phase(0, 1 * MS)}
    )
    run = dwell.simulate_realisation(problem, real, policy="LOC", jobs=True)
    assert run.jobs is not None
    # The other thread has the core until the tick at 3, and from 7 to 11.
    assert set((run.jobs["start_ns"] - run.jobs["ready_ns"]).to_list()) == {3 * MS}
    assert set(run.cycles["latency_ns"].to_list()) == {13 * MS}


def test_phases_are_drawn_where_ticks_are() -> None:
    def drawn(tick_ms: float, seed: int) -> Mapping[str, Phase]:
        node = Node("R", "robot", 1, quota=Quota(0.5, 10.0, tick_ms=tick_ms))
        problem = make_problem([node], [Task("work", {"R": Execution(Constant(1.0))})])
        return dwell.draw(problem, scenario="disturbed", seed=seed, windows=1).phases

    assert drawn(0.0, 1) == {}
    assert drawn(4.0, 1) == drawn(4.0, 1) != drawn(4.0, 2)
    period_ago, tick_ago, wakes = zip(*(drawn(4.0, seed)["R"] for seed in range(50)), strict=True)
    assert len(set(wakes)) == 50
    assert 0 <= min(period_ago) < 2 * MS < 8 * MS < max(period_ago) < 10 * MS
    assert 0 <= min(tick_ago) < MS < 3 * MS < max(tick_ago) < 4 * MS


def woken(hz: float, *disturbances: NodeDisturbance, quota: Quota, exec_ms: float) -> Run:
    """A job every 40 ms on a node where something else wakes so often."""
    problem = make_problem(
        [Node("R", "robot", 1, quota=quota, background_hz=hz)],
        [Task("work", {"R": Execution(Constant(exec_ms))})],
        period_ms=40.0,
        window_cycles=25,
        scenario=[*disturbances],
    )
    real = dwell.draw(problem, scenario="disturbed", seed=1, windows=20)
    phase = real.phases["R"]._replace(period_ago_ns=0, tick_ago_ns=3 * MS)
    return dwell.simulate_realisation(problem, replace(real, phases={"R": phase}), policy="LOC")


def latencies_ms(run: Run) -> np.ndarray[Any, Any]:
    return run.cycles["latency_ns"].to_numpy() / MS


def test_what_wakes_has_the_kernel_look_at_the_quota() -> None:
    # Beside the ticks, which alone make it 9 ms (above): looked at all the time it is used up after
    # 2 ms of every 4, and what is overrun by then is paid in the next period.
    run = woken(100_000.0, quota=Quota(0.5, 4.0, tick_ms=4.0), exec_ms=6.0)
    assert latencies_ms(run).mean() == pytest.approx(10.0, abs=0.03)
    # It runs on to the tick at 5, unless something wakes between 2, when 2 are used up, and 4.
    rare = latencies_ms(woken(100.0, quota=Quota(0.5, 4.0, tick_ms=4.0), exec_ms=6.0))
    assert 0.6 < np.mean(rare == 9.0) < 0.95


def test_what_wakes_has_the_kernel_pick_anew_who_runs() -> None:
    # Beside one foreign thread, on a whole core: 13 ms where threads take turns from tick to tick.
    stress = NodeDisturbance("R", stress_threads=1)
    quota = Quota(1.0, 4.0, tick_ms=4.0)
    run = woken(100_000.0, stress, quota=quota, exec_ms=6.0)
    assert latencies_ms(run) == pytest.approx(12.0, abs=0.2)
    # As often as here, turns are two gaps long in the mean, and never longer than to the next tick.
    often = latencies_ms(woken(1_000.0, stress, quota=quota, exec_ms=6.0))
    assert often.mean() == pytest.approx(12.0, rel=0.03)
    assert often.std() > 0.3


@pytest.mark.parametrize(("hz", "used"), [(0.0, 0.86), (300.0, 0.955), (1_000.0, 0.99)])
def test_the_more_often_something_wakes_the_less_of_a_quota_is_lost(hz: float, used: float) -> None:
    # Measured with a busy thread, 0.8 of a core in 3 ms, beside one that sleeps and wakes (its time
    # and its going to sleep, at which the kernel looks too, are not in the model).
    node = Node("R", "robot", 1, quota=Quota(0.8, 3.0, slack_ms=1.0, tick_ms=4.0), background_hz=hz)
    problem = make_problem(
        [node],
        [Task("work", {"R": Execution(Constant(0.1))})],
        period_ms=100.0,
        window_cycles=20,
        scenario=[NodeDisturbance("R", stress_threads=1)],
    )
    found = [
        dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=seed, windows=2).windows[
            "u_R"
        ][1]
        for seed in range(30)
    ]
    assert np.mean(found) == pytest.approx(used, abs=0.025)


@pytest.mark.parametrize(
    ("quota", "exec_ms", "latency_ms", "used"),
    [
        # 4 of the 5 ms in every period are left to the job.
        (Quota(0.5, 10.0), 3.0, 3.0, 0.5),
        (Quota(0.5, 10.0), 8.0, 14.0, 1.0),
        # 0.9 of the core are left to it: busy while it runs, and for a tenth of the rest.
        (None, 4.5, 5.0, 0.325),
    ],
)
def test_the_background_takes_of_the_quota_or_of_the_cores(
    quota: Quota | None, exec_ms: float, latency_ms: float, used: float
) -> None:
    problem = make_problem(
        [Node("R", "robot", 1, quota=quota, background=0.1)],
        [Task("work", {"R": Execution(Constant(exec_ms))})],
        period_ms=20.0,
        window_cycles=10,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    assert set(run.cycles["latency_ns"].to_list()) == {round(latency_ms * MS)}
    assert run.windows["u_R"].to_list() == pytest.approx([used] * 2)


def test_what_waits_while_jobs_run_takes_less_of_their_quota() -> None:
    # 4.5 of the 5 ms in every period are left to the job, 4 while there are foreign threads: these
    # have half of them. The job takes 1.25 times as long then.
    node = Node(
        *("R1", "robot", 1),
        quota=Quota(0.5, 10.0),
        background=0.1,
        background_beside=0.05,
        interference=1.25,
    )
    problem = make_problem(
        [node],
        [Task("work", {"R1": Execution(Constant(8.0))})],
        period_ms=100.0,
        window_cycles=5,
        scenario=[NodeDisturbance("R1", stress_threads=1)],
    )
    calm = dwell.simulate(problem, scenario="baseline", policy="LOC", seed=1, windows=2)
    assert set(calm.cycles["latency_ns"].to_list()) == {round(13.5 * MS)}
    assert calm.windows["u_R1"].to_list() == pytest.approx([0.36] * 2)
    stressed = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=2)
    # 1.6 ms of its 8 in every period.
    assert stressed.cycles["latency_ns"][1] == 44 * MS
    assert stressed.windows["u_R1"].to_list() == pytest.approx([1.0] * 2, abs=0.02)


def test_a_period_that_begins_with_stress_and_a_job_is_a_stressed_one() -> None:
    # All three at 30 ms. Without stress a period has 5 ms, with it 2.5, of which the job has half.
    problem = make_problem(
        [Node("R1", "robot", 1, quota=Quota(0.5, 10.0), background=0.25, background_beside=0.0)],
        [Task("work", {"R1": Execution(Constant(4.0))}, offset_ms=30.0)],
        period_ms=100.0,
        window_cycles=5,
        scenario=[NodeDisturbance("R1", at_s=0.03, stress_threads=1)],
    )
    run = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=1)
    assert run.cycles["latency_ns"][0] == 60.5 * MS


SLOWED = Node("R", "robot", interference=2.0)


@pytest.mark.parametrize(
    ("node", "threads", "accelerator", "core_ms"),
    [
        # While 2 foreign threads are there, 9 ms, it receives 3 ms of the core, or 18 of two.
        (SLOWED, 1, None, 3 + 3 + (8 - 3 - 3 / 2)),
        (replace(SLOWED, cores=4), 2, None, 6 + 18 + (16 - 6 - 18 / 2)),
        (replace(SLOWED, scheduler="fifo"), 3, None, 3 + 3 + (24 - 3 - 3 / 2)),
        # What does not interfere makes it later, and is no work.
        (Node("R", "robot"), 3, None, 24),
        (replace(SLOWED, accelerators={"gpu": 1}), 1, "gpu", 8),
    ],
    ids=["fair", "cores", "fifo", "no interference", "accelerator"],
)
def test_core_time_is_more_than_work_where_foreign_threads_interfere(
    node: Node, threads: int, accelerator: str | None, core_ms: float
) -> None:
    execution = Execution(Constant(8.0), threads=threads, accelerator=accelerator)
    problem = make_problem([node], [Task("work", {"R": execution})], period_ms=200.0)
    changes = [NodeChange(3 * MS, "R", 2, False), NodeChange(12 * MS, "R", 0, False)]
    real = make_realisation(problem, windows=1, node_changes=changes)
    arrays = lay_out([(problem, real)], log_jobs=True)
    assert play(arrays) == Status.FINISHED
    rows = LoggedCycles(CellArrays(arrays), np.empty(0, np.int64)).window(0, 1)
    *_, work_ns, start_ns = rows.columns(shadow=False)
    assert (start_ns.tolist(), work_ns.tolist()) == ([[0]], [[round(core_ms * MS)]])
