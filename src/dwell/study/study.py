"""Study: simulates every combination of scenarios, policies, parameters and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from dwell.cellfile.study_file import Value, read_study
from dwell.cellfile.study_paths import with_settings
from dwell.errors import SimulationError
from dwell.estimators.searched_cell import searched
from dwell.model import FrozenDict, Problem
from dwell.model.bounds import counted
from dwell.model.fleet import Fleet
from dwell.model.problem import Drawn
from dwell.model.semantics import nearest
from dwell.study.metric import declared
from dwell.study.reference import CLAIRVOYANT, REFERENCES

if TYPE_CHECKING:
    from dwell.estimators import Estimator
    from dwell.policies import MinimalPolicy

#: Largest number of runs of an item with several points. Enough runs make the time for sampling
#: their realisation negligible; with few runs, an interruption loses little work.
ITEM_RUNS = 64

TAKEN = "the tables have such a column already; choose another name"


@dataclass(frozen=True, slots=True)
class Contender:
    """A policy of a study, with its estimator and settings.

    Parameters
    ----------
    name : str
        Name in tables. A candidate's name is reserved for its static placement.
    policy : policy or str
        An object with ``decide``, or the name of a policy or candidate.
    estimator : Estimator or str, optional
        Default: the cell's estimator.
    settings : mapping of str to object
        Values below ``controller`` and ``objective`` of the cell, by their paths. They change the
        controller and its objective, but not the conditions of its runs. The objective of the point
        judges the runs of all contenders.
    """

    name: str
    policy: MinimalPolicy | str
    estimator: Estimator | str | None = None
    settings: Mapping[str, object] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "settings", FrozenDict(self.settings))

    def problem(self, problem: Problem) -> Problem:
        """Return the problem with this contender's settings and estimator.

        Raises
        ------
        ProblemError
            If a setting is wrong.
        """
        settings = dict(self.settings)
        if isinstance(self.estimator, str):
            settings["controller.estimator"] = self.estimator
        return with_settings(problem, settings) if settings else problem

    def fleet(self, fleet: Fleet, scenario: str) -> Fleet:
        """Return the fleet with this contender's settings, and a scenario for the first entry.

        Raises
        ------
        ProblemError
            If a setting is wrong.
        """
        first, *others = fleet.entries
        entries = (replace(first, scenario=scenario), *others)
        if self.settings:
            entries = tuple(
                replace(one, cell=with_settings(one.cell, self.settings)) for one in entries
            )
        named = {"policy": self.policy, "estimator": self.estimator}
        given = {name: one for name, one in named.items() if isinstance(one, str)}
        return replace(fleet, entries=entries).changed(**given)

    def is_candidate(self, problem: Problem) -> bool:
        """Whether the contender is a candidate's static placement, without other settings."""
        plain = self.estimator is None and not self.settings
        return plain and isinstance(self.policy, str) and self.policy in problem.candidates


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a study's parameters.

    Parameters
    ----------
    values : mapping of str to float, int or str
        Values by the parameter's path in the cell.
    problem : Problem
        Problem with these values; for a fleet, of its first cell.
    fleet : Fleet, optional
        Fleet with these values, in a study of a fleet.
    """

    values: Mapping[str, Value]
    problem: Problem
    fleet: Fleet | None = None

    def __post_init__(self) -> None:
        # JSON cannot store NumPy scalars.
        values = {
            name: value.item() if isinstance(value, np.generic) else value
            for name, value in self.values.items()
        }
        object.__setattr__(self, "values", FrozenDict(values))

    def __repr__(self) -> str:
        return f"<Point of {self.problem.name}: {dict(self.values)}>"

    @property
    def window_cycles(self) -> int:
        """Cycles per window, summed over the cells."""
        if self.fleet is None:
            return self.problem.window_cycles
        return sum(cell.problem.window_cycles for cell in self.fleet.cells)


@dataclass(frozen=True, slots=True)
class Item:
    """One realisation, common to all contenders.

    Parameters
    ----------
    points : tuple of int
        Indices of points with the same realisation.
    """

    points: tuple[int, ...]
    scenario: str
    seed: int


@dataclass(frozen=True, slots=True)
class Study:
    """Plan of a study: every point, scenario, contender and seed.

    Parameters
    ----------
    points : tuple of Point
        Points with the same parameters, candidates and nodes, and different values.
    windows : int
        Length of every run, including the warm-up.
    references : bool
        Whether the references are simulated, too.
    labels : mapping of str to str
        Names of parameters in figures and tables, by their paths. Default: the path.
    metrics : mapping of str to str
        Functions from a Run to a number, as ``package.module:function``, by the names of their
        columns.
    folder : str, optional
        First folder of the search path for modules of metrics.

    Raises
    ------
    SimulationError
        If a value is invalid or a name is ambiguous.
    ProblemError
        If a scenario is unknown, a run is too long for 64 bits (see `Problem.cycles_of`), or not
        longer than the warm-up, or the references do not support a cell (see
        `Problem.require_simple`).
    """

    name: str
    points: tuple[Point, ...]
    scenarios: tuple[str, ...]
    contenders: tuple[Contender, ...]
    seeds: tuple[int, ...]
    windows: int
    references: bool = False
    labels: Mapping[str, str] = field(default_factory=FrozenDict)
    metrics: Mapping[str, str] = field(default_factory=FrozenDict)
    folder: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", FrozenDict(self.labels))
        object.__setattr__(self, "metrics", FrozenDict(self.metrics))
        points = tuple(
            point if point.fleet else replace(point, problem=searched(point.problem))
            for point in self.points
        )
        object.__setattr__(self, "points", points)
        names = tuple(contender.name for contender in self.contenders)
        _require_each_once("points", [dict(point.values) for point in self.points])
        _require_each_once("scenarios", self.scenarios)
        remedy = "name each once; policies={'first': ..., 'second': ...} names objects"
        _require_each_once("policies", names, remedy)
        _require_each_once("seeds", self.seeds)
        for point in self.points:
            self._check(point)
        for path in self.labels:
            if path not in self.parameters:
                hint = nearest(path, self.parameters)
                raise SimulationError(f"labels: {path!r} is none of the parameters; {hint}")
        for name in self.metrics:
            if declared(name):
                raise SimulationError(f"metrics.{name}: {TAKEN}")
        objects = [one.name for one in self.contenders if not isinstance(one.policy, str)]
        if objects and any(point.fleet is not None for point in self.points):
            raise SimulationError(f"{objects[0]}: the policies of a fleet have to be named")
        moving = [one.name for one in self.contenders if one.policy != one.name]
        if taken := [name for name in moving if name in self.points[0].problem.candidates]:
            raise SimulationError(f"{taken[0]!r} is a candidate's name; choose another")
        reserved = [name for name in names if self.references and name in REFERENCES]
        if reserved:
            raise SimulationError(f"{reserved[0]!r} is a reference's name; choose another")

    def __repr__(self) -> str:
        return (
            f"<Study {self.name}: {counted(len(self.points), 'point')}, "
            f"{counted(len(self.scenarios), 'scenario')}, "
            f"{counted(len(self.contenders), 'policy')}, {counted(len(self.seeds), 'seed')}, "
            f"{counted(self.windows, 'window')}>"
        )

    def _check(self, point: Point) -> None:
        first, problem = self.points[0], point.problem
        for what, mine, others in (
            ("parameters", point.values, first.values),
            ("candidates", problem.candidates, first.problem.candidates),
            ("nodes", problem.fabric.nodes, first.problem.fabric.nodes),
        ):
            if tuple(mine) != tuple(others):
                has, other = ", ".join(mine) or "none", ", ".join(others) or "none"
                raise SimulationError(f"the points differ in {what}: {other}, and {has}")
        for scenario in self.scenarios:
            problem.scenario(scenario)
        problem.cycles_of(self.windows)
        if self.references:
            problem.require_simple("references")
        problem.require_counted(self.windows)

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of the contenders, then of the references, as in the tables."""
        names = tuple(contender.name for contender in self.contenders)
        return (*names, *REFERENCES) if self.references else names

    @property
    def players(self) -> tuple[str, ...]:
        """Names with separate parts: each contender, and one name for all references."""
        names = tuple(contender.name for contender in self.contenders)
        return (*names, CLAIRVOYANT) if self.references else names

    @property
    def parameters(self) -> tuple[str, ...]:
        """Paths of the parameters."""
        return tuple(self.points[0].values)

    @property
    def runs(self) -> int:
        """Number of runs without the references."""
        pairs = len(self.scenarios) * len(self.seeds)
        return pairs * len(self.points) * len(self.contenders)

    @property
    def cycles(self) -> int:
        """Number of cycles of all runs without the references."""
        pairs = len(self.scenarios) * len(self.seeds) * len(self.contenders)
        return pairs * self.windows * sum(point.window_cycles for point in self.points)

    def items(self) -> tuple[Item, ...]:
        """Return the items in the order of execution: by seed, then by scenario.

        Points that differ only in the controller and the objective share an item, up to `ITEM_RUNS`
        runs.
        """
        drawn_alike: dict[Drawn | int, list[int]] = {}
        for index, point in enumerate(self.points):
            alike = point.problem.drawn if point.fleet is None else index
            drawn_alike.setdefault(alike, []).append(index)
        size = max(1, ITEM_RUNS // len(self.contenders))
        groups = [
            tuple(group[begin : begin + size])
            for group in drawn_alike.values()
            for begin in range(0, len(group), size)
        ]
        return tuple(
            Item(group, scenario, seed)
            for seed in self.seeds
            for scenario in self.scenarios
            for group in groups
        )


def _require_each_once(what: str, given: Sequence[object], remedy: str = "name each once") -> None:
    """Refuse an empty sequence, and duplicates."""
    if not given:
        raise SimulationError(f"{what} is empty; name at least one")
    seen = set()
    for one in given:
        text = repr(one)
        if text in seen:
            raise SimulationError(f"{what} holds {text} twice; {remedy}")
        seen.add(text)


def load_study(path: str | PathLike[str]) -> Study:
    """Read a study file.

    Raises
    ------
    ProblemError
        With all faults of the file, each with its line and field path.
    """
    declared = read_study(path, references=REFERENCES)._asdict()
    points = tuple(Point(*one) for one in declared.pop("points"))
    contenders = tuple(Contender(*one) for one in declared.pop("policies"))
    return Study(**declared, points=points, contenders=contenders)
