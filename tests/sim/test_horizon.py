"""Times that 64 bits of nanoseconds may not hold: refused, or played as what they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.errors import ProblemError, SimulationError
from dwell.model import (
    Bursts,
    Constant,
    ControllerSettings,
    Episodes,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Problem,
    Quota,
    Task,
)
from dwell.study.summary import summarise
from tests.cells.generated import make_problem

LONG_MS = 1e9
SCHEDULERS = ("fair", "fifo", "priority")


def alone(exec_ms: float, *scenario: NodeDisturbance, node: Node, **timing: float) -> Problem:
    """Return one task on one node."""
    tasks = [Task("a", {node.name: Execution(Constant(exec_ms))})]
    return make_problem([node], tasks, [], scenario=scenario, **timing)  # type: ignore[arg-type]


def sending(link: Link, *scenario: LinkDisturbance, payload: int = 1, **timing: float) -> Problem:
    """Return a task on R that sends to one on E."""
    return make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task(name, {node: Execution(Constant(1.0))}) for name, node in (("a", "R"), ("b", "E"))],
        [Flow("a", "b", payload)],
        links=[link],
        scenario=scenario,
        **timing,  # type: ignore[arg-type]
    )


E = Node("E", "edge")


def test_291_years_are_played_and_294_are_refused_with_keys_values_and_bound() -> None:
    problem = alone(10, node=E, period_ms=LONG_MS, window_cycles=50)
    run = dwell.simulate(problem, seed=1, windows=184)
    assert (run.cycles["latency_ns"] == 10_000_000).all()
    assert run.cycles["release_ns"][-1] == 9199 * 10**15
    row = summarise(run, problem, {}).row
    assert row["violation_rate"] == 0
    assert row["aoi_peak_ms"] == pytest.approx(LONG_MS + 10)
    with pytest.raises(ProblemError) as error:
        dwell.simulate(problem, seed=1, windows=185)
    message = str(error.value)
    assert all(part in message for part in ("period_ms", "1e9", "185", "window_cycles", "9.2e9"))


def test_more_cycles_than_an_event_counts_are_refused() -> None:
    problem = alone(1, node=E, period_ms=1e-3, window_cycles=1_000_000)
    with pytest.raises(ProblemError, match=r"windows: 4295 windows of window_cycles = 1000000 "):
        dwell.simulate(problem, seed=1, windows=4295)


def test_a_run_that_no_memory_holds_is_refused_before_it_is_drawn() -> None:
    problem = alone(1, node=E, period_ms=1, window_cycles=1_000_000)
    with pytest.raises(SimulationError, match=r"4294 windows .* 4294000000 cycles.*GB"):
        dwell.simulate(problem, seed=1, windows=4294)
    tiny = Constant(0.01)
    bursty = alone(1, node=replace(E, bursts=Bursts(tiny, tiny, threads=1)), period_ms=LONG_MS)
    with pytest.raises(SimulationError, match=r"9000 windows of 'baseline' .*bursts"):
        dwell.simulate(bursty, seed=1, windows=9000)


def test_a_cell_of_which_no_window_fits_is_refused_when_it_is_made() -> None:
    with pytest.raises(ProblemError, match=r"window_cycles: 1 window of window_cycles = 10000 "):
        alone(1, node=E, period_ms=LONG_MS, window_cycles=10_000)


def test_a_jitter_that_moves_releases_beyond_the_bound_is_refused() -> None:
    problem = alone(10, node=E, period_ms=LONG_MS, window_cycles=50)
    pipeline = replace(problem.pipeline, release_jitter_ms=LogNormal(1e9, 100))
    late = replace(problem, pipeline=pipeline)
    with pytest.raises(ProblemError, match=r"release_jitter_ms: .* 9\.2e9 s"):
        dwell.simulate(late, seed=1, windows=184)


@pytest.mark.parametrize("scheduler", SCHEDULERS)
@pytest.mark.parametrize(
    ("exec_ms", "threads", "others"),
    [(1e7, 1_000_000, {}), (1e9, 1_000_000, {"interference": 100.0}), (1e9, 10, {})],
)
def test_a_job_that_foreign_threads_stretch_beyond_the_run_is_in_flight(
    scheduler: str, exec_ms: float, threads: int, others: dict[str, float]
) -> None:
    node = Node("E", "edge", scheduler=scheduler, **others)  # type: ignore[arg-type]
    stress = NodeDisturbance("E", stress_threads=threads)
    problem = alone(exec_ms, stress, node=node, period_ms=1e6, window_cycles=2)
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=50)
    assert (run.cycles["outcome"] == "in_flight").all()
    assert run.cycles["latency_ns"].null_count() == 100


def test_a_stretch_that_64_bits_hold_is_exact() -> None:
    stress = NodeDisturbance("E", stress_threads=1_000_000)
    problem = alone(1e6, stress, node=E, period_ms=LONG_MS, window_cycles=1)
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=3000)
    # 1e6 ms beside a million others.
    assert run.cycles["latency_ns"][0] == 1_000_001 * 10**12


def test_drawn_and_scaled_times_are_not_cut_at_three_years() -> None:
    task = Task("a", {"E": Execution(Constant(1e9))}, scale="size")
    problem = make_problem([E], [task], period_ms=LONG_MS, scales={"size": Constant(400.0)})
    run = dwell.simulate(problem, seed=1, windows=1000)
    assert run.cycles["latency_ns"][0] == 400 * 10**15


@pytest.mark.parametrize("at_s", [5e7, 1e8, 2e8, 9e8])
def test_what_begins_late_begins_and_what_has_no_end_lasts(at_s: float) -> None:
    stress = NodeDisturbance("E", at_s=at_s, stress_threads=1)
    problem = alone(1000, stress, node=E, period_ms=LONG_MS, window_cycles=1)
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=1000)
    began = round(at_s / 1e6)
    ms = (run.cycles["latency_ns"] / 1e6).to_list()
    assert ms == [1000.0] * began + [2000.0] * (1000 - began)


def test_episodes_and_bursts_go_on_after_three_years() -> None:
    wind = Episodes("wind", Constant(1e6), Constant(1e6))
    stress = NodeDisturbance("E", stress_threads=1, episodes=wind)
    node = replace(E, bursts=Bursts(Constant(3e9 / 3), Constant(3e9 / 3), threads=2))
    problem = alone(1000, stress, node=node, period_ms=LONG_MS, window_cycles=1)
    real = dwell.draw(problem, scenario="disturbed", seed=1, windows=400)
    ends = [change for change in real.node_changes if change.at_ns > 300 * 10**15]
    assert {change.threads for change in ends} == {0, 3}


def test_a_ramp_of_thirty_years_is_split_into_its_steps() -> None:
    delay = LinkDisturbance("R", "E", add_delay_ms=Constant(1e9), ramp_s=1e8)
    link = Link("R", "E", Constant(0.0))
    problem = sending(link, delay, period_ms=LONG_MS, window_cycles=1)
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=200)
    assert run.cycles["latency_ns"][150] == (10**9 + 2) * 10**6


@pytest.mark.parametrize("retransmit_ms", [None, 1e9])
def test_messages_that_take_longer_than_the_run_never_arrive(retransmit_ms: float | None) -> None:
    link = Link("R", "E", Constant(1e9), rate_mbps=1e-4, retransmit_ms=retransmit_ms)
    problem = sending(link, payload=10**12, period_ms=1e6, window_cycles=2)
    run = dwell.simulate(problem, seed=1, windows=50)
    assert (run.cycles["outcome"] == "in_flight").all()


def test_extra_delays_whose_sum_64_bits_do_not_hold_never_arrive() -> None:
    long = LogNormal(1e9, 100)
    delays = [LinkDisturbance("R", "E", add_delay_ms=long) for _ in range(60)]
    scaled = [replace(one, add_delay_ms=Constant(1e9)) for one in delays]
    link = Link("R", "E", Constant(1e9), in_order=True)
    for items in (delays, scaled):
        problem = sending(link, *items, period_ms=1e6, window_cycles=2)
        run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=50)
        assert (run.cycles["outcome"] == "in_flight").all()


def test_a_guard_with_more_patience_than_the_run_never_fires() -> None:
    patient = ControllerSettings(fallbacks=("LOC",), guard_cycles=1_000_000)
    problem = replace(alone(10, node=E, period_ms=LONG_MS, window_cycles=2), controller=patient)
    run = dwell.simulate(problem, seed=1, windows=50, guard=True)
    assert not (run.decisions["reason"] == "guard").any()


def test_the_utilisation_of_many_cores_over_291_years_is_theirs() -> None:
    node = Node("E", "edge", cores=4)
    stress = NodeDisturbance("E", stress_threads=4)
    problem = alone(10, stress, node=node, period_ms=LONG_MS, window_cycles=50)
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=184)
    assert np.allclose(run.windows["u_E"], 1.0)


def test_background_that_hardly_ever_wakes_never_does() -> None:
    quota = Quota(0.5, 10, tick_ms=4)
    node = Node("E", "edge", quota=quota, background=0.1, background_hz=1e-300)
    run = dwell.simulate(alone(10, node=node, period_ms=100), seed=1, windows=2)
    assert run.cycles["latency_ns"].null_count() == 0


def test_a_job_begins_with_the_mean_of_turns_that_64_bits_do_not_sum_up() -> None:
    """Half a million threads wait beside one that has had the core for hours, and so does it."""
    node = Node("E", "edge", quota=Quota(1.0, 1000, tick_ms=1000))
    busy = NodeDisturbance("E", stress_threads=1)
    many = NodeDisturbance("E", at_s=20_000, stress_threads=500_000)
    problem = alone(5000, busy, many, node=node, period_ms=LONG_MS / 100, window_cycles=1)
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=4)
    assert run.cycles["outcome"].to_list() == ["done", "done", "in_flight", "in_flight"]
