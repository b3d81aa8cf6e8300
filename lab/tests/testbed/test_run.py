"""One run: how long it is, what it says of its windows, what it sums up to."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import LiveError, PolicyError
from dwell.kernels.random_draws import Drawing
from dwell.live.local.playing import Played
from dwell.live.local.testbed import MARK
from dwell.live.local.timeline import Timeline, timeline_of
from dwell.model import Disturbance, Problem
from dwell.record import open_run
from dwell_lab.testbed.run import length_s, require_machine, run_once, spans_of
from lab.tests.testbed.machine import own_name
from tests.cells.light import document, write_cell
from tests.report.live_runs import PERIOD_NS, live_run

ORIGIN_NS = 10 * PERIOD_NS


@pytest.fixture
def problem() -> Problem:
    return from_document(document())


def test_the_last_window_has_time_to_close(problem: Problem) -> None:
    windows_s = 4 * 20 * 0.05
    assert length_s(problem, 4) > windows_s + 0.05
    assert length_s(problem, 8) - length_s(problem, 4) == pytest.approx(windows_s)


def test_windows_are_in_time_where_their_cycles_were() -> None:
    run = live_run(origin_ns=ORIGIN_NS)
    problem = from_document(run.meta["problem"])
    spans = spans_of(run, Played(problem, "baseline", 1, Timeline()))
    first = run.windows["first_cycle"].to_list()
    assert [span.number for span in spans] == run.windows["window"].to_list()
    release_ns = run.cycles["release_ns"].to_list()
    assert [span.begin_ns - ORIGIN_NS for span in spans] == [release_ns[row] for row in first]
    assert all(span.end_ns > span.begin_ns for span in spans)
    assert [span.warmup for span in spans] == run.windows["warmup"].to_list()


def test_a_node_is_stressed_in_windows_that_lie_in_its_stress_as_a_whole() -> None:
    run = live_run(origin_ns=ORIGIN_NS)
    written = {**run.meta["problem"]}
    nodes = list(written["nodes"])
    node = nodes[0]
    cores = written["nodes"][node].get("cores", 1)
    written["scenarios"] = {"some": [{"node": node, "stress_threads": cores}]}
    problem = from_document(written)
    timeline = timeline_of(problem, "some", seed=1, seconds=60)
    played = Played(problem, "some", 1, timeline)
    calm = spans_of(run, played)
    assert [span.stressed for span in calm] == [{}] * len(calm)
    played.changed(timeline.changes[0], calm[0].begin_ns + 1)
    found = spans_of(run, played)
    capacity = problem.fabric.nodes[node].capacity
    assert [span.stressed for span in found] == [{}, *[{node: capacity}] * (len(found) - 1)]


def test_a_run_meets_what_a_simulation_of_its_seed_meets(tmp_path: Path) -> None:
    wind = {"name": "wind", "every_s": {"exponential": {"mean": 2}}, "for_s": 1}
    items = [
        {"link": "R1->E", "add_delay_ms": 5, "at_s": 1, "episodes": wind},
        {"link": "R1->E", "add_delay_ms": 6, "at_s": 2, "for_s": 6},
        {"link": "R1->E", "add_delay_ms": 31, "at_s": 1, "for_s": 7, "ramp_s": 3},
        {"node": "R2", "stress_threads": 1, "at_s": 3, "for_s": 2},
    ]
    cell = dwell.load(write_cell(tmp_path / "cell", scenarios={"some": items}))
    try:
        require_machine(cell)
    except LiveError as error:
        pytest.skip(str(error))
    folder = run_once(
        cell,
        scenario="some",
        policy=None,
        seconds=12,
        seed=1,
        out=tmp_path / "out",
        name=own_name(),
    )
    run = open_run(folder)
    drawn = Drawing(cell, "some", seed=1, windows=13).episodes()
    # What comes last may come too late on a machine that has a lot else to do.
    expected = [item for item in drawn if item.at_s < 10]
    assert len(expected) > len(items)
    played = (run.played or ())[: len(expected)]
    assert [_timeless(item) for item in played] == [_timeless(item) for item in expected]
    for item, planned in zip(played, expected, strict=True):
        # A machine that has a lot else to do may be late.
        assert planned.at_s - 1.5 < item.at_s < planned.at_s + 10.0
    # One way had the delays, the other its own.
    links = run.meta["links"]
    assert links["R1->E"]["delay_ms"]["mean"] > 5.0
    assert links["E->R1"]["delay_ms"] == {"mean": 1.0, "std": 0.0}


def _timeless(item: Disturbance) -> Disturbance:
    return replace(item, at_s=0.0, for_s=math.inf, ramp_s=0.0)


def test_faults_come_before_the_folder_is_touched(problem: Problem, tmp_path: Path) -> None:
    (tmp_path / MARK).touch()
    (tmp_path / "before").touch()
    nodes = document()["nodes"]
    del nodes["E"]["quota"]
    greedy = from_document(document(nodes=nodes))
    with pytest.raises(LiveError, match=r"nodes\.E has no quota"):
        run_once(
            greedy, scenario="baseline", policy=None, seconds=5, seed=1, out=tmp_path, name="x"
        )
    settings = replace(problem.controller, policy="nowhere:Mine")
    unknown = replace(problem, controller=settings)
    with pytest.raises(PolicyError, match="no module 'nowhere'"):
        run_once(
            unknown, scenario="baseline", policy=None, seconds=5, seed=1, out=tmp_path, name="x"
        )
    assert (tmp_path / "before").exists()
