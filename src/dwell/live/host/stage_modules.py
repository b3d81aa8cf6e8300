"""Check of the modules of a cell's stages, before the first process starts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from dwell.errors import LiveError, missing_package
from dwell.model import Problem
from dwell.model.user_classes import import_user_module


def require_stages(problem: Problem, cell: Path, nodes: Collection[str]) -> None:
    """Raise a DwellError if a task of these nodes has no stage, or its modules cannot be imported.

    Otherwise the nodes would restart the failing workers forever, and the cell would never be
    ready.
    """
    tasks = [
        task for task in problem.pipeline.tasks.values() if not task.on.keys().isdisjoint(nodes)
    ]
    if without := [task.name for task in tasks if task.run is None]:
        raise LiveError(
            f"{cell}: nothing to run for {', '.join(without)}; a live cell needs `run: "
            "module:Name` for every task (docs/start/live-tutorial.md)"
        )
    actuators = problem.live.actuators
    names = {f"tasks.{task.name}.run": task.run for task in tasks}
    names |= {f"live.actuators.{task.name}": actuators.get(task.name) for task in tasks}
    for where, name in names.items():
        if name is None:
            continue
        module = name.partition(":")[0]
        try:
            import_user_module(module, problem.folder, f"{where} ({name})", LiveError)
        except LiveError as error:
            cause = error.__cause__
            missing = missing_package(cause) if isinstance(cause, ModuleNotFoundError) else None
            raise missing or error from cause
