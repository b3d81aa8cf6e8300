"""What a cell's stages need is looked at before anything is started."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.errors import DwellError, LiveError
from dwell.live.host.stage_modules import actuator_of, require_stages, stage_of
from dwell.live.stage import CellActuator, CellStage
from dwell.model import FrozenDict, Problem

CELL = Path(__file__).parents[3] / "examples" / "live" / "cell.yaml"
PROBLEM = dwell.load(CELL)
NODES = tuple(PROBLEM.fabric.nodes)


def running(task: str, run: str | None) -> Problem:
    tasks = PROBLEM.pipeline.tasks
    changed = FrozenDict({**tasks, task: replace(tasks[task], run=run)})
    return replace(PROBLEM, pipeline=replace(PROBLEM.pipeline, tasks=changed))


def test_the_stages_of_the_example_are_there() -> None:
    require_stages(PROBLEM, CELL, NODES)


def test_a_task_without_a_stage_is_named() -> None:
    with pytest.raises(LiveError, match="nothing to run for camera"):
        require_stages(running("camera", None), CELL, NODES)


def test_a_module_that_is_not_there_is_named_with_its_task() -> None:
    with pytest.raises(DwellError, match=r"tasks\.camera\.run \(nowhere:Camera\).*no module"):
        require_stages(running("camera", "nowhere:Camera"), CELL, ["R1"])
    # What runs elsewhere need not be here.
    require_stages(running("camera", "nowhere:Camera"), CELL, ["E", "R2"])


def test_topics_without_the_extra_name_the_line_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cell = CELL.with_name("ros2.yaml")
    problem = dwell.load(cell)
    require_stages(problem, cell, NODES)
    monkeypatch.setattr("dwell.errors.find_spec", lambda name: None)
    with pytest.raises(LiveError, match=r"rosbags and xxhash are not installed; .*\[ros2\]'"):
        require_stages(problem, cell, ["R1"])
    # A node without a topic needs no extra.
    require_stages(problem, cell, ["E"])


def test_faults_of_topics_are_named_with_their_place() -> None:
    problem = dwell.load(CELL.with_name("ros2.yaml"))
    camera = problem.pipeline.tasks["camera"]
    assert camera.ros2 is not None
    unknown = replace(camera, ros2=replace(camera.ros2, type="own/msg/Picture"))
    tasks = FrozenDict({**problem.pipeline.tasks, "camera": unknown})
    changed = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
    with pytest.raises(LiveError, match=r"tasks\.camera\.run: unknown type own/msg/Picture"):
        stage_of(changed, "camera")
    assert isinstance(stage_of(problem, "camera"), CellStage)
    assert isinstance(actuator_of(problem, "control"), CellActuator)
