"""What follows from the messages of one cycle: latency and its parts, jobs, evidence."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

import dwell
from dwell.control import NOT_DUE
from dwell.live.roles.cycle_ledger import UNKNOWN, Ledger, LiveCycle
from dwell.live.roles.live_evidence import LiveEvidence
from dwell.live.roles.offsets import UNBOUNDED_NS, Offsets
from dwell.live.wire.messages import Completion, Hop, Stamp
from dwell.model import Problem
from dwell.model.instants import NEVER_NS

MS = 1_000_000
RELEASE_NS = 50 * MS
#: What a cycle under SO does: begin and end of its jobs, ms after the release.
JOBS = {
    "sensing": ("R1", 0.0, 0.0, 3.0),
    "perception": ("E", 6.0, 8.0, 18.0),
    "planning": ("E", 18.5, 18.5, 24.0),
    "control": ("R2", 25.0, 25.0, 25.5),
}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load("examples/canonical.yaml")


@pytest.fixture
def ledger(problem: Problem) -> Ledger:
    return Ledger(problem, Offsets("E", problem.stamper_node, system_bound_ns=0))


def stamp(number: int, placement: str = "SO", shadow: str = "") -> Stamp:
    return Stamp(1, number, 1, placement, RELEASE_NS, shadow)


def cycle(number: int = 0, *, placement: str = "SO", shadow: str = "") -> LiveCycle:
    who = 1, number, 1, placement, shadow
    return LiveCycle(*who, RELEASE_NS, 0, heard=True, idle=False)


CPU_NS = 2 * MS


def hop(task: str, *, source: str = "", ended: bool = True) -> Hop:
    node, ready, begin, end = JOBS[task]
    at = [RELEASE_NS + round(ms * MS) for ms in (ready, begin, end)]
    inputs = ((source, at[0]),) if source else ()
    return Hop(task, node, at[0], at[1], at[2] if ended else UNKNOWN, inputs, cpu_ns=CPU_NS)


def hops() -> tuple[Hop, ...]:
    names = list(JOBS)
    return tuple(
        hop(name, source=before) for before, name in zip(["", *names], names, strict=False)
    )


def completion(one: LiveCycle, outcome: str = "actuated") -> Completion:
    done_ns = RELEASE_NS + round(25.5 * MS)
    return Completion(stamp(one.number), "control", done_ns, outcome, hops(), "R2")


def test_a_latency_is_parted_along_its_critical_path(ledger: Ledger) -> None:
    one = cycle()
    ledger.settle(one)
    assert (one.latency_ns, one.parts_ns) == (NEVER_NS, None)
    assert one.take(completion(one), RELEASE_NS + 27 * MS)
    ledger.settle(one)
    assert one.latency_ns == round(25.5 * MS)
    compute, network = 3.0 + 10.0 + 5.5 + 0.5, 3.0 + 1.0
    expected = (compute, 25.5 - compute - network, network)
    assert one.parts_ns == tuple(round(ms * MS) for ms in expected)
    assert one.actuated
    assert not one.missed(26 * MS)
    assert one.missed(25 * MS)


def test_a_copy_of_a_completion_changes_nothing(ledger: Ledger) -> None:
    one = cycle()
    assert one.take(completion(one), 1)
    assert not one.take(completion(one, "stale"), 2)
    assert one.heard_ns == {"control": 1}
    assert one.actuated


def test_what_the_stamper_heard_counts_until_the_sink_says_so_itself(ledger: Ledger) -> None:
    one = cycle()
    one.stamper_interval_ns = 30 * MS
    ledger.settle(one)
    assert (one.latency_ns, one.told) == (30 * MS, True)
    one.take(completion(one), None)
    ledger.settle(one)
    assert (one.latency_ns, one.told) == (round(25.5 * MS), False)


def test_jobs_have_their_instants_and_one_that_was_replaced_only_its_readiness(
    ledger: Ledger, problem: Problem
) -> None:
    one = cycle()
    one.row = 7
    one.take(completion(one), None)
    rows = ledger.jobs(one)
    assert [(row["task"], row["node"]) for row in rows] == [(t, of[0]) for t, of in JOBS.items()]
    for row, (_, *instants) in zip(rows, JOBS.values(), strict=True):
        at = [round(ms * MS) + RELEASE_NS for ms in instants]
        assert [row["ready_ns"], row["start_ns"], row["end_ns"]] == at
        assert (row["cycle"], row["outcome"], row["shadow"]) == (7, "done", False)
    gone = cycle(1)
    replaced = (hop("sensing"), hop("perception", source="sensing", ended=False))
    gone.take(Completion(stamp(1), "perception", RELEASE_NS, "replaced", replaced, "E"), None)
    assert [(row["task"], row["outcome"]) for row in ledger.jobs(gone)] == [
        ("sensing", "done"),
        ("perception", "replaced"),
    ]
    assert [row["end_ns"] is None for row in ledger.jobs(gone)] == [False, True]


def test_evidence_is_what_had_happened_at_the_close(ledger: Ledger, problem: Problem) -> None:
    done, silent = cycle(), cycle(1)
    done.take(completion(done), None)
    close_ns = RELEASE_NS + 20 * MS
    release_ns = np.array([RELEASE_NS, RELEASE_NS])
    found = LiveEvidence(problem, ledger).known([done, silent], release_ns, close_ns, shadows=False)
    tasks = list(problem.pipeline.tasks)
    ended = dict(zip(tasks, found.cycles.end_ns[0].tolist(), strict=True))
    assert ended == {
        "sensing": RELEASE_NS + 3 * MS,
        "perception": RELEASE_NS + 18 * MS,
        "planning": UNKNOWN,
        "control": UNKNOWN,
    }
    assert found.cycles.start_ns is not None
    started = [RELEASE_NS, RELEASE_NS + 8 * MS, RELEASE_NS + round(18.5 * MS), UNKNOWN]
    assert found.cycles.start_ns[0].tolist() == started
    assert found.cycles.work_ns is not None
    assert found.cycles.work_ns[0].tolist() == [CPU_NS, CPU_NS, UNKNOWN, UNKNOWN]
    assert (found.cycles.start_ns[1] == UNKNOWN).all()
    assert (found.cycles.work_ns[1] == UNKNOWN).all()
    assert not found.shadows_share
    assert found.placement.tolist() == [list(problem.candidates).index("SO")] * 2
    assert found.shadows is None
    # Of one that never came, the first message to another node is taken to have been lost.
    assert found.cycles.end_ns[1, tasks.index("sensing")] == RELEASE_NS
    assert (found.cycles.arrived_ns[1] == UNKNOWN).all()


def test_what_is_not_due_in_a_cycle_is_not_due_in_its_shadow(problem: Problem) -> None:
    tasks = dict(problem.pipeline.tasks)
    tasks["sensing"] = dataclasses.replace(tasks["sensing"], every=2)
    pipeline = dataclasses.replace(problem.pipeline, tasks=tasks)
    slow = dataclasses.replace(problem, pipeline=pipeline)
    ledger = Ledger(slow, Offsets("E", problem.stamper_node, system_bound_ns=0))
    both = [cycle(number, shadow="LOC") for number in (0, 1)]
    release_ns, close_ns = np.array([RELEASE_NS, RELEASE_NS]), RELEASE_NS + 20 * MS
    found = LiveEvidence(slow, ledger).known(both, release_ns, close_ns, shadows=True)
    assert found.shadows is not None
    for instants in (found.shadows.end_ns, found.shadows.arrived_ns):
        assert (instants[0] == UNKNOWN).all()
        assert (instants[1] == NOT_DUE).all()


def test_work_on_an_accelerator_is_the_time_that_a_job_had_it(problem: Problem) -> None:
    fabric, pipeline = problem.fabric, problem.pipeline
    edge = dataclasses.replace(fabric.nodes["E"], accelerators={"gpu": 1})
    perception = pipeline.tasks["perception"]
    served = dataclasses.replace(perception.on["E"], accelerator="gpu")
    perception = dataclasses.replace(perception, on={**perception.on, "E": served})
    accelerated = dataclasses.replace(
        problem,
        fabric=dataclasses.replace(fabric, nodes={**fabric.nodes, "E": edge}),
        pipeline=dataclasses.replace(pipeline, tasks={**pipeline.tasks, "perception": perception}),
    )
    ledger = Ledger(accelerated, Offsets("E", problem.stamper_node, system_bound_ns=0))
    one = cycle()
    one.take(completion(one), None)
    close_ns = RELEASE_NS + 60 * MS
    found = (
        LiveEvidence(accelerated, ledger)
        .known([one], np.array([RELEASE_NS]), close_ns, shadows=False)
        .cycles
    )
    assert found.work_ns is not None
    assert found.work_ns[0].tolist() == [CPU_NS, 10 * MS, CPU_NS, CPU_NS]


def test_of_a_shadow_what_it_did_not_share_is_told_apart(ledger: Ledger, problem: Problem) -> None:
    one = cycle(placement="LOC", shadow="SO")
    through = (*hops()[:3], hop("control", source="planning", ended=False))
    shadow = Completion(stamp(0), "control", RELEASE_NS + 25 * MS, "shadow", through, "R2")
    assert one.take(shadow, None)
    assert not one.take(shadow, None)
    rows = ledger.jobs(one)
    told = {row["task"]: row["shadow"] for row in rows}
    assert told == {"sensing": False, "perception": True, "planning": True}
    sent, bytes_ = ledger.shadow_bytes([one, cycle(1)])
    flows = {(flow.source, flow.target): flow.payload_bytes for flow in problem.pipeline.flows}
    assert sent == 1
    assert bytes_ == flows["sensing", "perception"] + flows["planning", "control"]


INSTANTS = ("arrived_ns", "started_ns", "ended_ns", "inputs", "done_ns")
PROBLEM = dwell.load("examples/canonical.yaml")


@given(
    place=st.integers(0, len(JOBS) - 1),
    first=st.sampled_from(INSTANTS),
    set_ms=st.integers(-4_000, 4_000),
)
# Between two jobs of one node.
@example(place=1, first="inputs", set_ms=-20)
def test_a_clock_that_is_set_within_a_cycle_leaves_no_interval_that_cannot_be(
    place: int, first: str, set_ms: int
) -> None:
    """From some instant of a job on, its node shows another time."""
    ledger = Ledger(PROBLEM, Offsets("E", PROBLEM.stamper_node, system_bound_ns=MS))
    by_ns, since = set_ms * MS, INSTANTS.index(first)
    told = list(hops())
    struck = told[place]
    told[place] = replace(struck, **{n: getattr(struck, n) + by_ns for n in INSTANTS[since:3]})
    for later in range(place + 1, len(told)):
        if told[later].node == struck.node:
            inputs = tuple((source, at_ns + by_ns) for source, at_ns in told[later].inputs)
            hop = replace(told[later], inputs=inputs)
            moved = {name: getattr(hop, name) + by_ns for name in INSTANTS[:3]}
            told[later] = replace(hop, **moved)
    one = cycle()
    one.stamped_ns = RELEASE_NS + MS
    done = completion(one)
    done_ns = done.done_ns + (by_ns if struck.node == "R2" else 0)
    one.take(replace(done, hops=tuple(told), done_ns=done_ns), RELEASE_NS + 27 * MS)
    ledger.settle(one)
    true_ns = round(25.5 * MS)
    known = one.bound_ns < UNBOUNDED_NS
    assert one.latency_ns == 26 * MS or (known and abs(one.latency_ns - true_ns) <= 28 * MS)
    assert one.latency_ns >= 0
    ledger.jobs(one)
    release_ns = np.array([RELEASE_NS])
    shown = (
        LiveEvidence(PROBLEM, ledger)
        .known([one], release_ns, RELEASE_NS + 60 * MS, shadows=False)
        .cycles
    )
    # The stamp of a source may have been there before the release.
    for instants in (shown.ready_ns[:, 1:], shown.end_ns, shown.arrived_ns):
        assert ((instants == UNKNOWN) | (instants >= RELEASE_NS - MS)).all()


@pytest.mark.parametrize(
    ("stamped_ms", "stamper_ms", "latency_ms"), [(1, 30, 26), (None, 30, 30), (None, None, None)]
)
def test_where_clocks_cannot_be_believed_one_alone_counts(
    ledger: Ledger, stamped_ms: int | None, stamper_ms: int | None, latency_ms: int | None
) -> None:
    one = cycle()
    one.stamped_ns = None if stamped_ms is None else RELEASE_NS + stamped_ms * MS
    one.stamper_interval_ns = None if stamper_ms is None else stamper_ms * MS
    done = completion(one)
    one.take(replace(done, done_ns=done.done_ns - 1_000 * MS), RELEASE_NS + 27 * MS)
    ledger.settle(one)
    assert one.bound_ns >= UNBOUNDED_NS
    assert one.latency_ns == (NEVER_NS if latency_ms is None else latency_ms * MS)


@pytest.mark.parametrize("outcome", ["actuated", "not_applied", "stale", "behind"])
def test_a_cycle_is_actuated_where_its_command_was(outcome: str) -> None:
    one = cycle()
    assert not one.actuated
    one.take(completion(one, outcome), None)
    assert one.actuated == (outcome == "actuated")


def test_jobs_of_the_warm_up_are_no_evidence(ledger: Ledger, problem: Problem) -> None:
    warming = cycle()
    jobs = tuple(replace(one, warmup=one.task == "perception") for one in hops())
    warming.take(replace(completion(warming), hops=jobs), None)
    close_ns = RELEASE_NS + 40 * MS
    found = (
        LiveEvidence(problem, ledger)
        .known([warming], np.array([RELEASE_NS]), close_ns, shadows=False)
        .cycles
    )
    assert found.start_ns is not None
    assert found.work_ns is not None
    column = list(problem.pipeline.tasks).index("perception")
    for instants in (found.ready_ns, found.start_ns, found.end_ns, found.work_ns):
        known = instants[0] != UNKNOWN
        assert known.tolist() == [place != column for place in range(len(known))]
    assert (found.arrived_ns[0] != UNKNOWN).all()
