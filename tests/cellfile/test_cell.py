"""Cells that are valid, and what they become."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from dwell.cellfile import from_document, from_record, load
from dwell.errors import ProblemError
from dwell.model import (
    AR1,
    Bursts,
    Caps,
    Constant,
    ControllerSettings,
    Episodes,
    Exponential,
    Flow,
    LinkDisturbance,
    LogNormal,
    MovingTarget,
    NodeDisturbance,
    Normal,
    Placement,
    Quota,
    Servo,
    Targets,
    Uniform,
    Weights,
)
from dwell.model.document import to_document

EXAMPLE = Path(__file__).parent / "cell.yaml"
ROOT = Path(__file__).parents[2]

# One task on one node: the least a cell can be.
LEAST: dict[str, Any] = {
    "dwell": 1,
    "period_ms": 10,
    "nodes": {"n": {"tier": "robot"}},
    "tasks": {"t": {"on": {"n": {"exec_ms": 1}}}},
    "candidates": {"LOC": {}},
}


def test_the_example_becomes_a_problem() -> None:
    problem = load(EXAMPLE)
    assert problem.name == "visual-servoing-cell"
    assert problem.window_cycles == 50
    assert (problem.pipeline.period_ms, problem.pipeline.deadline_ms) == (40, 40)
    assert list(problem.pipeline.tasks) == ["sensing", "perception", "planning", "actuation"]
    perception = problem.pipeline.tasks["perception"]
    assert perception.depth == 1
    assert perception.scale == "scene"
    assert perception.on["R1"].exec_ms == Constant(18)
    assert perception.on["R1"].threads == 4
    assert problem.pipeline.flows[0] == Flow("sensing", "perception", 60_000)
    assert problem.pipeline.scales == {"scene": AR1(1, 0.15, 0.9)}
    assert problem.candidates["LOC"] == Placement(
        {"sensing": "R1", "perception": "R1", "planning": "R2", "actuation": "R2"}
    )
    assert problem.objective.weights == Weights(1, 3, 0.5, 0.3, 0.5)
    assert problem.objective.targets == Targets(40, 0.7, 0.7)
    assert problem.objective.caps == Caps(120, 0.98)
    assert problem.objective.tiers == {"R1": "robot", "E": "edge", "R2": "robot"}
    assert problem.controller == ControllerSettings(
        on="E", initial="LOC", min_dwell=3, estimator="profile", fallbacks=("LOC", "HYB")
    )
    assert problem.servo == Servo("double-integrator", 30, MovingTarget(50, 2), damping=8)


def test_both_ways_makes_two_links_and_two_disturbances_of_one_process() -> None:
    problem = load(EXAMPLE)
    links = problem.fabric.links
    assert set(links) == {"R1->E", "E->R1", "R2->E", "E->R2", "R1->R2", "R2->R1"}
    assert links["R1->E"].delay_ms == links["E->R1"].delay_ms == LogNormal(0.8, 0.3)
    assert links["E->R1"].rate_mbps == 1000
    there, back = problem.scenarios["network-impairment"]
    assert there == LinkDisturbance("R1", "E", add_delay_ms=Normal(25, 5, 0), loss=0.02)
    assert isinstance(back, LinkDisturbance)
    assert back.link == "E->R1"
    assert (back.at_s, back.for_s, back.loss) == (0, math.inf, 0.02)
    assert problem.scenarios["edge-crash"] == (NodeDisturbance("E", 20, 10, down=True),)
    assert problem.scenarios["baseline"] == ()


def test_episodes_are_shared_and_ramps_are_read() -> None:
    problem = load(EXAMPLE)
    radio = Episodes("radio", Exponential(20), Constant(5))
    assert problem.scenarios["radio"] == (
        LinkDisturbance("R1", "E", rate_mbps=20, episodes=radio),
        LinkDisturbance("E", "R1", rate_mbps=20, episodes=radio),
        NodeDisturbance("R1", stress_threads=1, episodes=radio),
    )
    assert problem.scenarios["rush-hour"] == (
        NodeDisturbance("E", 20, 60, stress_threads=12, ramp_s=20),
    )


def test_the_scenarios_of_the_manual_can_be_read() -> None:
    text = (ROOT / "docs" / "reference" / "cells.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(scenarios:\n.*?)```", text, re.DOTALL)
    scenarios = yaml.safe_load(block)["scenarios"]
    cell = to_document(load(EXAMPLE))
    problem = from_document({**cell, "scenarios": scenarios})
    slow, _, lossy, _ = problem.scenarios["radio"]
    assert slow.episodes == lossy.episodes
    assert problem.scenarios["rush-hour"][0].ramp_s == 300


def test_loading_twice_gives_equal_problems() -> None:
    assert load(EXAMPLE) == load(str(EXAMPLE))


def test_the_least_cell_has_the_defaults_of_the_model() -> None:
    problem = from_document(LEAST)
    assert problem.name == "cell"
    assert problem.pipeline.deadline_ms == 10
    assert problem.pipeline.flows == ()
    assert problem.fabric.links == {}
    assert problem.candidates == {"LOC": Placement({"t": "n"})}
    assert problem.objective.weights == Weights()
    assert problem.objective.targets == Targets(10)
    assert problem.objective.caps == Caps()
    assert problem.controller == ControllerSettings()
    assert problem.scenarios == {"baseline": ()}
    assert problem.servo is None


def test_a_cell_without_a_name_has_that_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    text = "dwell: 1\nperiod_ms: 1e1\nnodes: {n: {tier: robot}}\n"
    path.write_text(text + "tasks: {t: {on: {n: {exec_ms: 1}}}}\ncandidates: {LOC: {}}\n")
    assert load(path).name == "arm"
    assert load(path).pipeline.period_ms == 10


@pytest.mark.parametrize("name", ["../../evil", "a?b", "a/b", "a  b", " a", "", "@a", "a" * 65])
def test_the_name_of_a_cell_is_a_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(yaml.safe_dump({**LEAST, "name": name}))
    with pytest.raises(ProblemError) as caught:
        load(path)
    (fault,) = caught.value.faults
    assert fault.path == "name"
    assert fault.line is not None
    # A record has the name of its problem, which may have been made in Python.
    assert from_record({**LEAST, "name": name}).name == name


def test_the_name_of_a_file_has_to_be_one_where_the_cell_has_none(tmp_path: Path) -> None:
    path = tmp_path / "a?b.yaml"
    path.write_text(yaml.safe_dump(LEAST))
    with pytest.raises(ProblemError, match="name: 'a\\?b' is not a name"):
        load(path)


@pytest.mark.parametrize(
    "more",
    [
        {"links": [], "flows": []},
        {"scenarios": {"baseline": [], "calm": [{"node": "n", "stress_threads": 0}]}},
        {"controller": {"min_dwell": 0, "min_improvement": 0, "policy": "LOC"}},
        {"name": "5", "warmup_windows": 3, "release_jitter_ms": {"uniform": {"low": 0, "high": 2}}},
        {"deadline_ms": 10.0, "window_cycles": 1, "scales": {"unused": 2}},
    ],
)
def test_degenerate_cells_are_valid(more: dict[str, Any]) -> None:
    assert from_document({**LEAST, **more})


def test_a_candidate_of_a_file_places_no_anchored_task(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    placed = {**LEAST, "candidates": {"LOC": {"t": "n"}}}
    path.write_text(yaml.safe_dump(placed))
    with pytest.raises(ProblemError, match=r"candidates\.LOC\.t.*anchored to n, .*leave it out"):
        load(path)


def test_every_key_reaches_the_model() -> None:
    process = {"exponential": {"mean": 5}}
    problem = from_document(
        {
            **LEAST,
            "nodes": {
                "n": {
                    "tier": "robot",
                    "cores": 2,
                    "scheduler": "priority",
                    "accelerators": {"gpu": 2},
                    "quota": {"cpu": 0.4, "period_ms": 4},
                    "bursts": {"every_ms": process, "for_ms": 3, "threads": 2},
                },
                "m": {"tier": "cloud"},
            },
            "links": [
                {
                    "from": "n",
                    "to": "m",
                    "delay_ms": {"uniform": {"low": 1, "high": 2}},
                    "loss": 0.1,
                    "on_loss": {"retransmit_ms": 20},
                    "in_order": True,
                    "bursts": {"every_ms": 9, "for_ms": process, "add_delay_ms": 4},
                }
            ],
            "tasks": {
                "t": {
                    "on": {
                        "n": {"exec_ms": 1, "accelerator": "gpu"},
                        "m": {"exec_ms": {"constant": 2}, "workers": 5},
                    },
                    "workers": 3,
                    "input": {"queue": 8},
                    "priority": -2,
                    "offset_ms": 1,
                    "start_ms": 2,
                    "state_bytes": 6e4,
                }
            },
            "candidates": {"LOC": {"t": "n"}},
            "objective": {
                "weights": {"cloud": 0.1},
                "targets": {"cloud": 0.5},
                "tiers": {"n": "edge"},
                "accelerators": True,
            },
            "controller": {
                "policy": "cusum",
                "escape": True,
                "estimator": "corrected",
                "shadow_fraction": 0.2,
                "half_life_windows": 3.5,
                "migration": "cold",
            },
        }
    )
    node, task = problem.fabric.nodes["n"], problem.pipeline.tasks["t"]
    assert (node.cores, node.scheduler, node.accelerators) == (2, "priority", {"gpu": 2})
    assert node.quota == Quota(0.4, 4)
    assert node.bursts == Bursts(Exponential(5), Constant(3), threads=2)
    link = problem.fabric.links["n->m"]
    assert link.delay_ms == Uniform(1, 2)
    assert (link.loss, link.retransmit_ms, link.in_order) == (0.1, 20, True)
    assert link.rate_mbps == math.inf
    assert link.bursts == Bursts(Constant(9), Exponential(5), add_delay_ms=Constant(4))
    assert (task.on["n"].workers, task.on["m"].workers) == (3, 5)
    assert task.on["n"].accelerator == "gpu"
    assert (task.depth, task.priority, task.offset_ms, task.start_ms) == (8, -2, 1, 2)
    assert task.state_bytes == 60_000
    assert isinstance(task.state_bytes, int)
    assert problem.objective.weights.cloud == 0.1
    assert problem.objective.tiers == {"n": "edge"}
    assert problem.objective.accelerators == {"n.gpu": "edge"}
    assert problem.controller == ControllerSettings(
        policy="cusum",
        escape=True,
        estimator="corrected",
        shadow_fraction=0.2,
        half_life_windows=3.5,
        migration="cold",
    )


def test_importing_the_readers_imports_nothing_heavy() -> None:
    heavy = "{'polars', 'yaml'}"
    code = f"import sys, dwell.cellfile; print(*sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []
