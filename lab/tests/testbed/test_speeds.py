"""A cell on CPUs that are as fast as a run's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.model import Problem, Trace
from dwell.model.document import to_document
from dwell.record import Run
from dwell_lab.testbed.speeds import Usual, at_speed_of, slowed, window_work_ms, work_ms
from tests.cells.small import make_problem

META = {
    "problem": to_document(replace(make_problem(), warmup_windows=1)),
    "testbed": {"nodes": {"R1": {"cpus": [0]}, "E": {"cpus": [1]}, "R2": {"cpus": [0]}}},
    "pressure": {
        "excluded": [2],
        "windows": [
            {"window": 0, "work_ms": {"0": 9.0, "1": 9.0}},
            {"window": 1, "work_ms": {"0": 0.1, "1": 0.2}},
            {"window": 2, "work_ms": {"0": 9.0, "1": 9.0}},
            {"window": 3, "work_ms": {"0": 0.2}},
            {"window": 4},
        ],
    },
}
RUN = Run(META, {})


@pytest.fixture
def replayed(tmp_path: Path) -> Problem:
    (tmp_path / "times.csv").write_text("robot,edge,link\n4.0,2.0,1.0\n6.0,3.0,1.5\n")
    document = to_document(make_problem())

    def trace(column: str) -> dict[str, dict[str, object]]:
        return {"trace": {"file": "times.csv", "column": column, "wrap": True}}

    document["tasks"]["perception"]["on"]["R1"]["exec_ms"] = trace("robot")
    document["tasks"]["perception"]["on"]["E"]["exec_ms"] = trace("edge")
    document["links"][0]["delay_ms"] = trace("link")
    quota = {"cpu": 0.9, "period_ms": 4}
    document["nodes"]["R1"] |= {"background": 0.2, "quota": quota}
    return from_document(document, folder=tmp_path)


def test_windows_that_do_not_count_say_nothing_of_the_speed() -> None:
    assert work_ms(RUN) == pytest.approx({"R1": 0.15, "E": 0.2, "R2": 0.15})
    assert work_ms(Run({"pressure": META["pressure"]}, {})) == {}
    assert work_ms(Run({}, {})) == {}
    assert window_work_ms(RUN)["R2"] == {1: 0.1, 3: 0.2}


def test_what_was_measured_takes_longer_and_keeps_its_rows(replayed: Problem) -> None:
    slow = at_speed_of(RUN, replayed, Usual({"R1": 0.1, "X": 1.0}))
    on = slow.pipeline.tasks["perception"].on
    robot, edge = on["R1"].exec_ms, on["E"].exec_ms
    link = next(iter(slow.fabric.links.values())).delay_ms
    assert isinstance(robot, Trace)
    assert isinstance(edge, Trace)
    assert isinstance(link, Trace)
    assert robot.values.tolist() == pytest.approx([6.0, 9.0])
    assert edge.values.tolist() == [2.0, 3.0]
    assert link.values.tolist() == [1.0, 1.5]
    # One table still: a cycle takes the same row of all of them.
    assert robot.table is edge.table is link.table
    assert slow.fabric.nodes["R1"].background == pytest.approx(0.3)
    assert slow.pipeline.tasks["sensing"] == replayed.pipeline.tasks["sensing"]


def test_a_stage_follows_the_speed_as_much_as_it_was_seen_to(replayed: Problem) -> None:
    usual = Usual({"R1": 0.1, "E": 0.1}, {("perception", "R1"): 2.0, ("perception", "E"): 0.0})
    on = at_speed_of(RUN, replayed, usual).pipeline.tasks["perception"].on
    robot, edge = on["R1"].exec_ms, on["E"].exec_ms
    assert isinstance(robot, Trace)
    assert isinstance(edge, Trace)
    assert robot.values.tolist() == pytest.approx([9.0, 13.5])
    assert edge.values.tolist() == [2.0, 3.0]
    assert usual.factor({"R1": 0.3}, "perception", "R1") == pytest.approx(9.0)
    assert usual.factor({"R1": 0.3}, "sensing", "R1") == pytest.approx(3.0)
    assert usual.factor({}, "sensing", "R1") == 1.0
    told = {
        "work_ms": {"R1": 0.1, "E": 0.1},
        "sensitivity": {"perception@R1": 2, "perception@E": 0},
    }
    assert Usual.of(told) == usual
    assert Usual.of({}) == Usual()


def test_a_slower_cell_is_slower(replayed: Problem) -> None:
    usual = dwell.simulate(replayed, seed=1, windows=2, policy="LOC")
    slow = dwell.simulate(slowed(replayed, {"R1": 2.0}), seed=1, windows=2, policy="LOC")
    more_ns = slow.cycles["latency_ns"] - usual.cycles["latency_ns"]
    assert more_ns.min() >= 4_000_000  # type: ignore[operator]
    assert slowed(replayed, {}) is replayed


def test_a_background_leaves_something_to_the_node(replayed: Problem) -> None:
    node = slowed(replayed, {"R1": 50.0}).fabric.nodes["R1"]
    assert node.background < node.capacity
    assert replace(node, background=0.0).capacity == node.capacity
