"""What a cell's stages need is looked at before anything is started."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.errors import DwellError, LiveError
from dwell.live.host.stage_modules import require_stages
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
