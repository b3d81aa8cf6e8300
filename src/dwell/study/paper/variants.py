"""The paper's cell with something changed: its candidates, its scenarios, the speed of a node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace

from dwell.errors import SimulationError
from dwell.model import (
    Episodes,
    Exponential,
    FrozenDict,
    Placement,
    Problem,
    Process,
    Scenario,
    Trace,
)

__all__ = [
    "on_and_off",
    "with_candidate",
    "with_candidates",
    "with_scenarios",
    "with_speed",
]

#: Parameters of processes that are milliseconds; the others have no unit.
MILLISECONDS = ("value", "low", "high", "mean", "std", "min")


def with_candidates(problem: Problem, names: Sequence[str]) -> Problem:
    """Return a problem with some of the candidates; it starts on the first where it has to.

    Parameters
    ----------
    problem : Problem
    names : sequence of str
        At least one, candidates of the problem.
    """
    kept = {name: problem.candidates[name] for name in names}
    controller = replace(
        problem.controller,
        initial=problem.initial if problem.initial in kept else names[0],
        fallbacks=tuple(name for name in problem.controller.fallbacks if name in kept),
    )
    return replace(problem, candidates=kept, controller=controller)


def with_candidate(problem: Problem, name: str, moves: Mapping[str, str]) -> Problem:
    """Return a problem with one more candidate, the last.

    Parameters
    ----------
    problem : Problem
    name : str
    moves : mapping of str to str
        Task to node, of what differs from the first candidate.
    """
    first = next(iter(problem.candidates.values()))
    placement = Placement({**first, **moves})
    return replace(problem, candidates={**problem.candidates, name: placement})


def with_scenarios(problem: Problem, scenarios: Mapping[str, Scenario]) -> Problem:
    """Return a problem with other scenarios than its own."""
    return replace(problem, scenarios=FrozenDict(scenarios))


def on_and_off(scenario: Scenario, *, off_s: float, on_s: float, name: str) -> Scenario:
    """Return a steady scenario that comes and goes instead.

    Parameters
    ----------
    scenario : tuple of disturbances
        All the time.
    off_s, on_s : float
        Mean lengths, seconds; exponential.
    name : str
        Of the episodes: disturbances with one name come and go together.
    """
    episodes = Episodes(name, every_s=Exponential(off_s), for_s=Exponential(on_s))
    return tuple(replace(item, episodes=episodes) for item in scenario)


def with_speed(problem: Problem, node: str, factor: float) -> Problem:
    """Return a problem in which every task takes less time on a node, by a factor.

    Parameters
    ----------
    problem : Problem
    node : str
    factor : float
        2 is twice as fast.
    """
    tasks = {
        name: replace(
            task,
            on={
                place: replace(execution, exec_ms=_scaled(execution.exec_ms, 1 / factor))
                if place == node
                else execution
                for place, execution in task.on.items()
            },
        )
        for name, task in problem.pipeline.tasks.items()
    }
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))


def _scaled(process: Process, factor: float) -> Process:
    """Return a process whose values are all multiplied by a factor.

    Raises
    ------
    SimulationError
        If they are recorded: a trace is what it is.
    """
    if isinstance(process, Trace) or not is_dataclass(process):
        raise SimulationError(f"{process} cannot be made faster or slower; it is recorded")
    names = {one.name for one in fields(process)}.intersection(MILLISECONDS)
    scaled: Process = replace(process, **{name: factor * getattr(process, name) for name in names})
    return scaled
