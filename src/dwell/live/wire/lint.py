"""Warnings about settings of a live cell that are valid but rarely intended."""

from __future__ import annotations

from collections.abc import Iterator

from dwell.errors import Fault
from dwell.live.wire.wiring import lagging_states
from dwell.model import Problem

#: Least `guard_cycles` for which beats, one per period, show that a link is up.
HEARD_CYCLES = 3


def lint(problem: Problem) -> Iterator[Fault]:
    """Yield settings that a live cell does not follow or refuses, or that reduce its performance.

    A cell without hosts and stages, which is only for the simulator, gets no warning.
    """
    if problem.live.hosts or any(task.run for task in problem.pipeline.tasks.values()):
        yield from _side_by_side(problem)
        yield from _early_closes(problem)
        yield from _short_guard(problem)
        yield from lagging_states(problem)


def _side_by_side(problem: Problem) -> Iterator[Fault]:
    """Yield tasks whose jobs overlap in the simulator, but not in the single worker of a node."""
    for task in problem.pipeline.tasks.values():
        for node, execution in task.on.items():
            if execution.workers > 1:
                yield Fault(
                    f"tasks.{task.name}.on.{node}.workers",
                    f"{execution.workers} is for the simulator: a live worker does one job at a "
                    "time; set 1, or start threads within the stage",
                )


def _early_closes(problem: Problem) -> Iterator[Fault]:
    """Yield a `close_grace_ms` that ends before the guard can act on a window's last cycles."""
    settings, patience_ms = problem.controller, problem.guard_patience_ns / 1e6
    lost = settings.guard_cycles + problem.pipeline.open_cycles
    if settings.fallbacks and settings.close_grace_ms < patience_ms:
        yield Fault(
            "controller.close_grace_ms",
            f"{settings.close_grace_ms:g} is less than the guard's patience of {patience_ms:g} ms: "
            "a window that closes before the guard acts may bring an order to a placement that the "
            "fault has broken, too, and the guard waits for that one again: up to "
            f"{2 * lost - 1} cycles are lost instead of {lost}",
        )


def _short_guard(problem: Problem) -> Iterator[Fault]:
    """Yield a `guard_cycles` for which links are hardly ever heard, so that no move uses them."""
    settings = problem.controller
    if settings.guard_cycles < HEARD_CYCLES and problem.fabric.links:
        yield Fault(
            "controller.guard_cycles",
            f"{settings.guard_cycles} is for the simulator: a live cell knows of a link once per "
            "period, too late for this guard, so orders and the guard's moves over links wait; "
            f"set at least {HEARD_CYCLES}",
        )
