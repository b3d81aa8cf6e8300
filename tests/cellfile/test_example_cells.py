"""The settings that the example cells write out, and those that they leave to the defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

import dwell
from dwell.control import Controller
from dwell.policies import DTP

ROOT = Path(__file__).parents[2]
#: The settings of the controller in the paper; the other one is W.
PAPERS = {"min_dwell": 3, "estimator": "profile", "shadow_fraction": 0.05}


def document(path: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))
    return found


def test_the_first_cell_is_the_canonical_one_with_the_defaults() -> None:
    first, canonical = document("examples/first.yaml"), document("examples/canonical.yaml")
    for key in (*PAPERS, "decide_cycles"):
        assert key not in first["controller"]
        del canonical["controller"][key]
    assert first == canonical


@pytest.mark.parametrize("name", ["canonical", "fan-in", "cloud", "real", "real-5g"])
def test_cells_of_the_paper_write_its_settings_out(name: str) -> None:
    cell = document(f"examples/{name}.yaml")
    controller = cell["controller"]
    assert controller["policy"] == "dtp"
    assert controller["decide_cycles"] == cell["window_cycles"]
    assert {key: controller[key] for key in PAPERS} == PAPERS


@pytest.mark.parametrize(
    "path",
    [
        "examples/live/cell.yaml",
        "examples/visual_servoing/cell.yaml",
        "examples/visual_servoing/testbed.yaml",
        "examples/visual_servoing/unseen-placement.yaml",
        "benchmarks/peer-chain.yaml",
    ],
)
def test_other_cells_take_the_defaults(path: str) -> None:
    assert not {*PAPERS, "decide_cycles"} & document(path).get("controller", {}).keys()


def test_a_cell_that_says_nothing_decides_four_times_per_window() -> None:
    problem = dwell.load(ROOT / "benchmarks" / "peer-chain.yaml")
    assert "controller" not in document("benchmarks/peer-chain.yaml")
    assert problem.decide_cycles == problem.window_cycles // 4
    controller = Controller(problem)
    assert isinstance(controller.policy, DTP)
    assert type(controller.estimator).__name__ == "Corrected"
    assert controller.policy.min_dwell == controller.problem.controller.min_dwell == 0
