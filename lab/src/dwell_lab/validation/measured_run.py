"""A measured run, read for validation, and its simulations.

A run may be compared with a cell if it is a run of that cell. Values that calibration changes
(execution times, delays, rates, payloads) may differ; tasks, nodes, links and flows may not.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from dwell.errors import DwellError, RunError
from dwell.estimators.registry import name_in_run, resolved
from dwell.model import Problem
from dwell.model.document import disturbance_document, relocated, to_document
from dwell.model.scenario import Disturbance, Scenario
from dwell.policies.registry import by_name, name_of_class
from dwell_lab.testbed.speeds import Usual, at_speed_of
from dwell_lab.validation.job_times import finished_jobs
from dwell_lab.validation.qos_sample import Piece, piece_of

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

Document: TypeAlias = Mapping[str, Any]

#: Keys of nodes and tasks that calibration keeps.
MADE_OF = {
    "nodes": ("tier", "cores", "scheduler", "accelerators", "quota"),
    "tasks": ("input",),
}


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRun:
    """A measured run: its problem, the windows that count, and the simulations made for it.

    Parameters
    ----------
    name : str
        Name of the run's folder.
    problem : Problem
        The calibrated cell with this run's warm-up, its scenario as recorded and, if it never
        moved, its placement.
    policy : str
        A policy's name, or a candidate's for the placement that never moves.
    windows : int
        Length of the run.
    guard : bool
        Whether the cell's guard could act.
    jobs : bool
        Whether the run kept its jobs.
    excluded : frozenset of int
        Windows that are left out: the excluded windows of its record and, under a policy that
        moves, the later windows that depend on decisions in them. They are left out with and
        without a move, so the result does not select them.
    """

    name: str
    problem: Problem
    scenario: str
    policy: str
    estimator: str
    windows: int
    guard: bool
    jobs: bool
    excluded: frozenset[int]

    @property
    def contender(self) -> str:
        """The policy with its estimator, ``dtp+corrected``; a candidate's name alone."""
        moves = self.policy not in self.problem.candidates
        return f"{self.policy}+{self.estimator}" if moves else self.policy


def read_measured(name: str, run: Run, problem: Problem, usual: Usual | None = None) -> MeasuredRun:
    """Return a run's cell, scenario and policy; refuse a run that the cell cannot predict.

    Parameters
    ----------
    problem : Problem
        The calibrated cell.
    usual : Usual, optional
        Speeds of the CPUs at the calibration; if the run has them too, the prediction is for CPUs
        of the run's speed.

    Raises
    ------
    RunError
        With every fault that was found: another cell, a scenario or a policy that the cell does
        not have, settings that differ.
    """
    meta = run.meta
    try:
        recorded = _document(run.problem)
    except RunError as error:
        raise RunError(f"{name}: {error}") from None
    own = _document(problem)
    faults = [*_other_cell(recorded, own)]
    scenario = str(meta.get("scenario") or "")
    if scenario not in problem.scenarios:
        known = ", ".join(problem.scenarios)
        faults.append(f"scenario {scenario!r} is not in the cell (it has {known})")
    if faults:
        raise RunError("\n".join(f"{name}: {fault}" for fault in faults))
    try:
        excluded = excluded_windows(meta)
        estimator = name_in_run(meta)
        policy, problem = _policy(run, recorded, own, resolved(problem, estimator))
        warmup = int(run.windows["warmup"].sum())
        items = _as_played(recorded, own, problem, scenario, run)
        problem = replace(
            problem,
            warmup_windows=warmup,
            scenarios={**problem.scenarios, scenario: items},
        )
        problem = at_speed_of(run, problem, usual or Usual())
        if policy not in problem.candidates:
            excluded |= {
                window + step
                for window in excluded
                for step in range(1, -(-problem.dwell_cycles // problem.window_cycles) + 1)
                if window + step < run.windows.height
            }
    except DwellError as error:
        raise RunError(f"{name}: {error}") from None
    guard = bool(meta.get("guard") if run.is_simulated else problem.controller.fallbacks)
    return MeasuredRun(
        name=name,
        problem=problem,
        scenario=scenario,
        policy=policy,
        estimator=estimator,
        windows=run.windows.height,
        guard=guard,
        jobs=run.has_jobs,
        excluded=excluded,
    )


def excluded_windows(meta: Mapping[str, Any]) -> frozenset[int]:
    """Return the excluded windows of a run's record.

    Parameters
    ----------
    meta : mapping
        ``excluded_windows``, or ``excluded`` of ``pressure``: numbers. None where both are missing.

    Raises
    ------
    RunError
        If it is something else.
    """
    pressure = meta.get("pressure")
    named = {
        "excluded_windows": meta.get("excluded_windows"),
        "pressure.excluded": pressure.get("excluded") if isinstance(pressure, Mapping) else None,
    }
    numbers: set[int] = set()
    for field, windows in named.items():
        try:
            numbers.update(map(int, windows or ()))
        except (TypeError, ValueError):
            raise RunError(f"{field} is {windows!r}; numbers of windows are wanted") from None
    return frozenset(numbers)


# ------------------------------------------------------------------------------------- the cell


def _document(problem: Problem) -> Document:
    document: Document = json.loads(json.dumps(to_document(problem)))
    return document


def _other_cell(theirs: Document, own: Document) -> Iterator[str]:
    """Yield in what two cells differ, calibration aside."""
    for field in ("name", "period_ms", "deadline_ms", "window_cycles"):
        if theirs[field] != own[field]:
            was, now = theirs[field], own[field]
            yield f"it is a run of another cell: {field} is {was!r}, not {now!r}"
    for field in ("nodes", "tasks"):
        there, here = theirs[field], own[field]
        if set(there) != set(here):
            was, now = _names(there), _names(here)
            yield f"it is a run of another cell: its {field} are {was}, not {now}"
    for kind, fields in MADE_OF.items():
        for name, field in product(own[kind].keys() & theirs[kind].keys(), fields):
            was, now = (cell[kind][name].get(field) for cell in (theirs, own))
            if _allowance(was) != _allowance(now):
                yield f"{kind}.{name}.{field} was {was!r} in the run and is {now!r} in the cell"
    there, here = ({f"{one['from']}->{one['to']}" for one in doc["flows"]} for doc in (theirs, own))
    if there != here:
        yield f"it is a run of another cell: its flows are {_names(there)}, not {_names(here)}"


def _allowance(value: Any) -> Any:
    """Return a quota without `slack_ms` and `tick_ms`, which belong to the model."""
    if not isinstance(value, Mapping):
        return value
    return {key: entry for key, entry in value.items() if key not in ("slack_ms", "tick_ms")}


def _names(values: Any) -> str:
    return ", ".join(sorted(map(str, values))) or "none"


# ----------------------------------------------------------------------------------- the policy


def _policy(run: Run, theirs: Document, own: Document, problem: Problem) -> tuple[str, Problem]:
    """Return the policy's name, and the problem with the candidates that the run had."""
    told = str(run.meta.get("policy") or "")
    head = re.split(r"[(\s]", told, maxsplit=1)[0]
    if head == "Static":
        found = re.search(r"initial='([^']+)'", told)
        name = found.group(1) if found else run.problem.controller.policy
    else:
        name = name_of_class(head) or told
    problem = _with_candidates(problem, run.problem)
    policy = by_name(name, problem)
    if name in problem.candidates:
        return name, problem
    if told != head and repr(policy) != told:
        raise RunError(f"policy was {told}; by the cell it would be {policy!r}")
    if theirs["objective"] != own["objective"]:
        raise RunError(
            f"policy {name} had another objective than the cell's: {theirs['objective']}, "
            f"not {own['objective']}"
        )
    return name, problem


def _with_candidates(problem: Problem, recorded: Problem) -> Problem:
    """Return the problem with a run's candidates: what could be chosen, or tried, is its own.

    With them come where it began, and the fallbacks. A candidate that the cell has under this name
    with other nodes is refused.
    """
    for name, placement in recorded.candidates.items():
        if name in problem.candidates and placement != problem.candidates[name]:
            tasks = problem.pipeline.tasks
            was, now = (relocated(one, tasks) for one in (placement, problem.candidates[name]))
            raise RunError(f"candidate {name} was {was} in the run; in the cell {now}")
    if list(recorded.candidates) == list(problem.candidates):
        return problem
    controller = replace(
        problem.controller,
        initial=recorded.controller.initial,
        fallbacks=recorded.controller.fallbacks,
    )
    return replace(problem, candidates=recorded.candidates, controller=controller)


# --------------------------------------------------------------------------------- the scenario


def _as_played(
    theirs: Document,
    own: Document,
    problem: Problem,
    name: str,
    run: Run,
) -> Scenario:
    """Return the cell's scenario with the recorded times of its disturbances."""
    items, written = problem.scenario(name), own["scenarios"].get(name, [])
    if run.played is None:
        if theirs["scenarios"].get(name, []) != written:
            raise RunError(f"scenario {name!r} differs between the run and the cell")
        return items
    left = [(item, _timeless(item)) for item in items]
    end_s = _end_s(run.cycles)
    found: list[Disturbance] = []
    for item in run.played:
        match = next((pair for pair in left if pair[1] == _timeless(item)), None)
        if match is None:
            told = json.dumps(disturbance_document(item))
            raise RunError(f"{told} was played, which scenario {name!r} does not have")
        if match[0].episodes is None:
            left.remove(match)
        # A disturbance that lasted to the end of the run has no end in it.
        for_s = math.inf if item.end_s >= end_s else item.for_s
        own_item = replace(match[0], at_s=item.at_s, for_s=for_s, ramp_s=item.ramp_s)
        found.append(replace(own_item, episodes=None))
    return tuple(found)


def _timeless(item: Disturbance) -> dict[str, Any]:
    document = disturbance_document(item)
    times = "at_s", "for_s", "episodes", "ramp_s"
    return {key: value for key, value in document.items() if key not in times}


def _end_s(cycles: pl.DataFrame) -> float:
    """Release of the last cycle (s), less the rounding of two clocks."""
    return float(np.max(cycles["release_ns"].to_numpy(), initial=0)) / 1e9 - 0.1


# ----------------------------------------------------------------------------- the simulations


class Unit(NamedTuple):
    """One simulation: the group, the run in it, and its number among that run's simulations."""

    group: int
    run: int
    step: int


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """The counted part of a simulation, and its jobs if they are needed."""

    piece: Piece
    jobs: pl.DataFrame | None


@dataclass(frozen=True, slots=True)
class Simulator:
    """Simulates the runs of groups, each `seeds` times, in any process."""

    groups: tuple[tuple[MeasuredRun, ...], ...]
    seeds: int

    @property
    def units(self) -> list[Unit]:
        """All simulations."""
        return [
            Unit(group, run, step)
            for group, mine in enumerate(self.groups)
            for run in range(len(mine))
            for step in range(self.seeds)
        ]

    def __call__(self, unit: Unit) -> Simulated:
        """Simulate once."""
        from dwell.sim import simulate

        one = self.groups[unit.group][unit.run]
        # Only a run's first simulation keeps its jobs, as they are many.
        jobs = one.jobs and unit.step == 0
        run = simulate(
            one.problem,
            scenario=one.scenario,
            policy=one.policy,
            estimator=one.estimator,
            # Different seeds make the simulations of a group independent.
            seed=unit.run * self.seeds + unit.step + 1,
            windows=one.windows,
            jobs=jobs,
            guard=one.guard,
        )
        # If orders take time, a simulation may be some windows shorter than its run.
        piece = piece_of(run, one.problem, one.excluded)
        return Simulated(piece, finished_jobs(run, one.problem.window_cycles) if jobs else None)
