"""Faults: which there are, and what a cell promises for each."""

from __future__ import annotations

from itertools import islice

import pytest

from dwell.cellfile import from_document
from dwell.model import Problem
from dwell_lab.chaos.faults import Fault, bound_of, faults_of, planned, struck
from dwell_lab.chaos.light_cell import document


@pytest.fixture(scope="module")
def problem() -> Problem:
    return from_document(document("SO"))


def of(problem: Problem, name: str) -> Fault:
    (found,) = [fault for fault in faults_of(problem) if fault.name == name]
    return found


def test_what_cannot_be_done_here_is_left_out(problem: Problem) -> None:
    left = faults_of(problem, disks=False)
    assert [fault.whom for fault in left if fault.how == "fill"] == [("runs",)]


def test_only_stages_that_know_of_it_are_told_to_fail(problem: Problem) -> None:
    assert any(fault.kind == "fail" for fault in faults_of(problem))
    assert not any(fault.kind == "fail" for fault in faults_of(problem, stages=False))


def test_images_do_not_fit_through_a_link_that_is_slow(problem: Problem) -> None:
    slow = [fault for fault in faults_of(problem) if fault.how == "slow"]
    assert {fault.whom for fault in slow} == {("R1->E",)}
    image = max(flow.payload_bytes for flow in problem.pipeline.flows)
    needed_mbps = image * 8 / problem.pipeline.period_ms / 1e3
    assert slow[0].amount == pytest.approx(needed_mbps / 4)


@pytest.mark.parametrize(
    ("name", "at_so", "at_loc"),
    [
        ("kill perception@E", 4, 4),
        ("kill agent@R1", 4, 4),
        ("kill sensing@R1", 4, 4),  # has a standby
        ("kill sensing@R1 and its standby", None, None),
        ("freeze stamper@R1", None, None),
        ("freeze sink.control@R2", None, None),
        ("kill all of E", 4, 4),
        ("kill all of R2", None, None),
        ("cut R1->E", 4, 4),
        ("cut R1-R2", 4, 4),
        ("lose relay agent@E", 4, 4),
        ("slow R1->E", 4, 4),
        ("fail perception@E", 4, 4),
        ("fail planning@R2", 4, 8),
        ("fail the actuator of sink.control@R2", 4, 4),
        ("jump +5000 ms E", 4, 4),
        ("jump -5000 ms E", 4, 4),
        ("jump +5000 ms R2", None, None),
        ("drift +80 ppm R1", 4, 4),
        ("drift +2000 ppm R1", None, None),
        ("starve E", 4, 4),
        ("starve R1", None, None),
        ("fill the disk of R1", 4, 4),
        ("fill the disk of the runs", 4, 4),
        ("write to the same disk", 4, 4),
    ],
)
def test_bounds(problem: Problem, name: str, at_so: int | None, at_loc: int | None) -> None:
    assert bound_of(problem, of(problem, name), "SO") == at_so
    assert bound_of(problem, of(problem, name), "LOC") == at_loc


def test_a_seed_makes_the_same_timeline_again(problem: Problem) -> None:
    faults = list(faults_of(problem))
    first = list(islice(planned(3, faults), 60))
    assert first == list(islice(planned(3, faults), 60))
    assert first != list(islice(planned(4, faults), 60))


def test_every_kind_has_its_turn_in_every_round(problem: Problem) -> None:
    faults = list(faults_of(problem))
    kinds = {fault.kind for fault in faults}
    first = list(islice(planned(1, faults), len(kinds)))
    assert {one.fault.kind for one in first} == kinds
    assert kinds == {
        *("kill", "kill node", "freeze", "freeze node", "cut", "cut one way", "relay"),
        *("slow", "fail", "refuse"),
        *("jump", "jump back", "drift", "starve", "fill", "hog"),
    }


def test_every_fault_has_its_turn(problem: Problem) -> None:
    faults = list(faults_of(problem))
    kinds = {fault.kind for fault in faults}
    rounds = max(sum(f.kind == kind for f in faults) for kind in kinds)
    everything = {one.fault.name for one in islice(planned(1, faults), rounds * len(kinds))}
    assert everything == {fault.name for fault in faults}


def test_a_node_is_struck_with_all_its_processes_its_agent_first(problem: Problem) -> None:
    first, *others = struck(problem, of(problem, "kill all of E"))
    assert first == "agent@E"
    assert {"perception@E", "planning@E", "controller@E"} <= set(others)
    assert struck(problem, of(problem, "kill planning@E")) == ["planning@E"]
