"""Node loads: backgrounds and wakes, from runs of a cell whose loads are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.model import Quota
from dwell_lab.testbed.measured import look_at
from dwell_lab.testbed.node_loads import TOGETHER, wakes
from lab.tests.testbed.calibrated import Calibrated
from tests.cells.known_cost import (
    ADDED_MS,
    BACKGROUND,
    BESIDE,
    HZ,
    INTERFERENCE,
)


def test_backgrounds_and_links_are_found(calibrated: Calibrated) -> None:
    for node, cores in BACKGROUND.items():
        assert calibrated.report["background"][node] == pytest.approx(cores, abs=0.006)
        found = calibrated.problem.fabric.nodes[node]
        assert found.interference == pytest.approx(INTERFERENCE if node == "E" else 1.0, rel=0.05)
        assert found.background_beside == pytest.approx(BESIDE[node], abs=0.001)
    assert calibrated.problem.fabric.nodes["R1"].quota == Quota(0.4, 4)
    for link in ("R1->E", "E->R1"):
        assert calibrated.report["links"][link]["added_ms"] == pytest.approx(ADDED_MS, abs=0.25)


def test_how_often_something_wakes_is_of_nodes_whose_quota_has_ticks(
    calibrated: Calibrated, nominal: Path, folders: list[Path]
) -> None:
    assert calibrated.report["background_hz"] == {}
    problem = dwell.load(nominal)
    measured = [look_at(folder.name, dwell.open_run(folder), problem) for folder in folders]
    nodes = dict(problem.fabric.nodes)
    nodes["E"] = replace(nodes["E"], quota=Quota(0.8, 4.0, tick_ms=4.0))
    ticking = replace(problem, fabric=replace(problem.fabric, nodes=nodes))
    assert wakes(measured, ticking) == {"E": pytest.approx(HZ["E"] / TOGETHER)}
    # Runs of before it was recorded say nothing, and leave it out.
    for one in measured:
        del one.run.meta["wakes_hz"]
    assert wakes(measured, ticking) == {}
