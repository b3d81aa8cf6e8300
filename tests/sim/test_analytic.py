"""The simulator against queueing theory, recursions and numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import t as student

import dwell
from dwell.kernels.realisation import NodeChange, Realisation
from dwell.model import (
    Constant,
    Execution,
    Exponential,
    Flow,
    Gamma,
    Link,
    LogNormal,
    Node,
    Problem,
    Process,
    Task,
    Uniform,
)
from tests.cells.generated import MS, make_problem, make_realisation

Floats = NDArray[np.float64]
BATCHES = 40
WINDOWS = 20_040  # of 100 cycles each


def latencies_ms(run: dwell.Run) -> Floats:
    """Latency of every cycle, milliseconds; NaN where it never finished."""
    column = run.cycles.sort("cycle")["latency_ns"]
    return column.cast(float).fill_null(math.nan).to_numpy() / MS


def assert_mean(values: Floats, expected: float) -> None:
    """Assert that the mean of a correlated sequence is the expected one, by batch means.

    The means of long batches are nearly independent and normal; that the expected value lies
    outside the interval by chance has a probability of 1e-7.
    """
    batches = values[: len(values) // BATCHES * BATCHES].reshape(BATCHES, -1).mean(axis=1)
    error = batches.std(ddof=1) / math.sqrt(BATCHES)
    factor = float(student.ppf(1 - 0.5e-7, BATCHES - 1))
    assert abs(batches.mean() - expected) < factor * error
    # The interval says something: it is narrow.
    assert factor * error < 0.1 * expected


def settled(run: dwell.Run) -> Floats:
    """Latencies of a run, less its first cycles and the last ones, which may be unfinished."""
    values = latencies_ms(run)[2000:2_002_000]
    assert not np.isnan(values).any()
    return values


def one_server(
    service: Process, period_ms: float, *, node: Node | None = None, workers: int = 1
) -> Problem:
    node = node or Node("R", "robot", scheduler="fifo")
    serve = Task("serve", {node.name: Execution(service, workers=workers)})
    return make_problem([node], [serve], period_ms=period_ms, window_cycles=100)


def poisson(problem: Problem, *, seed: int, windows: int) -> Realisation:
    """Draw a realisation and release its cycles by a Poisson process of the same rate instead."""
    real = dwell.draw(problem, scenario="baseline", seed=seed, windows=windows)
    mean = problem.pipeline.period_ms * MS
    gaps = np.random.default_rng(seed).exponential(mean, real.cycles + 1)
    moved: Realisation = dataclasses.replace(real, release_ns=np.cumsum(gaps).astype(np.int64))
    return moved


# ---------------------------------------------------------------------------- queueing theory


def test_d_m_1_sojourn_is_exponential() -> None:
    # Sojourn of D/M/1 (Kleinrock, Queueing Systems I, 6.4): exponential with rate mu (1 - sigma),
    # sigma = exp(-mu (1 - sigma) P).
    period, mean = 10.0, 7.0
    mu = 1 / mean
    sigma = brentq(lambda x: x - math.exp(-mu * (1 - x) * period), 0, 1 - 1e-6)
    rate = mu * (1 - sigma)
    problem = one_server(Exponential(mean), period)
    run = dwell.simulate(problem, scenario="baseline", policy="LOC", seed=1, windows=WINDOWS)
    sojourn = settled(run)
    assert_mean(sojourn, 1 / rate)
    for share in (0.5, 0.9, 0.95):
        quantile = -math.log(1 - share) / rate
        assert_mean((sojourn > quantile).astype(np.float64), 1 - share)


def test_utilisation_is_the_offered_load() -> None:
    problem = one_server(Exponential(7.0), 10.0)
    run = dwell.simulate(problem, scenario="baseline", policy="LOC", seed=2, windows=WINDOWS)
    assert_mean(run.windows["u_R"].to_numpy(), 0.7)


@pytest.mark.parametrize("window_cycles", [1, 10])
def test_release_jitter_makes_no_misses(window_cycles: int) -> None:
    task = Task("a", {"R": Execution(Constant(20.0), workers=4)})
    problem = make_problem(
        [Node("R", "robot", cores=4)],
        [task],
        period_ms=33,
        deadline_ms=30,
        release_jitter_ms=Uniform(0.0, 30.0),
        window_cycles=window_cycles,
    )
    real = dwell.draw(problem, scenario="baseline", seed=1, windows=1000 // window_cycles)
    played = [
        dwell.simulate_realisation(problem, real, policy="LOC", by_window=by_window)
        for by_window in (False, True)
    ]
    for run in played:
        assert set(run.cycles["latency_ns"]) == {20 * MS}
        assert not run.cycles["missed"].any()
        assert run.windows["seen_violation_rate"].max() == run.windows["violation_rate"].max() == 0
        assert run.windows["seen_l95_ms"].max() == 20.0
        assert run.windows.equals(played[0].windows)
        assert run.cycles.equals(played[0].cycles)


def test_m_m_1_sojourn_is_exponential() -> None:
    problem = one_server(Exponential(6.0), 10.0)
    real = poisson(problem, seed=3, windows=WINDOWS)
    sojourn = settled(dwell.simulate_realisation(problem, real, policy="LOC"))
    rate = 1 / 6 - 1 / 10
    assert_mean(sojourn, 1 / rate)
    assert_mean((sojourn > math.log(20) / rate).astype(np.float64), 0.05)


def test_m_g_1_follows_pollaczek_and_khinchine() -> None:
    mean, cv, period = 6.0, 0.5, 10.0
    problem = one_server(Gamma(mean, cv), period)
    real = poisson(problem, seed=4, windows=WINDOWS)
    sojourn = settled(dwell.simulate_realisation(problem, real, policy="LOC"))
    load = mean / period
    wait = load * mean * (1 + cv**2) / (2 * (1 - load))
    assert_mean(sojourn, mean + wait)


def test_m_m_2_follows_erlang_c() -> None:
    mean, period = 12.0, 10.0
    node = Node("R", "robot", cores=2, scheduler="fifo")
    problem = one_server(Exponential(mean), period, node=node, workers=2)
    real = poisson(problem, seed=5, windows=WINDOWS)
    sojourn = settled(dwell.simulate_realisation(problem, real, policy="LOC"))
    # With two servers the mean sojourn is S / (1 - rho^2).
    assert_mean(sojourn, mean / (1 - (mean / period / 2) ** 2))


@pytest.mark.parametrize("service", [Constant(6.0), Exponential(6.0), Gamma(6.0, 1.5)])
def test_processor_sharing_is_insensitive_to_the_distribution(service: Process) -> None:
    # M/G/1-PS: the mean sojourn is S / (1 - rho) whatever the distribution (Kleinrock, II, 4.4).
    problem = one_server(service, 10.0, node=Node("R", "robot"), workers=1000)
    real = poisson(problem, seed=6, windows=WINDOWS)
    sojourn = settled(dwell.simulate_realisation(problem, real, policy="LOC"))
    assert_mean(sojourn, 6 / (1 - 0.6))


# --------------------------------------------------------------------------------- recursions


def fifo_server(arrival: NDArray[np.int64], service: NDArray[np.int64]) -> NDArray[np.int64]:
    """Departures of a single server in order of arrival (Lindley's recursion), nanoseconds."""
    departure = np.empty_like(arrival)
    free = 0
    for k, (arrived, needed) in enumerate(zip(arrival, service, strict=True)):
        free = max(arrived, free) + needed
        departure[k] = free
    return departure


@pytest.mark.parametrize("scheduler", ["fair", "fifo", "priority"])
def test_tandem_follows_lindley(scheduler: str) -> None:
    stages = ("R", "E", "F")
    nodes = [Node(name, "robot", scheduler=scheduler) for name in stages]  # type: ignore[arg-type]
    tasks = [Task(f"T{n}", {n: Execution(LogNormal(8, 0.4))}) for n in stages]
    links = [
        Link(a, b, LogNormal(5, 1.5), rate_mbps=100, in_order=True)
        for a, b in itertools.pairwise(stages)
    ]
    flows = [Flow("TR", "TE", 60_000), Flow("TE", "TF", 90_000)]
    problem = make_problem(nodes, tasks, flows, links=links, period_ms=10, window_cycles=50)
    real = dwell.draw(problem, scenario="baseline", seed=7, windows=40)

    instant = real.release_ns[: real.cycles]
    for stage, name in enumerate(stages):
        instant = fifo_server(instant, real.exec_ns[real.sites.index((f"T{name}", name))])
        if stage < 2:
            flow, link = flows[stage], links[stage]
            hop = real.hops.index((flow.source, flow.target, link.name))
            transmission = np.full_like(instant, flow.payload_bytes * 8000 // 100)
            sent = fifo_server(instant, transmission)
            instant = np.maximum.accumulate(sent + real.delay_ns[hop])
    latency = np.where(instant <= real.release_ns[-1], instant - real.release_ns[:-1], -1)

    run = dwell.simulate_realisation(problem, real, policy="LOC")
    found = run.cycles.sort("cycle")["latency_ns"].fill_null(-1).to_numpy()
    assert np.array_equal(found, latency)
    assert (latency > 0).sum() > 1900


def test_two_workers_follow_kiefer_and_wolfowitz() -> None:
    node = Node("R", "robot", cores=2, scheduler="fifo")
    problem = one_server(LogNormal(18, 0.6), 10.0, node=node, workers=2)
    real = dwell.draw(problem, scenario="baseline", seed=8, windows=20)
    free = [0, 0]
    expected = []
    for released, needed in zip(
        real.release_ns[:-1].tolist(), real.exec_ns[0].tolist(), strict=True
    ):
        end = max(released, min(free)) + needed
        free = [max(free), end]
        expected.append(end - released if end <= real.release_ns[-1] else None)
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    assert run.cycles.sort("cycle")["latency_ns"].to_list() == expected


# ------------------------------------------------------------------------------------ by hand


def job(name: str, ms: float, *, threads: int = 1, offset: float = 0, priority: int = 0) -> Task:
    on = {"R": Execution(Constant(ms), threads=threads)}
    return Task(name, on, offset_ms=offset, priority=priority)


def ends_ms(node: Node, tasks: Sequence[Task], changes: Sequence[NodeChange] = ()) -> list[float]:
    """End of each task's job in one cycle, milliseconds, in the order of the tasks."""
    problem = make_problem([node], tasks)
    real = make_realisation(problem, windows=1, node_changes=changes)
    run = dwell.simulate_realisation(problem, real, policy="LOC", jobs=True)
    assert run.jobs is not None
    ends = dict(zip(run.jobs["task"], run.jobs["end_ns"], strict=True))
    return [ends[task.name] / MS for task in tasks]


def test_two_jobs_share_a_core() -> None:
    # Both at half speed until B has its 4 at 8; A then needs 6 more.
    assert ends_ms(Node("R", "robot"), [job("A", 10), job("B", 4)]) == [14, 8]


def test_two_jobs_share_a_core_with_stress() -> None:
    # A third each until 12, where B is done; then a half: A has 4, needs 6, and takes 12 for it.
    stress = [NodeChange(0, "R", 1, False)]
    assert ends_ms(Node("R", "robot"), [job("A", 10), job("B", 4)], stress) == [24, 12]


def test_three_jobs_with_threads_and_stress_share_two_cores() -> None:
    # 0-2: 2 + 1 threads + 1, at 1/2.  2-4.5: C too, at 2/5, until it has its 1.  4.5-6.5: at 1/2,
    # B gets its last 1.  Then A, 2 threads + 1 on 2 cores: its last 2 at 2/3.
    stress = [NodeChange(0, "R", 1, False)]
    tasks = [job("A", 6, threads=2), job("B", 3), job("C", 1, offset=2)]
    assert ends_ms(Node("R", "robot", cores=2), tasks, stress) == [11, 6.5, 4.5]


def test_stress_that_begins_and_ends_slows_for_as_long() -> None:
    # 3 until 3; then 4 ms at 1/4 give 1; 6 are left.
    changes = [NodeChange(3 * MS, "R", 3, False), NodeChange(7 * MS, "R", 0, False)]
    assert ends_ms(Node("R", "robot"), [job("A", 10)], changes) == [13]


@pytest.mark.parametrize("scheduler", ["fair", "fifo", "priority"])
@pytest.mark.parametrize(("threads", "cores", "ends"), [(4, 1, 80), (5, 3, 100 / 3), (2, 4, 20)])
def test_a_job_wider_than_its_node_is_as_much_work_under_each_scheduler(
    scheduler: Literal["fair", "fifo", "priority"], threads: int, cores: int, ends: float
) -> None:
    node = Node("R", "robot", cores=cores, scheduler=scheduler)
    problem = make_problem([node], [job("A", 20, threads=threads)])
    real = make_realisation(problem, windows=2)
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    assert run.cycles["latency_ns"].to_list() == [math.ceil(ends * MS)] * 2
    assert run.windows["u_R"].to_list() == pytest.approx([threads * 20 / (cores * 100)] * 2)


def test_a_wide_job_is_slowed_by_stress_and_loses_nothing_when_it_is_preempted() -> None:
    # wide has 4 threads on 2 cores: 12 ms alone. It runs 0-4, waits for high until 7, and at half
    # from 9 on: 4 and 2 are done, 6 are left.
    changes = [NodeChange(9 * MS, "R", 2, False)]
    tasks = [job("wide", 6, threads=4), job("high", 3, offset=4, priority=1)]
    node = Node("R", "robot", cores=2, scheduler="priority")
    assert ends_ms(node, tasks, changes) == [21, 7]


def test_fifo_under_stress() -> None:
    # Two cores, two foreign threads: each core at half. A and B hold one each; C, of two threads,
    # waits for both, and D waits behind C although a core is free from 8 on.
    node = Node("R", "robot", cores=2, scheduler="fifo")
    stress = [NodeChange(0, "R", 2, False)]
    tasks = [job("A", 4), job("B", 6), job("C", 3, threads=2), job("D", 1)]
    assert ends_ms(node, tasks, stress) == [8, 12, 18, 20]


def test_priority_preempts() -> None:
    # low runs 0-3 and 5-6 and 10-16; middle 6-7 and 9-10; high 3-5 and 7-9.
    node = Node("R", "robot", scheduler="priority")
    tasks = [
        job("low", 10),
        job("first", 2, offset=3, priority=2),
        job("middle", 2, offset=6, priority=1),
        job("second", 2, offset=7, priority=2),
    ]
    assert ends_ms(node, tasks) == [16, 5, 10, 9]


def test_priority_under_stress_preempts_as_many_as_needed() -> None:
    # Two cores, two foreign threads: all at half. A and B run; at 4 wide (2 threads) takes both
    # cores until 4 + 2 * 3 = 10; A has 8 and B 10 of execution left.
    node = Node("R", "robot", cores=2, scheduler="priority")
    stress = [NodeChange(0, "R", 2, False)]
    tasks = [job("A", 10), job("B", 12), job("wide", 3, threads=2, offset=4, priority=1)]
    assert ends_ms(node, tasks, stress) == [26, 30, 10]


def on_accelerator(name: str, ms: float, kind: str, offset: float = 0.0) -> Task:
    execution = Execution(Constant(ms), accelerator=kind)
    return Task(name, {"R": execution}, offset_ms=offset)


def test_five_tasks_of_30_ms_on_one_accelerator_fall_behind_by_50_ms_a_cycle() -> None:
    node = Node("R", "robot", cores=4, accelerators={"gpu": 1})
    problem = make_problem([node], [on_accelerator(name, 30, "gpu") for name in "ABCDE"])
    real = make_realisation(problem, windows=6)
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    assert latencies_ms(run).tolist()[:4] == [150, 200, 250, 300]
    assert run.windows["u_R.gpu"].to_list() == [1.0] * 6
    assert run.windows["u_R"].to_list() == [0.0] * 6
    # All of it is the cell's own.
    assert run.decisions["est_u_R.gpu_LOC"].to_list() == [1.0] * 6


def test_two_kinds_of_accelerators_are_busy_on_their_own() -> None:
    # Of two places of the gpu A and B take 30 and 20 ms each; C of one of the npu takes 45.
    node = Node("R", "robot", accelerators={"gpu": 2, "npu": 1})
    tasks = [
        on_accelerator("A", 30, "gpu"),
        on_accelerator("B", 20, "gpu"),
        on_accelerator("C", 45, "npu"),
        job("D", 10),
    ]
    problem = make_problem([node], tasks, window_cycles=2)
    changes = [NodeChange(0, "R", 1, False)]
    real = make_realisation(problem, windows=3, node_changes=changes)
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    assert latencies_ms(run).tolist() == [45] * 6
    assert run.windows["u_R.gpu"].to_list() == pytest.approx([0.25] * 3)
    assert run.windows["u_R.npu"].to_list() == pytest.approx([0.45] * 3)
    # Stress keeps the CPU busy, and no accelerator.
    assert run.windows["u_R"].to_list() == [1.0] * 3


def test_a_job_that_an_accelerator_loses_was_work_until_then() -> None:
    node = Node("R", "robot", accelerators={"gpu": 1})
    problem = make_problem([node], [on_accelerator("A", 60, "gpu")])
    changes = [NodeChange(15 * MS, "R", 0, True), NodeChange(80 * MS, "R", 0, False)]
    real = make_realisation(problem, windows=2, node_changes=changes)
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    assert run.windows["u_R.gpu"].to_list() == pytest.approx([0.15, 0.6])
    assert run.cycles["outcome"].to_list() == ["node_down", "done"]
