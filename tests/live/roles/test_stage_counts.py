"""Times of stages and counts of flows: what the status of a cell says is what happened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dwell.live.host.state_files import kept_memory
from dwell.live.roles.stage_counts import (
    DROPPED,
    REPLACED,
    TAKEN,
    StageBook,
    StageTable,
    block_cycles,
    book_path,
    read_books,
)
from dwell.live.stage import Message
from dwell.live.wire.messages import Header, Load, OutputCounts, StageCounts, Stamp
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from tests.live.memory_transport import NetworkConditions
from tests.live.seeded_faults import ENDS, unbalanced
from tests.live.small_world import EXEC_MS, MS, Bench, Passing, World, canonical, on, queued

#: Time in which a block of a second and what was told of it are complete.
COUNTED_MS = 5_000
IMAGES = "sensing@R1->perception@E"


@pytest.fixture(scope="module")
def problem() -> Problem:
    return on(canonical(20, estimator="profile", fallbacks=()), "SO")


class Noting(Passing):
    """A stage that notes the cycles that it is called for."""

    def __init__(self, name: str, called: list[int]) -> None:
        super().__init__(name)
        self.called = called

    def process(self, inputs: Mapping[str, Message]) -> Message:
        self.called.append(next(iter(inputs.values())).cycle)
        return super().process(inputs)


def looks(world: World, seconds: float) -> Iterator[dict[str, Any]]:
    """Let time pass; yields the status ten times a second, whose flows add up."""
    for _ in range(round(10 * seconds)):
        world.run(100)
        status = world.status
        assert not unbalanced(status)
        yield status


def test_a_cell_that_is_well_shows_times_and_messages(problem: Problem) -> None:
    world = World(problem, policy="SO")
    assert (world.status["stages"], world.status["flows"]) == ({}, {})
    world.run(COUNTED_MS)
    found, size = world.status, block_cycles(problem)
    first, last = found["counted_cycles"]
    assert (first % size, last - first + 1) == (0, size)
    for task, node in problem.candidates["SO"].items():
        one = found["stages"][f"{task}@{node}"]
        assert one["exec_median_ms"] == one["exec_p95_ms"] == EXEC_MS[task]
        assert (one["jobs"], one["replaced"], one["dropped"]) == (size, 0, 0)
    whole = dict.fromkeys(ENDS, 0) | {"sent": size, "taken": size}
    names = {IMAGES, "perception@E->planning@E", "planning@E->control@R2"}
    assert found["flows"].keys() == names
    for one in found["flows"].values():
        assert {name: one[name] for name in whole} == whole
        # Each message is a byte.
        assert one["bytes_per_s"] == pytest.approx(1e3 / problem.pipeline.period_ms, rel=0.01)
    assert found["slow"] == []


def test_lost_messages_are_counted_exactly(problem: Problem) -> None:
    called: list[int] = []
    world = World(problem, policy="SO", stages={"perception": partial(Noting, called=called)})
    world.run(2_000)
    loss = NetworkConditions(loss=0.3)
    world.network.impair(loss, "R1", "E", key="**/in/**")
    lost = 0
    for status in looks(world, 20):
        if status["counted_cycles"] is None:
            continue
        first, last = status["counted_cycles"]
        images = status["flows"][IMAGES]
        assert (images["sent"], images["in_flight"]) == (last - first + 1, 0)
        assert images["taken"] == len([cycle for cycle in called if first <= cycle <= last])
        lost = max(lost, images["lost"])
    assert lost > 4


@pytest.mark.parametrize(
    "conditions",
    [
        NetworkConditions(duplication=0.5),
        NetworkConditions(reordering=0.3, reorder_ns=60 * MS),
        NetworkConditions(loss=0.2, duplication=0.3, reordering=0.2, delay_ns=30 * MS),
    ],
    ids=["twice", "overtaken", "all"],
)
def test_messages_that_come_twice_or_late_are_counted_once(
    problem: Problem, conditions: NetworkConditions
) -> None:
    world = World(problem, policy="SO")
    world.network.impair(conditions, key="**/in/**")
    world.run(COUNTED_MS)
    for status in looks(world, 5):
        first, last = status["counted_cycles"]
        assert all(one["sent"] <= last - first + 1 for one in status["flows"].values())


def test_a_killed_worker_loses_what_waited_for_it(problem: Problem) -> None:
    tasks = dict(problem.pipeline.tasks)
    tasks["perception"] = replace(tasks["perception"], depth=5)
    cell = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
    world = World(cell, policy="SO", exec_ms={**EXEC_MS, "perception": 90.0})
    for _ in looks(world, COUNTED_MS / 1e3):
        pass
    while queued(world.worker("perception@E"))[0] < 5:
        world.run(1)
    world.kill("perception@E")
    world.start("perception@E")
    lost = [status["flows"][IMAGES]["lost"] for status in looks(world, COUNTED_MS / 1e3)]
    # Five that waited; the one that it worked on was taken.
    assert max(lost) == 5
    assert lost[-1] == 0


@pytest.mark.parametrize("who", ["sensing@R1", "perception@E", "agent@E", "agent@R1"])
def test_messages_add_up_while_a_process_is_away(problem: Problem, who: str) -> None:
    world = World(problem, policy="SO")
    world.run(COUNTED_MS)
    world.kill(who)
    assert len(list(looks(world, 5))) == 50
    world.start(who)
    *_, status = looks(world, 2 * COUNTED_MS / 1e3)
    images = status["flows"][IMAGES]
    assert images["sent"] == images["taken"] == block_cycles(problem)


def test_what_is_sent_to_a_node_that_is_gone_is_lost(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, relay="R1"))
    world = World(cell, policy="SO")
    world.run(COUNTED_MS)
    for who in ("perception@E", "planning@E", "agent@E"):
        world.kill(who)
    *_, status = looks(world, COUNTED_MS / 1e3)
    assert status["flows"][IMAGES]["lost"] == status["flows"][IMAGES]["sent"] > 0


def test_a_standby_counts_with_its_worker() -> None:
    cell = canonical(20, estimator="profile", fallbacks=())
    tasks = dict(cell.pipeline.tasks)
    tasks["control"] = replace(
        tasks["control"], on={"R2": replace(tasks["control"].on["R2"], standby=1)}
    )
    cell = on(replace(cell, pipeline=replace(cell.pipeline, tasks=tasks)), "SO")
    world = World(cell, policy="SO")
    world.run(COUNTED_MS)
    world.kill("control@R2")
    *_, status = looks(world, COUNTED_MS / 1e3)
    size = block_cycles(cell)
    assert status["stages"]["control@R2"]["jobs"] == size
    flow = status["flows"]["planning@E->control@R2"]
    assert (flow["sent"], flow["taken"]) == (size, size)


# ------------------------------------------------------------------------------- the book


def header(cycle: int, *, run: int = 1, source: str = "sensing", node: str = "R1") -> Header:
    return Header(Stamp(run, cycle, 1, "SO", 0), source, node, "none")


def newest(book: StageBook) -> StageCounts:
    *_, counts = book.report("perception@E")
    return counts


def counted(book: StageBook) -> tuple[int, ...]:
    (here,) = (one for one in newest(book).inputs if one.source == "sensing@R1")
    return here.taken, here.replaced, here.dropped, here.waiting


def test_an_input_comes_to_one_end(problem: Problem) -> None:
    book = StageBook(problem, "perception", "E")
    for cycle, end in ((1, TAKEN), (2, REPLACED), (3, DROPPED)):
        book.arrived(header(cycle))
        book.ended([header(cycle)], end)
        # Copies, and what is told twice.
        book.arrived(header(cycle))
        book.ended([header(cycle)], DROPPED)
    book.arrived(header(4))
    book.arrived(header(4, source="nobody"))
    assert counted(book) == (1, 1, 1, 1)
    assert (newest(book).replaced, newest(book).dropped) == (1, 1)
    assert newest(book).totals == (1, 1, 1)


def test_another_run_begins_new_rows_and_goes_on_with_totals(problem: Problem) -> None:
    book = StageBook(problem, "perception", "E")
    for run, cycle in ((7, 500), (8, 3)):
        book.arrived(header(cycle, run=run))
        book.ended([header(cycle, run=run)], TAKEN)
    assert (newest(book).run, newest(book).block) == (8, 0)
    assert counted(book) == (1, 0, 0, 0)
    assert newest(book).totals == (2, 0, 0)


def test_a_false_number_spoils_no_later_count(problem: Problem) -> None:
    book = StageBook(problem, "perception", "E")
    book.arrived(header(1 << 60))
    for cycle in range(3 * block_cycles(problem)):
        book.arrived(header(cycle))
        book.ended([header(cycle)], TAKEN)
    assert counted(book) == (block_cycles(problem), 0, 0, 0)


def test_a_book_outlives_its_worker_and_no_other_file_is_read(
    problem: Problem, tmp_path: Path
) -> None:
    assert list(read_books(problem, roles(problem), tmp_path)) == []
    path = book_path(tmp_path, "perception@E")
    book = StageBook(problem, "perception", "E", partial(kept_memory, path))
    for cycle in (1, 2):
        book.arrived(header(cycle))
    book.ended([header(1)], TAKEN)
    again = StageBook(problem, "perception", "E", partial(kept_memory, path))
    assert counted(again) == (1, 0, 0, 1)
    again.begin()
    assert counted(again) == (1, 0, 0, 0)
    assert [one.who for one in read_books(problem, roles(problem), tmp_path)] == ["perception@E"]
    path.write_bytes(b"of another cell file")
    assert list(read_books(problem, roles(problem), tmp_path)) == []
    path.write_bytes(bytes(range(256)) * 1_000)
    assert list(read_books(problem, roles(problem), tmp_path)) == []


def test_where_a_disk_is_full_counts_stay_in_memory(problem: Problem, tmp_path: Path) -> None:
    nowhere = book_path(tmp_path / "missing", "perception@E")
    book = StageBook(problem, "perception", "E", partial(kept_memory, nowhere))
    book.arrived(header(1))
    assert counted(book) == (0, 0, 0, 1)


def reported(problem: Problem, table: StageTable, node: str, one: StageCounts) -> list[str]:
    """Have a node's agent report a worker's counts; returns the stages that are slow by them."""
    newest = 1, block_cycles(problem) // 2
    table.take(Load(node, 1, 0, 0, 0, 0, stages=(one,)), newest, 0)
    return [slow["stage"] for slow in table.slow(problem.candidates["SO"], newest)]


@pytest.mark.parametrize(
    ("node", "wrong"),
    [
        ("R1", {}),
        ("E", {"who": "nobody@E"}),
        ("E", {"who": "agent@E"}),
        ("E", {"run": 2}),
        ("E", {"block": 9}),
        ("E", {"outputs": ()}),
        ("E", {"outputs": (OutputCounts("<script>", 1, 1, 1),)}),
    ],
)
def test_an_agent_speaks_of_its_own_workers_and_of_now(
    problem: Problem, node: str, wrong: dict[str, Any]
) -> None:
    book = StageBook(problem, "perception", "E")
    for cycle in range(5):
        book.ran(Stamp(1, cycle, 1, "SO", 0), 90 * MS)
    assert reported(problem, StageTable(problem), "E", newest(book)) == ["perception@E"]
    false = msgspec.structs.replace(newest(book), **wrong)
    assert reported(problem, StageTable(problem), node, false) == []


# ----------------------------------------------------------------------------- warm-up


def test_jobs_of_the_warm_up_count_in_v_d_alone(problem: Problem) -> None:
    tasks = dict(problem.pipeline.tasks)
    tasks["perception"] = replace(tasks["perception"], warmup_jobs=10, depth=0)
    cell = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
    world = World(cell, policy="SO", jobs=True, exec_ms={**EXEC_MS, "perception": 40.0})
    bench = world.roles["perception@E"]
    assert isinstance(bench, Bench)
    while bench.worker.warms_up:
        world.run(1)
    bench.exec_ns = 5 * MS
    worked, violated = [], 0.0
    for _ in range(60):
        world.run(100)
        status = world.status
        if status["counted_cycles"] is not None and status["counted_cycles"][0] == 0:
            worked.append(status["stages"]["perception@E"])
        if status["recent"]["violation_rates"]:
            violated = max(violated, status["recent"]["violation_rates"][0])
    size = block_cycles(problem)
    assert worked[-1]["exec_p95_ms"] == 5.0
    assert worked[-1]["jobs"] == size - 10
    assert violated >= 0.5
