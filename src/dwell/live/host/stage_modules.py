"""Stages and actuators of a cell: their modules are checked, and their objects made."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path

from dwell.errors import LiveError, lacking, missing_package
from dwell.live.stage import (
    CellActuator,
    CellCode,
    CellStage,
    StagePlace,
    load_actuator,
    load_stage,
)
from dwell.model import Problem
from dwell.model.ros_topics import RosActuator, RosTopic
from dwell.model.user_classes import import_user_module


def require_stages(problem: Problem, cell: Path, nodes: Collection[str]) -> None:
    """Raise a DwellError if a task of these nodes has no stage, or its modules cannot be imported.

    Otherwise the nodes would restart the failing workers forever, and the cell would never be
    ready.
    """
    tasks = [
        task for task in problem.pipeline.tasks.values() if not task.on.keys().isdisjoint(nodes)
    ]
    if without := [task.name for task in tasks if task.run is None and task.ros2 is None]:
        raise LiveError(
            f"{cell}: nothing to run for {', '.join(without)}; a live cell needs `run: "
            "module:Name` for every task (docs/start/live-tutorial.md)"
        )
    actuators = problem.live.actuators
    names: dict[str, str | RosActuator | None]
    names = {f"tasks.{task.name}.run": task.run for task in tasks}
    names |= {f"live.actuators.{task.name}": actuators.get(task.name) for task in tasks}
    if ros_topics(problem, nodes) and (packages := lacking("ros2")):
        raise LiveError(packages)
    for where, name in names.items():
        if not isinstance(name, str):
            continue
        module = name.partition(":")[0]
        try:
            import_user_module(module, problem.folder, f"{where} ({name})", LiveError)
        except LiveError as error:
            cause = error.__cause__
            missing = missing_package(cause) if isinstance(cause, ModuleNotFoundError) else None
            raise missing or error from cause


def ros_topics(problem: Problem, nodes: Collection[str]) -> dict[str, RosTopic]:
    """Return the ROS topics at the ends of the cell on some nodes, by path in the cell file."""
    found: dict[str, RosTopic] = {}
    for name, task in problem.pipeline.tasks.items():
        if task.on.keys().isdisjoint(nodes):
            continue
        actuator = problem.live.actuators.get(name)
        if task.ros2 is not None:
            found[f"tasks.{name}.ros2"] = task.ros2
        if isinstance(actuator, RosActuator):
            found[f"live.actuators.{name}.ros2"] = actuator.ros2
    return found


def stage_of(problem: Problem, name: str, index: int = 0) -> CellStage:
    """Make the stage of a task, for its process or standby `index`."""
    task = problem.pipeline.tasks[name]
    where = f"tasks.{name}.run"
    if task.ros2 is not None:
        from dwell.live.ros2 import Source

        stage: CellStage = Source(**asdict(task.ros2))
    elif task.run is not None:
        stage = load_stage(task.run, where)
    else:
        raise LiveError(f"{where}: missing; name its stage, as module:Name")
    _prepare(stage, where, problem, name, index)
    return stage


def actuator_of(problem: Problem, name: str) -> CellActuator:
    """Make the actuator of a sink task."""
    where, given = f"live.actuators.{name}", problem.live.actuators.get(name)
    if given is None:
        raise LiveError(f"{where}: missing; name what applies its commands, as module:Name")
    if isinstance(given, RosActuator):
        from dwell.live.ros2 import Sink

        actuator: CellActuator = Sink(**asdict(given.ros2))
    else:
        actuator = load_actuator(given, where)
    _prepare(actuator, where, problem, name)
    return actuator


def _prepare(made: CellCode, where: str, problem: Problem, name: str, index: int = 0) -> None:
    """Tell a stage or an actuator its place, and check it; raise a LiveError that names it."""
    longest = max((flow.payload_bytes for flow in problem.pipeline.outputs(name)), default=0)
    limits = problem.folder, problem.max_age_ms(name), longest, problem.live.clock == "system"
    made.placed(StagePlace(problem.name, name, index, *limits))
    try:
        made.check()
    except LiveError as error:
        raise LiveError(f"{where}: {error}") from error
    except Exception as error:  # the user's code
        raise LiveError(f"{where}: check() raised {type(error).__name__}: {error}") from error
