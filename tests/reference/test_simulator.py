"""The reference simulator on cases whose numbers are worked out by hand, in milliseconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import pytest

from dwell.kernels.realisation import LinkSegment, NodeChange, Realisation
from dwell.model import (
    Constant,
    Execution,
    Flow,
    Link,
    Node,
    Placement,
    Problem,
    Task,
)
from tests.cells.generated import MS, make_problem, make_realisation
from tests.reference.simulator import Result, Split, attempt_uniform, simulate, transmission_ns

R, E = Node("R", "robot"), Node("E", "edge")


def task(name: str, ms: float, node: str = "R", **more: object) -> Task:
    fields = {key: more.pop(key) for key in ("threads", "workers", "accelerator") if key in more}
    execution = Execution(Constant(ms), **fields)  # type: ignore[arg-type]
    return Task(name, {node: execution}, **more)  # type: ignore[arg-type]


def play(problem: Problem, real: Realisation) -> Result:
    return simulate(problem, real, [problem.initial] * real.cycles)


def run(
    nodes: Sequence[Node],
    tasks: Sequence[Task],
    flows: Sequence[Flow] = (),
    *,
    links: Sequence[Link] = (),
    changes: Sequence[NodeChange] = (),
    segments: Sequence[LinkSegment] = (),
    period_ms: float = 100,
    windows: int = 1,
    exec_ms: dict[tuple[str, str], Sequence[float]] | None = None,
    delay_ms: dict[tuple[str, str, str], Sequence[float]] | None = None,
) -> Result:
    problem = make_problem(nodes, tasks, flows, links=links, period_ms=period_ms)
    real = make_realisation(
        problem,
        windows=windows,
        exec_ms=exec_ms,
        delay_ms=delay_ms,
        node_changes=changes,
        segments=segments,
    )
    return play(problem, real)


def times(result: Result, name: str, cycle: int = 0) -> tuple[float | None, ...]:
    """Ready, start and end of a job, milliseconds."""
    job = result.jobs[cycle, name]
    return tuple(None if ns is None else ns / MS for ns in (job.ready_ns, job.start_ns, job.end_ns))


def latencies(result: Result) -> list[float | None]:
    return [None if c.latency_ns is None else c.latency_ns / MS for c in result.cycles]


def outcomes(result: Result) -> list[str]:
    return [cycle.outcome for cycle in result.cycles]


# -------------------------------------------------------------------------------------- nodes


def test_one_task_takes_its_execution_time() -> None:
    result = run([R], [task("T", 30)], windows=2)
    assert latencies(result) == [30, 30]
    assert list(result.busy["R"]) == [0, 30 * MS, 60 * MS]


def test_two_jobs_share_a_core() -> None:
    # Both at half speed until B has its 4 at 8; A then needs 6 more.
    result = run([R], [task("A", 10), task("B", 4)])
    assert times(result, "B") == (0, 0, 8)
    assert times(result, "A") == (0, 0, 14)
    assert latencies(result) == [14]
    assert result.busy["R"][-1] == 14 * MS


def test_three_jobs_share_two_cores_with_stress() -> None:
    # 0-2: 3 threads + 1 on 2 cores, speed 1/2.  2-4.5: 4 + 1, speed 2/5, C gets its 1.
    # 4.5-6.5: speed 1/2, B gets its last 1.  Then A alone, 2 + 1 threads: 3 left at 2/3.
    tasks = [task("A", 6, threads=2), task("B", 3), task("C", 1, offset_ms=2)]
    stress = [NodeChange(0, "R", 1, False)]
    result = run([Node("R", "robot", cores=2)], tasks, changes=stress)
    assert times(result, "C") == (2, 2, 4.5)
    assert times(result, "B") == (0, 0, 6.5)
    assert times(result, "A") == (0, 0, 11)
    assert result.busy["R"][-1] == (2 * 11 + 1 * 89) * MS


def test_stress_that_changes_slows_a_running_job() -> None:
    changes = [NodeChange(10 * MS, "R", 1, False), NodeChange(14 * MS, "R", 0, False)]
    for scheduler in ("fair", "fifo", "priority"):
        node = Node("R", "robot", scheduler=scheduler)
        assert latencies(run([node], [task("T", 20)], changes=changes)) == [22]


def test_completion_is_rounded_up_to_a_whole_nanosecond() -> None:
    # A third of the speed: 10 ns of work take 30 ns; with 2 of 3 cores for 3 + 1 threads, 5/4.
    node = Node("R", "robot", cores=3)
    result = run([node], [task("T", 10e-6, threads=4)], period_ms=1)
    assert result.jobs[0, "T"].end_ns == math.ceil(10 * Fraction(4, 3)) == 14


def test_fifo_keeps_those_behind_one_that_does_not_fit_waiting() -> None:
    node = Node("R", "robot", cores=2, scheduler="fifo")
    result = run([node], [task("A", 4), task("B", 2, threads=2), task("C", 1)])
    assert times(result, "A") == (0, 0, 4)
    assert times(result, "B") == (0, 4, 6)
    assert times(result, "C") == (0, 6, 7)
    assert result.busy["R"][-1] == (4 + 2 * 2 + 1) * MS


def test_fifo_under_stress_runs_at_its_share_of_each_core() -> None:
    node = Node("R", "robot", cores=2, scheduler="fifo")
    changes = [NodeChange(0, "R", 3, False)]
    result = run([node], [task("A", 4), task("B", 6)], changes=changes)
    assert times(result, "A") == (0, 0, 10)
    assert times(result, "B") == (0, 0, 15)
    assert result.busy["R"][-1] == 2 * 100 * MS


def test_fifo_job_wider_than_the_node_holds_all_of_it() -> None:
    node = Node("R", "robot", cores=2, scheduler="fifo")
    result = run([node], [task("A", 5, threads=9), task("B", 1)])
    assert times(result, "A") == (0, 0, 22.5)
    assert times(result, "B") == (0, 22.5, 23.5)


def test_fifo_starts_in_the_order_of_readiness_not_of_the_worker() -> None:
    # Cycle 1 of A is ready at 10, before B's first at 12; its worker takes it at 15, when A's
    # cycle 0 ends and hands nothing over. The core goes to it and not to B.
    node = Node("R", "robot", scheduler="fifo")
    tasks = [task("A", 15), task("B", 1, offset_ms=12)]
    result = run([node], tasks, period_ms=10, windows=5)
    assert times(result, "A", 1) == (10, 15, 30)
    assert times(result, "B", 0) == (12, 30, 31)


def test_priority_preempts_and_keeps_the_work_done() -> None:
    node = Node("R", "robot", scheduler="priority")
    tasks = [task("low", 10), task("high", 2, offset_ms=3, priority=1)]
    result = run([node], tasks)
    assert times(result, "high") == (3, 3, 5)
    assert times(result, "low") == (0, 0, 12)


def test_priority_preempts_one_of_two() -> None:
    # C preempts B (ready with A, but later in the order) on 2 cores, and B comes back at 5.
    node = Node("R", "robot", cores=2, scheduler="priority")
    tasks = [task("A", 10), task("B", 10), task("C", 2, offset_ms=3, priority=5)]
    result = run([node], tasks)
    assert [times(result, name)[2] for name in "ABC"] == [10, 12, 5]


def test_priority_a_job_that_does_not_fit_blocks_lower_ones() -> None:
    node = Node("R", "robot", cores=2, scheduler="priority")
    tasks = [
        task("top", 4, priority=2),
        task("wide", 3, threads=2, priority=1),
        task("low", 1),
    ]
    result = run([node], tasks)
    assert times(result, "wide") == (0, 4, 7)
    assert times(result, "low") == (0, 7, 8)


def test_accelerator_serves_one_after_another_untouched_by_stress() -> None:
    node = Node("R", "robot", accelerators={"gpu": 1})
    tasks = [
        task("A", 5, accelerator="gpu", threads=7),
        task("B", 3, accelerator="gpu"),
        task("C", 4),
    ]
    result = run([node], tasks, changes=[NodeChange(0, "R", 1, False)])
    assert times(result, "A") == (0, 0, 5)
    assert times(result, "B") == (0, 5, 8)
    assert times(result, "C") == (0, 0, 8)
    assert result.busy["R"][-1] == 100 * MS
    assert result.busy["R.gpu"][-1] == (5 + 3) * MS
    assert result.windows[-1].closed["R.gpu"].own == (5 + 3) * MS


# --------------------------------------------------------------------------- workers and inputs


def test_one_worker_takes_one_job_at_a_time() -> None:
    result = run([Node("R", "robot", cores=4)], [task("T", 25)], period_ms=10, windows=6)
    assert latencies(result)[:2] == [25, 40]
    assert times(result, "T", 1) == (10, 25, 50)
    assert outcomes(result) == ["done"] * 2 + ["in_flight"] * 4


def test_two_workers_take_two() -> None:
    node = Node("R", "robot", cores=4)
    result = run([node], [task("T", 25, workers=2)], period_ms=10, windows=6)
    assert times(result, "T", 1) == (10, 10, 35)
    assert times(result, "T", 2) == (20, 25, 50)


def test_latest_replaces_the_waiting_job_never_the_running_one() -> None:
    result = run([R], [task("T", 25, depth=1)], period_ms=10, windows=6)
    # 0 runs to 25; 1 waits at 10 and is replaced by 2 at 20; 2 runs to 50, 3 is replaced by 4.
    # At 50 the completion comes before the release: 4 is taken, and 5 waits.
    assert outcomes(result) == ["done", "replaced", "done", "replaced", "in_flight", "in_flight"]
    assert times(result, "T", 2) == (20, 25, 50)
    assert times(result, "T", 4) == (40, 50, None)
    assert times(result, "T", 5) == (50, None, None)


def test_depth_bounds_how_many_wait() -> None:
    result = run([R], [task("T", 45, depth=2)], period_ms=10, windows=6)
    assert outcomes(result)[:3] == ["done", "replaced", "replaced"]
    assert times(result, "T", 3) == (30, 45, None)


def test_an_older_cycle_that_comes_late_to_a_full_input_is_the_one_lost() -> None:
    # Cycle 0 holds the worker; cycle 2 overtakes 1 on the link and waits; then 1 comes.
    result = run(
        [R, E],
        [task("A", 1), task("B", 50, node="E", depth=1)],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(0))],
        delay_ms={("A", "B", "R->E"): [0, 18, 2]},
        period_ms=10,
        windows=3,
    )
    assert outcomes(result) == ["in_flight", "replaced", "in_flight"]
    assert result.jobs[1, "B"].ready_ns == 29 * MS
    assert result.jobs[1, "B"].outcome == "replaced"


def test_a_join_waits_for_its_last_input_and_the_sink_that_is_last_counts() -> None:
    tasks = [task("A", 4), task("B", 9, node="E"), task("C", 5), task("D", 1), task("F", 8)]
    flows = [Flow("A", "C"), Flow("B", "C"), Flow("C", "D"), Flow("A", "F")]
    links = [Link("E", "R", Constant(2))]
    result = run([Node("R", "robot", cores=4), E], tasks, flows, links=links)
    assert times(result, "C") == (11, 11, 16)
    assert times(result, "F") == (4, 4, 12)
    cycle = result.cycles[0]
    assert cycle.latency_ns == 17 * MS
    assert cycle.splits == {Split(15 * MS, 0, 2 * MS)}


def test_latency_splits_into_compute_queue_and_network() -> None:
    # A starts 3 after the release; B waits 2 behind the job of the cycle before.
    result = run(
        [R, E],
        [task("A", 4, offset_ms=3), task("B", 12, node="E")],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(1))],
        period_ms=10,
        windows=5,
    )
    first, second = result.cycles[0], result.cycles[1]
    assert first.latency_ns == 20 * MS
    assert first.splits == {Split(16 * MS, 3 * MS, 1 * MS)}
    assert second.latency_ns == 22 * MS
    assert second.splits == {Split(16 * MS, 5 * MS, 1 * MS)}


def test_inputs_that_arrive_at_the_same_instant_split_a_latency_in_two_ways() -> None:
    # C comes over a link that clamps it to the arrival of B: either path is the last one.
    result = run(
        [R, E],
        [task("A", 1), task("B", 3), task("C", 5), task("D", 1, node="E")],
        [Flow("B", "D"), Flow("C", "D"), Flow("A", "B"), Flow("A", "C")],
        links=[Link("R", "E", Constant(0), in_order=True)],
        delay_ms={("B", "D", "R->E"): [20], ("C", "D", "R->E"): [2]},
    )
    cycle = result.cycles[0]
    # B has its 3 by 7, and C its 5 by 9; both arrive at 27.
    assert cycle.latency_ns == 28 * MS
    assert cycle.splits == {Split(8 * MS, 0, 20 * MS), Split(10 * MS, 0, 18 * MS)}


def test_completion_hands_over_before_the_worker_takes_the_next() -> None:
    # At 10 A's job of cycle 0 hands over to B. Cycle 1 of A, ready at 5, goes before it; cycle 2,
    # ready at 10 like B, after it, for its cycle is the later one.
    node = Node("R", "robot", scheduler="fifo")
    result = run([node], [task("A", 10), task("B", 1)], [Flow("A", "B")], period_ms=5, windows=8)
    assert times(result, "A", 1) == (5, 10, 20)
    assert times(result, "B", 0) == (10, 20, 21)
    assert times(result, "A", 2) == (10, 21, 31)
    assert outcomes(result) == ["done"] + ["in_flight"] * 7


def test_completion_at_the_end_of_the_run_counts_and_release_does_not() -> None:
    assert outcomes(run([R], [task("T", 10)], period_ms=10)) == ["done"]
    assert outcomes(run([R], [task("T", 10.000001)], period_ms=10)) == ["in_flight"]


def test_cycles_keep_the_placement_they_were_released_with() -> None:
    both = Task("B", {"R": Execution(Constant(6)), "E": Execution(Constant(3))})
    problem = make_problem(
        [R, E],
        [task("A", 5), both],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(1))],
        candidates={"LOC": {"B": "R"}, "OFF": {"B": "E"}},
        period_ms=20,
    )
    assert problem.candidates["OFF"] == Placement({"A": "R", "B": "E"})
    real = make_realisation(problem, windows=3)
    result = simulate(problem, real, ["LOC", "OFF", "LOC"])
    assert latencies(result) == [11, 9, 11]
    assert [result.jobs[k, "B"].node for k in range(3)] == ["R", "E", "R"]


# ------------------------------------------------------------------------------------ node down


def down(at: float, until: float, node: str = "E") -> list[NodeChange]:
    return [NodeChange(int(at * MS), node, 0, True), NodeChange(int(until * MS), node, 0, False)]


def test_a_node_that_goes_down_loses_what_it_has() -> None:
    result = run([E], [task("T", 15, node="E")], changes=down(12, 25), period_ms=10, windows=5)
    # 0 runs, 1 waits, 2 is released while it is down.
    assert outcomes(result) == ["node_down"] * 3 + ["done", "in_flight"]
    assert (0, "T") in result.jobs
    assert times(result, "T", 2) == (20, None, 20)
    assert result.busy["E"][-1] == (12 + 20) * MS


def test_stress_does_not_show_while_the_node_is_down() -> None:
    changes = [
        NodeChange(0, "E", 1, False),
        NodeChange(10 * MS, "E", 1, True),
        NodeChange(30 * MS, "E", 1, False),
    ]
    result = run([E], [task("T", 1, node="E")], changes=changes)
    assert result.busy["E"][-1] == 80 * MS


def test_workers_of_a_restarted_node_start_late() -> None:
    tasks = [task("T", 4, node="E", start_ms=8, depth=1)]
    result = run([E], tasks, changes=down(5, 15), period_ms=10, windows=5)
    # Up at 15, ready at 23: cycle 2, released at 20, waits for the worker.
    assert outcomes(result) == ["done", "node_down", "done", "done", "done"]
    assert times(result, "T", 2) == (20, 23, 27)


def test_inputs_that_wait_for_the_rest_of_their_join_are_lost() -> None:
    result = run(
        [R, E],
        [task("A", 1), task("B", 30), task("C", 1, node="E")],
        [Flow("A", "C"), Flow("B", "C")],
        links=[Link("R", "E", Constant(1))],
        changes=down(10, 12),
    )
    assert outcomes(result) == ["node_down"]
    assert (0, "C") not in result.jobs


def test_messages_that_arrive_at_a_node_that_is_down_are_lost() -> None:
    result = run(
        [R, E],
        [task("A", 1), task("C", 1, node="E")],
        [Flow("A", "C")],
        links=[Link("R", "E", Constant(2))],
        changes=down(2, 4),
        period_ms=10,
        windows=2,
    )
    assert outcomes(result) == ["node_down", "done"]


# ---------------------------------------------------------------------------------------- links


def chain(
    link: Link,
    *,
    period_ms: float = 10,
    windows: int = 3,
    segments: Sequence[LinkSegment] = (),
    delays: Sequence[float] | None = None,
) -> Result:
    """A on R takes 1, sends 125 kB (1 ms at 1000 Mbit/s) to B on E, which takes nothing."""
    return run(
        [R, E],
        [task("A", 1), task("B", 0, node="E", workers=9)],
        [Flow("A", "B", 125_000)],
        links=[link],
        segments=segments,
        period_ms=period_ms,
        windows=windows,
        delay_ms={("A", "B", "R->E"): delays} if delays is not None else None,
    )


def segment(at: float, *, loss: float = 0, rate: float = 1000, down: bool = False) -> LinkSegment:
    return LinkSegment(int(at * MS), "R->E", down, loss, rate, ())


def test_transmission_and_propagation() -> None:
    assert latencies(chain(Link("R", "E", Constant(5), rate_mbps=1000))) == [7, 7, 7]
    assert latencies(chain(Link("R", "E", Constant(5)))) == [6, 6, 6]
    assert transmission_ns(60_000, 1000) == 480_000
    assert transmission_ns(1, 16_000) == 0  # half a nanosecond: to even
    assert transmission_ns(3, 16_000) == 2


def test_messages_queue_for_their_transmission() -> None:
    # 12 ms each: sent at 1, 11, 21, 31, 41; begun at 1, 13, 25, 37, 49.
    link = Link("R", "E", Constant(0), rate_mbps=1000 / 12)
    assert latencies(chain(link, windows=5)) == [13, 15, 17, 19, None]


def test_messages_overtake_unless_in_order() -> None:
    delays = [25.0, 1, 1]
    free = chain(Link("R", "E", Constant(0)), delays=delays, windows=3)
    assert latencies(free) == [26, 2, 2]
    clamped = chain(Link("R", "E", Constant(0), in_order=True), delays=delays, windows=3)
    assert latencies(clamped) == [26, 16, 6]


def test_the_state_of_the_link_is_the_one_at_the_begin_of_transmission() -> None:
    # At 1.5, in the middle of the first transmission, the link slows to a fifth.
    segments = [segment(0), segment(1.5, rate=200)]
    result = chain(Link("R", "E", Constant(1), rate_mbps=1000), segments=segments)
    assert latencies(result) == [3, 7, 7]


def test_a_link_that_is_down_drops() -> None:
    segments = [segment(0), segment(11, down=True), segment(11.5)]
    result = chain(Link("R", "E", Constant(1), rate_mbps=1000), segments=segments)
    assert outcomes(result) == ["done", "dropped", "done"]


def test_a_dropped_message_takes_its_transmission_time_unless_the_link_is_down() -> None:
    # Two messages at once, each 1 ms; the first is lost (loss 1 until the second begins).
    for lost, arrival in ((segment(0, loss=1), 4), (segment(0, down=True), 3)):
        result = run(
            [R, E],
            [task("A", 1), task("B", 0, node="E"), task("C", 0, node="E")],
            [Flow("A", "B", 125_000), Flow("A", "C", 125_000)],
            links=[Link("R", "E", Constant(1), rate_mbps=1000)],
            segments=[lost, segment(1.5)] if lost.loss else [lost, segment(1.0)],
        )
        if lost.loss:
            assert outcomes(result) == ["dropped"]
            assert result.jobs[0, "C"].ready_ns == arrival * MS
        else:  # the link is up again at 1, the instant at which A sends
            assert outcomes(result) == ["done"]
            assert result.jobs[0, "B"].ready_ns == arrival * MS


def test_retransmission_waits_for_the_link_and_keeps_the_order() -> None:
    link = Link("R", "E", Constant(1), rate_mbps=1000, retransmit_ms=3)
    segments = [segment(0), segment(0.5, down=True), segment(20)]
    result = chain(link, segments=segments)
    # The first two wait until 20 and take a millisecond each; the third, sent at 21, waits for 22.
    assert latencies(result) == [22, 13, 4]


def repeated(*, in_order: bool, segments: Sequence[LinkSegment] = ()) -> Result:
    """Six messages of which the first is lost, and sent again at 27."""
    link = Link("R", "E", Constant(0), retransmit_ms=25, in_order=in_order)
    return chain(link, windows=6, segments=[segment(0, loss=1), segment(5), *segments])


def test_messages_wait_for_one_that_is_repeated_where_order_is_kept() -> None:
    assert latencies(repeated(in_order=False))[:4] == [28, 2, 2, 2]
    assert latencies(repeated(in_order=True))[:4] == [28, 18, 8, 2]


def test_messages_do_not_wait_for_one_that_is_dropped() -> None:
    link = Link("R", "E", Constant(0), in_order=True)
    result = chain(link, segments=[segment(0, loss=1), segment(5)], delays=[25.0, 1, 1])
    assert latencies(result) == [None, 3, 3]


def test_messages_wait_for_a_repeat_that_waits_for_the_end_of_an_outage() -> None:
    # From 40 on messages 2, 0 and 3 are sent in this order; 1 and 2 wait for 0.
    outage = [segment(20, down=True), segment(40)]
    assert latencies(repeated(in_order=False, segments=outage))[:4] == [42, 2, 21, 13]
    assert latencies(repeated(in_order=True, segments=outage))[:4] == [42, 32, 22, 13]


def test_messages_wait_for_ever_for_a_repeat_that_does() -> None:
    for_good = [segment(20, down=True)]
    free, kept = (repeated(in_order=order, segments=for_good) for order in (False, True))
    assert outcomes(free) == ["in_flight", "done", *["in_flight"] * 4]
    assert outcomes(kept) == ["in_flight"] * 6


def test_a_lost_attempt_is_sent_again_behind_what_is_queued() -> None:
    link = Link("R", "E", Constant(1), rate_mbps=1000, retransmit_ms=9.5)
    segments = [segment(0, loss=1), segment(2)]
    result = chain(link, segments=segments)
    # Lost at 1-2, sent again at 11.5 behind cycle 1, which is sent at 11 and takes until 12.
    assert latencies(result) == [14, 3, 3]
    assert result.cycles[0].splits == {Split(1 * MS, 0, 13 * MS)}


def test_loss_is_a_function_of_stream_cycle_and_attempt() -> None:
    loss = 0.5
    link = Link("R", "E", Constant(0), loss=loss, retransmit_ms=2)
    result = chain(link, windows=20)
    for k in range(19):
        attempts = 0
        while attempt_uniform(0, k, attempts) < loss:
            attempts += 1
        if attempts < 5:
            assert result.cycles[k].latency_ns == (1 + 2 * attempts) * MS
    dropped = chain(Link("R", "E", Constant(0), loss=loss), windows=20)
    assert [cycle.outcome == "dropped" for cycle in dropped.cycles] == [
        attempt_uniform(0, k, 0) < loss for k in range(20)
    ]


def test_attempt_uniform_is_uniform() -> None:
    values = [attempt_uniform(k * 12345, k, a) for k in range(200) for a in range(50)]
    assert all(0 <= value < 1 for value in values)
    assert sum(values) / len(values) == pytest.approx(0.5, abs=0.015)
    assert len(set(values)) == len(values)


def test_layers_add_to_the_delay_of_a_message() -> None:
    problem = make_problem(
        [R, E],
        [task("A", 1), task("B", 0, node="E")],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(1))],
        period_ms=10,
    )
    hop = ("A", "B", "R->E")
    real = make_realisation(
        problem,
        windows=4,
        extra_ms={(hop, 0): [2, 2, 2, 2], (hop, 1): [3, 3, 3, 3]},
        segments=[
            LinkSegment(0, "R->E", False, 0, math.inf, ()),
            LinkSegment(10 * MS, "R->E", False, 0, math.inf, (1,)),
            LinkSegment(20 * MS, "R->E", False, 0, math.inf, (0, 1)),
            LinkSegment(30 * MS, "R->E", False, 0, math.inf, (0,)),
        ],
    )
    assert latencies(play(problem, real)) == [2, 5, 7, 4]


def test_the_first_loss_names_the_outcome() -> None:
    tasks = [task("A", 1), task("B", 0, node="E"), task("C", 0, node="F")]
    nodes = [R, E, Node("F", "cloud")]
    links = [Link("R", "E", Constant(5)), Link("R", "F", Constant(1), loss=0.999999)]
    flows = [Flow("A", "B"), Flow("A", "C")]
    assert outcomes(run(nodes, tasks, flows, links=links, changes=down(0, 50))) == ["dropped"]
    late = [task("A", 1), task("B", 0, node="E"), task("C", 0, node="F")]
    flows = [Flow("A", "B"), Flow("B", "C")]
    links = [Link("R", "E", Constant(5)), Link("E", "F", Constant(1), loss=0.999999)]
    assert outcomes(run(nodes, late, flows, links=links, changes=down(0, 50))) == ["node_down"]


# -------------------------------------------------------------------------------- near events


def test_events_that_come_close_by_chance_are_seen() -> None:
    apart = run([R, E], [task("A", 1), task("B", 2, node="E")])
    assert apart.closest_ns is None
    near = run([R, E], [task("A", 1), task("B", 1.0009, node="E")])
    assert near.closest_ns == 900
    assert run([R, E], [task("A", 1), task("B", 1.001, node="E")]).closest_ns is None


def test_events_that_cause_one_another_may_be_close() -> None:
    tasks = [task("A", 1), task("B", 1e-4), task("C", 0)]
    result = run([R], tasks, [Flow("A", "B"), Flow("B", "C")])
    assert result.closest_ns is None
