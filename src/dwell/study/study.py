"""Study: scenarios × policies × parameters × seeds, of which every combination is simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from dwell.cellfile.study_file import Value, read_study
from dwell.cellfile.study_paths import with_settings
from dwell.errors import SimulationError
from dwell.model import FrozenDict, Problem
from dwell.model.bounds import counted
from dwell.model.fleet import Fleet
from dwell.model.problem import Drawn
from dwell.model.semantics import nearest
from dwell.study.over_seeds import is_plain
from dwell.study.reference import CLAIRVOYANT, REFERENCES

if TYPE_CHECKING:
    from dwell.estimators import Estimator
    from dwell.policies import MinimalPolicy

#: Runs of an item at most, where they can be parted: enough that the time for drawing what they
#: share does not count, and few enough that little is lost with an item.
ITEM_RUNS = 64

TAKEN = "the tables have such a column already; choose another name"


@dataclass(frozen=True, slots=True)
class Contender:
    """A policy of a study, with what it believes.

    Parameters
    ----------
    name : str
        In tables; a candidate's name is kept for the placement that never moves.
    policy : policy or str
        An object with ``decide``, a policy's name, or a candidate's.
    estimator : Estimator or str, optional
        The cell's where None.
    settings : mapping of str to object
        Values of the cell below ``controller`` and ``objective``, by their paths. They change what
        the controller does and how it weighs, and nothing that happens to it; its runs are judged
        by the objective of the point, like everybody's.
    """

    name: str
    policy: MinimalPolicy | str
    estimator: Estimator | str | None = None
    settings: Mapping[str, object] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "settings", FrozenDict(self.settings))

    def problem(self, problem: Problem) -> Problem:
        """Return the problem as this contender sees it.

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
        """Return the fleet as this contender plays it, the first entry in a scenario.

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
        """Whether it is a bare candidate's placement, which never moves."""
        plain = self.estimator is None and not self.settings
        return plain and isinstance(self.policy, str) and self.policy in problem.candidates


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a study's parameters.

    Parameters
    ----------
    values : mapping of str to float, int or str
        By the parameter's path in the cell.
    problem : Problem
        With these values put in; of a fleet the first cell.
    fleet : Fleet, optional
        With these values put in, where it is a point of a fleet's study.
    """

    values: Mapping[str, Value]
    problem: Problem
    fleet: Fleet | None = None

    def __post_init__(self) -> None:
        # Numbers of arrays are no numbers to JSON.
        values = {
            name: value.item() if isinstance(value, np.generic) else value
            for name, value in self.values.items()
        }
        object.__setattr__(self, "values", FrozenDict(values))

    def __repr__(self) -> str:
        return f"<Point of {self.problem.name}: {dict(self.values)}>"

    @property
    def window_cycles(self) -> int:
        """Cycles of a window, of all cells."""
        if self.fleet is None:
            return self.problem.window_cycles
        return sum(cell.problem.window_cycles for cell in self.fleet.cells)


@dataclass(frozen=True, slots=True)
class Item:
    """One realisation, which every contender plays.

    Parameters
    ----------
    points : tuple of int
        Points whose realisations are the same: they differ in nothing that is drawn.
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
        All with the same parameters, candidates and nodes, and different values.
    windows : int
        Length of every run, the warm-up included.
    references : bool
        Whether the references play as well.
    labels : mapping of str to str
        Names of parameters in figures and tables, by their paths; a path where there is none.
    metrics : mapping of str to str
        Functions of a Run that return a number, as ``package.module:function``, by the names of
        their columns.
    folder : str, optional
        Where modules of metrics are looked for first.

    Raises
    ------
    SimulationError
        If no study can be made of it.
    ProblemError
        If a scenario is unknown, or 64 bits do not hold the runs (see `Problem.cycles_of`).
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
            if not is_plain(name):
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
        if self.windows <= problem.warmup_windows:
            raise SimulationError(
                f"windows is {self.windows}; it must be more than the "
                f"{problem.warmup_windows} windows of warm-up"
            )

    @property
    def policies(self) -> tuple[str, ...]:
        """Names in the tables, the references' last."""
        names = tuple(contender.name for contender in self.contenders)
        return (*names, *REFERENCES) if self.references else names

    @property
    def players(self) -> tuple[str, ...]:
        """Names of all that have parts of their own: the contenders, and the references."""
        names = tuple(contender.name for contender in self.contenders)
        return (*names, CLAIRVOYANT) if self.references else names

    @property
    def parameters(self) -> tuple[str, ...]:
        """Paths of the parameters."""
        return tuple(self.points[0].values)

    @property
    def runs(self) -> int:
        """Number of runs, those of the references left out."""
        pairs = len(self.scenarios) * len(self.seeds)
        return pairs * len(self.points) * len(self.contenders)

    @property
    def cycles(self) -> int:
        """Number of cycles of all these runs."""
        pairs = len(self.scenarios) * len(self.seeds) * len(self.contenders)
        return pairs * self.windows * sum(point.window_cycles for point in self.points)

    def items(self) -> tuple[Item, ...]:
        """Return the items in the order in which they are done: all scenarios of a seed, then on.

        Points that differ in the controller and the objective alone are played in one item, as
        many as make `ITEM_RUNS`.
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
    """Refuse nothing at all, and anything twice."""
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
        With every fault found in it, each with its line and field path.
    """
    declared = read_study(path, references=REFERENCES)._asdict()
    points = tuple(Point(*one) for one in declared.pop("points"))
    contenders = tuple(Contender(*one) for one in declared.pop("policies"))
    return Study(**declared, points=points, contenders=contenders)
