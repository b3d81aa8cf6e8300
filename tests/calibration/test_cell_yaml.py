"""What is to be pasted into a cell: it loads, and replays the samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dwell
from dwell.calibration.cell_yaml import cell_yaml
from dwell.calibration.measure import Settings, measure_task
from dwell.calibration.profile_file import Measurement, write_profile
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.yaml_text import read_yaml
from dwell.estimators import Profile
from dwell.model import Problem, Trace
from dwell.model.order_statistic import percentile
from dwell.model.semantics import NAME
from tests.calibration.samples import link, task

HEAD = """\
dwell: 1
period_ms: 1000
nodes:
  R1: {tier: robot, cores: 4}
  E: {tier: edge, cores: 4}
candidates:
"""


def pasted(folder: Path, candidates: str, measured: list[Measurement], more: str = "") -> Problem:
    """Return a cell with what a profile's YAML says."""
    write_profile(folder / "p.parquet", measured)
    text = f"{HEAD}{candidates}{cell_yaml(Path('p.parquet'), measured)}{more}"
    (folder / "cell.yaml").write_text(text, encoding="utf-8")
    return dwell.load(folder / "cell.yaml")


def trace(problem: Problem, name: str, node: str) -> Trace:
    process = problem.pipeline.tasks[name].on[node].exec_ms
    assert isinstance(process, Trace)
    return process


def test_tasks_and_links_of_a_profile(tmp_path: Path) -> None:
    measured = [
        task("see", "R1", [1, 2, 3]),
        task("see", "E", [4, 5, 6], cores=2.6),
        task("plan", "R1", [7, 8, 9], cores=0.2),
        link("R1", "E", [0.1, 0.2, 0.3], 12345.678),
        link("E", "R1", [0.4, 0.5, 0.6], None),
    ]
    problem = pasted(tmp_path, "  LOC: {see: R1}\n  OFF: {see: E}\n", measured)
    assert trace(problem, "see", "R1").values.tolist() == [1, 2, 3]
    assert trace(problem, "see", "E").values.tolist() == [4, 5, 6]
    assert problem.pipeline.tasks["see"].on["E"].threads == 3
    assert problem.pipeline.tasks["plan"].on["R1"].threads == 1
    there, back = (problem.fabric.links[name] for name in ("R1->E", "E->R1"))
    assert isinstance(there.delay_ms, Trace)
    assert there.delay_ms.values.tolist() == [0.1, 0.2, 0.3]
    assert there.rate_mbps == 12350
    assert back.rate_mbps == float("inf")
    # One file: all of them share their rows, and go on from the beginning.
    tables = {id(trace(problem, "see", node).table) for node in ("R1", "E")}
    assert tables == {id(there.delay_ms.table)}
    assert there.delay_ms.table.wrap


@pytest.mark.parametrize("share", [0.02, 0.10])
def test_the_estimate_is_that_of_the_samples(tmp_path: Path, share: float) -> None:
    """Two values, the larger one above or below 5 %: a window that replays all rows has both."""
    rows = 500
    samples = [20.0 if row < share * rows else 10.0 for row in range(rows)]
    problem = pasted(tmp_path, "  LOC: {}\n", [task("see", "R1", samples)])
    expected = percentile(np.array(samples), 95)
    assert expected == (20 if share > 0.05 else 10)
    assert Profile(replace(problem, window_cycles=rows)).l95_ms["LOC"] == expected


def test_real_samples_end_up_in_the_estimate(tmp_path: Path) -> None:
    measured = measure_task("see", "R1", lambda: sum(range(500)), settings=Settings(400, 5))
    problem = pasted(tmp_path, "  LOC: {}\n", [measured])
    assert np.array_equal(trace(problem, "see", "R1").values, measured.samples)
    # Every window replays all of them.
    l95_ms = Profile(replace(problem, window_cycles=400)).l95_ms["LOC"]
    assert l95_ms == pytest.approx(percentile(measured.samples, 95), abs=1e-6)


def test_a_run_replays_them_in_order(tmp_path: Path) -> None:
    """One task on one node, faster than its period: a cycle takes what its row says."""
    samples = [float(value) for value in range(1, 8)]
    problem = pasted(tmp_path, "  LOC: {}\n", [task("see", "R1", samples)], "window_cycles: 10\n")
    run = dwell.simulate(problem, policy="LOC", seed=3, windows=2)
    latency = (run.cycles["latency_ns"] / 1e6).to_list()
    start = samples.index(latency[0])
    assert latency == [samples[(start + cycle) % 7] for cycle in range(20)]


@given(
    st.from_regex(NAME, fullmatch=True).filter(lambda name: len(name) <= 64),
    st.sampled_from(["p.parquet", "a b/p#1.parquet", "x: y.parquet", "{}.parquet", "é,.parquet"]),
)
def test_names_come_back_from_the_yaml(
    tmp_path_factory: pytest.TempPathFactory, name: str, file: str
) -> None:
    path, faults = tmp_path_factory.mktemp("yaml") / "part.yaml", Faults()
    text = cell_yaml(Path(file), [task(name, name, [1]), link(name, "other", [1], 1.5)])
    path.write_text(text, encoding="utf-8")
    document: Any = read_yaml(str(path), faults)
    assert document is not None
    execution = document["tasks"][name]["on"][name]["exec_ms"]["trace"]
    assert (execution["file"], execution["column"]) == (file, f"{name}@{name}")
    (found,) = document["links"]
    assert (found["from"], found["delay_ms"]["trace"]["column"]) == (name, f"{name}->other")
