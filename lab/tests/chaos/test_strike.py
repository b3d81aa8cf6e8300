"""What a fault has cost, beside what was promised."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import polars as pl
import pytest

import dwell
from dwell.cellfile import from_document
from dwell_lab.chaos.faults import Fault, faults_of
from dwell_lab.chaos.invariants import Judge, Term
from dwell_lab.chaos.light_cell import document
from dwell_lab.chaos.stages import APPLY, HOLD
from dwell_lab.chaos.strike import Outcome, beyond, moved_in_vain
from tests.live.real_cell import RealCell
from tests.waiting import PATIENCE_S, wait_until


@pytest.mark.parametrize(
    ("lost", "lost_after", "bound", "said"),
    [
        (4, 0, 4, []),
        (5, 0, 4, ["5 consecutive cycles lost by it, not 4"]),
        (
            9,
            6,
            4,
            ["9 consecutive cycles lost by it, not 4", "6 consecutive cycles lost after it, not 4"],
        ),
        (-1, 5, 4, ["5 consecutive cycles lost after it, not 4"]),
        (90, 90, None, []),
    ],
)
def test_more_cycles_than_the_bound_are_said(
    lost: int, lost_after: int, bound: int | None, said: list[str]
) -> None:
    outcome = Outcome("kill all of E", 1, 0.5, lost=lost, lost_after=lost_after, bound=bound)
    assert beyond(outcome) == said


@pytest.mark.parametrize(
    ("name", "ordered", "found"),
    [
        ("fail the actuator of sink.control@R2", False, 1),
        ("fail the actuator of sink.control@R2", True, 0),
        ("kill planning@R2", False, 0),
    ],
)
def test_the_guard_has_no_reason_to_move_for_an_actuator_that_raises(
    name: str, ordered: bool, found: int
) -> None:
    problem = from_document(document("LOC"))
    refuses = next(one for one in faults_of(problem) if one.name == name)
    terms = {1: Term(1, "LOC", 0, 0), 2: Term(2, "SO", 9, 9)}
    judge = Judge(problem, terms=terms, held={2: ordered})
    assert len(moved_in_vain(judge, refuses, 1)) == found
    assert moved_in_vain(judge, refuses, 2) == []


# ------------------------------------------------------------------------- real processes


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCell]:
    """A cell that keeps to its period on two CPUs."""
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("twenty processes that must keep to a period of 40 ms need two CPUs")
    with RealCell("LOC", tmp_path_factory.mktemp("cell")) as made:
        yield made


def fault(cell: RealCell, name: str) -> Fault:
    return next(one for one in faults_of(cell.problem) if one.name == name)


def test_an_actuator_that_raises_is_told_and_moves_nothing(cell: RealCell) -> None:
    refuses = fault(cell, "fail the actuator of sink.control@R2")
    moves = cell.status()["guard_moves"]
    begin_ns = cell.begin(refuses, time.monotonic_ns())
    wait_until(lambda: "told to fail" in str(cell.status().get("headline")))
    status = cell.status()
    assert status["health"] == "degraded"
    assert "apply() raised RuntimeError: told to fail" in status["headline"]

    def calls() -> list[int]:
        return [seen.what for seen in cell.actuations.since(begin_ns)]

    wait_until(lambda: calls().count(APPLY) > 3)
    wait_until(lambda: HOLD in calls())
    cell.end(refuses)
    cell.wait_for("the whole cell at home", cell.at_home, 30.0)
    wait_until(lambda: cell.status().get("health") == "ok")
    assert cell.status()["guard_moves"] == moves
    assert cell.ended(refuses) == []


def test_a_clock_that_goes_back_ends_nobody(cell: RealCell) -> None:
    back = fault(cell, "jump -5000 ms R2")
    cell.begin(back, time.monotonic_ns())
    windows = cell.status()["windows"]
    wait_until(lambda: cell.status().get("windows", 0) > windows + 10)
    cell.wait_for("the whole cell at home", cell.at_home, 30.0)
    wait_until(lambda: cell.status().get("unproven") is False)
    assert cell.ended(back) == []


def test_a_process_that_ends_by_itself_is_told(cell: RealCell) -> None:
    drifts = fault(cell, "drift +80 ppm E")
    cell.begin(drifts, time.monotonic_ns())
    assert cell.ended(drifts) == []
    os.kill(cell.pid("planning@E"), signal.SIGKILL)
    wait_until(lambda: cell.ended(drifts) == ["planning@E has ended by itself"])
    assert cell.ended(fault(cell, "kill planning@E")) == []
    cell.end(drifts)
    cell.wait_for("the whole cell at home", cell.at_home, 30.0)


def test_the_end_of_a_terminal_completes_the_run(cell: RealCell) -> None:
    """Goes on from the tests before."""
    controller = cell.testbed.processes.running["controller@E"]
    controller.send_signal(signal.SIGHUP)
    assert controller.wait(PATIENCE_S) == 0
    (folder,) = cell.runs
    assert (folder / "run.json").is_file()
    cycles = dwell.open_run(folder).cycles
    refused = cycles.filter(pl.col("outcome") == "not_applied")
    assert len(refused) > 3
    assert refused["missed"].all()
    assert not refused["actuated"].any()
