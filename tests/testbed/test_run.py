"""One run: how long it is, what it says of its windows, what it sums up to."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.cellfile import from_document
from dwell.errors import LiveError
from dwell.model import Problem
from dwell.testbed.playing import Played
from dwell.testbed.run import MARK, length_s, run_once, spans_of
from tests.report.live_runs import PERIOD_NS, live_run
from tests.testbed.light_cell import document

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
    spans = spans_of(run, Played(problem, "baseline", 1))
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
    played = Played(problem, "some", 1)
    calm = spans_of(run, played)
    assert [span.stressed for span in calm] == [{}] * len(calm)
    played.begun_ns[0] = calm[0].begin_ns + 1
    found = spans_of(run, played)
    capacity = problem.fabric.nodes[node].capacity
    assert [span.stressed for span in found] == [{}, *[{node: capacity}] * (len(found) - 1)]


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
    assert (tmp_path / "before").exists()
