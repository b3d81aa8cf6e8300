"""Read a study file: a cell, and the scenarios, policies, parameters and seeds to try on it.

The reader of cells reads each value that a study file puts into the cell: a wrong value gets the
same message as in a cell file, with its place in the study file.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

from dwell.cellfile.document_faults import Faults
from dwell.cellfile.overrides import OpenCell, Override, check_apart, open_cell
from dwell.cellfile.study_paths import SETTINGS, with_settings
from dwell.errors import ProblemError
from dwell.model import Problem
from dwell.model.bounds import as_read
from dwell.model.dotted_paths import Step, steps_of
from dwell.model.fleet import Fleet
from dwell.model.semantics import bad_name, nearest
from dwell.model.user_classes import user_function

if TYPE_CHECKING:
    from dwell.cellfile.forms import Entry

WINDOWS = 300
SEEDS = tuple(range(1, 21))
# Every point is read and checked before the first run.
MAX_POINTS = 10_000

T = TypeVar("T")
Value: TypeAlias = float | int | str
#: Values of parameters by their paths, and the paths that vary together.
Grid: TypeAlias = "Mapping[str, list[Any]]"
Axes: TypeAlias = "Sequence[tuple[str, ...]]"


class DeclaredPolicy(NamedTuple):
    """A policy of a study: its name in tables, policy, estimator, and settings of the cell."""

    name: str
    policy: str
    estimator: str | None
    settings: Mapping[str, object]


class DeclaredPoint(NamedTuple):
    """A point of a study's grid: the values by their paths, and the cell, or fleet, with them."""

    values: Mapping[str, Value]
    problem: Problem
    fleet: Fleet | None = None


class DeclaredStudy(NamedTuple):
    """A study as its file declares it, every default filled in."""

    name: str
    points: tuple[DeclaredPoint, ...]
    labels: Mapping[str, str]
    scenarios: tuple[str, ...]
    policies: tuple[DeclaredPolicy, ...]
    seeds: tuple[int, ...]
    windows: int
    references: bool
    metrics: Mapping[str, str]
    folder: str


def read_study(path: str | PathLike[str], *, references: Collection[str] = ()) -> DeclaredStudy:
    """Read a study file, and the cell that it names.

    Parameters
    ----------
    path : str or path
        A YAML 1.2 (or JSON) file.
    references : collection of str
        Names that no policy may have where the study asks for references.

    Raises
    ------
    ProblemError
        With every fault found in it, each with its line and field path. A fault of the cell is one
        at ``cell``.
    """
    from dwell.cellfile.structure import read_structure
    from dwell.cellfile.study_form import FLEET_STUDY, STUDY
    from dwell.cellfile.yaml_text import read_yaml

    source = fspath(path)
    faults = Faults(source)
    document = read_yaml(source, faults, STUDY.what, STUDY.begin)
    of_fleet = isinstance(document, dict) and "fleet" in document
    entry = read_structure(document, faults, FLEET_STUDY if of_fleet else STUDY)
    reading = _FleetReading if of_fleet else _Reading
    study = reading(entry, Path(source), faults, references).study()
    if study is None or faults:
        raise faults.error()
    return study


class _Plays(NamedTuple):
    """Points, scenarios and policies of a study, and the cells that need enough windows."""

    points: tuple[DeclaredPoint, ...]
    scenarios: tuple[str, ...]
    policies: list[DeclaredPolicy]
    cells: Sequence[Problem]


@dataclass(frozen=True, slots=True)
class _Reading:
    """The reading of one study file."""

    entry: Entry
    path: Path
    faults: Faults
    reserved: Collection[str]

    def study(self) -> DeclaredStudy | None:
        """Return the study, or None after at least one fault."""
        entry = self.entry
        name = entry.name or self.path.stem
        self._check_name("name", name)
        grid = self._grid()
        axes = self._axes(grid)
        labels = self._labels()
        plays = self._plays(grid, axes, self._policies())
        if plays is None:
            return None
        windows = WINDOWS if entry.windows is None else entry.windows
        self._check_windows(windows, plays.cells)
        for cell in plays.cells if entry.references else ():
            self.faults.attempt("references", cell.require_simple, "references")
        return DeclaredStudy(
            name=name,
            points=plays.points,
            labels=labels,
            scenarios=plays.scenarios,
            policies=tuple(plays.policies),
            seeds=SEEDS if entry.seeds is None else entry.seeds,
            windows=windows,
            references=bool(entry.references),
            metrics=self._metrics(),
            folder=self._folder,
        )

    def _plays(self, grid: Grid, axes: Axes, policies: list[DeclaredPolicy]) -> _Plays | None:
        """Return what is played of the cell, or None where it cannot be read."""
        cell = self._cell()
        if cell is None:
            return None
        cell = self._with_scenarios(cell)
        scenarios = self._scenarios(cell.problem)
        points = self._points(cell, grid, axes)
        policies = [self._with_estimator(policy, cell.problem) for policy in policies]
        for policy in policies:
            self._check_names(policy, cell.problem)
            self._check_settings(policy, [cell for _, cell in points] or [cell])
        cells = [cell.problem for _, cell in points]
        made = tuple(DeclaredPoint(values, cell.problem) for values, cell in points)
        return _Plays(made, scenarios, policies, cells)

    @property
    def _folder(self) -> str:
        """Folder of the file, where modules of metrics are looked for first."""
        return str(self.path.resolve().parent)

    def _metrics(self) -> dict[str, str]:
        """Return the functions of metrics by their names."""
        metrics = self.entry.metrics or {}
        for name, function in metrics.items():
            place = f"metrics.{name}"
            self._check_name(place, name)
            if function is not None:  # that is a fault already
                what = (self._folder, "metric", ProblemError)
                self.faults.attempt(place, user_function, function, *what)
        return metrics

    def _check_name(self, path: str, name: str) -> None:
        if message := bad_name(name):
            self.faults.add(path, message)

    def _check_windows(self, windows: int, cells: Sequence[Problem]) -> None:
        for cell in cells:
            self.faults.attempt("", cell.require_counted, windows)
            self.faults.attempt("", cell.cycles_of, windows)

    # ------------------------------------------------------------------------------ cell

    def _cell(self) -> OpenCell | None:
        """Read the cell as it is in its file."""
        given = self.entry.traces
        traces = None if given is None else self.path.parent / given
        return self._opened("cell", lambda file: open_cell(file, traces))

    def _opened(self, key: str, read: Callable[[Path], T]) -> T | None:
        """Read the file that a key names; each of its faults is one of the key."""
        named = self.entry.values[key]
        if not named and not self.faults.at(key):
            self.faults.add(key, f"the text is empty; name the {key}'s file")
        return self.faults.of_file(key, read, self.path.parent / named) if named else None

    # ------------------------------------------------------------------------- scenarios

    def _with_scenarios(self, cell: OpenCell) -> OpenCell:
        """Add the study's own scenarios to the cell; none if one has a fault."""
        own = [
            Override(f"scenarios.{name}", ("scenarios", name), items)
            for name, items in (self.entry.scenarios or {}).items()
            if items is not None
        ]
        try:
            return cell.changed(own) if own else cell
        except ProblemError as error:
            for fault in error.faults:
                self.faults.add(fault.path, fault.message)
            return cell

    def _scenarios(self, problem: Problem) -> tuple[str, ...]:
        given = self.entry.scenarios
        if given is None:
            return tuple(problem.scenarios)
        for name, items in given.items():
            if items is None and name not in problem.scenarios:
                hint = nearest(name, problem.scenarios)
                path = f"scenarios.{name}"
                self.faults.add(path, f"the cell has no scenario {name!r}; {hint}")
        return tuple(given)

    # ------------------------------------------------------------------------ parameters

    def _grid(self) -> dict[str, list[Any]]:
        """Return the values of every parameter whose structure is right."""
        grid: dict[str, list[Any]] = {}
        # A parameter that follows another may repeat a value.
        following = {path for group in self.entry.zip or () for path in group[1:]}
        for path, values in (self.entry.parameters or {}).items():
            place = f"parameters.{path}"
            if not isinstance(values, list) or not values:
                has = "the list is empty" if values == [] else f"{as_read(values)} is not allowed"
                self.faults.add(place, f"{has}; it must be a list of at least one value")
            elif self.faults.touches(place):
                pass
            elif path not in following and len(set(_shown(values))) < len(values):
                self.faults.add(place, "a value is given twice; give each once")
            else:
                grid[path] = values
        return grid

    def _axes(self, grid: Mapping[str, list[Any]]) -> list[tuple[str, ...]]:
        """Return the axes of the grid: the paths of a group, or a single path.

        A grid with too many points has no axes.
        """
        axes: dict[str, tuple[str, ...]] = {path: (path,) for path in grid}
        for place, group in self._groups():
            counts = {path: len(grid[path]) for path in group if path in grid}
            if len(set(counts.values())) > 1:
                has = ", ".join(f"{path} has {count}" for path, count in counts.items())
                self.faults.add(place, f"values differ in number: {has}; give as many of each")
            else:
                axes |= dict.fromkeys(counts, tuple(counts))
        each = list(dict.fromkeys(axes.values()))
        count = math.prod(len(grid[first]) for first, *_ in each)
        if count > MAX_POINTS:
            self.faults.add("parameters", f"{count} points are more than {MAX_POINTS}; give fewer")
            return []
        return each

    def _groups(self) -> Iterator[tuple[str, list[str]]]:
        """Yield the place and the paths of every group that is right as such."""
        known: dict[str, str] = {}
        for i, group in enumerate(self.entry.zip or ()):
            place = f"zip[{i}]"
            if len(group) < 2:
                has = "1 path" if group else "0 paths"
                self.faults.add(place, f"a group of {has}; name at least two that go together")
            for j, path in enumerate(group):
                if path in known:
                    message = f"{path} is in {known[path]}, too; name it once"
                    self.faults.add(f"{place}[{j}]", message)
                else:
                    known[path] = place
                    self._check_parameter(f"{place}[{j}]", path)
            if not self.faults.touches(place):
                yield place, group

    def _check_parameter(self, place: str, path: str) -> None:
        known = self.entry.parameters or {}
        if path not in known and not self.faults.at("parameters"):
            self.faults.add(place, f"{path!r} is none of the parameters; {nearest(path, known)}")

    def _labels(self) -> dict[str, str]:
        """Return the names of parameters by their paths."""
        labels = self.entry.labels or {}
        for path in labels:
            self._check_parameter(f"labels.{path}", path)
        return labels

    def _points(
        self, cell: OpenCell, grid: Grid, axes: Axes
    ) -> list[tuple[dict[str, Value], OpenCell]]:
        """Return every combination of the values of axes, and the cell with them."""
        steps = {path: self._steps("parameters", path, cell) for path in grid}
        check_apart({f"parameters.{path}": found for path, found in steps.items()}, self.faults)
        places = {path: known for path, known in steps.items() if known is not None}
        right = [tuple(path for path in axis if path in places) for axis in axes]
        points = []
        for at, values in _combinations(grid, [axis for axis in right if axis]):
            overrides = [
                Override(f"parameters.{path}[{i}]", places[path], grid[path][i])
                for path, i in at.items()
            ]
            listed = ", ".join(f"{path} = {value}" for path, value in values.items())
            changed = cell.attempt(overrides, self.faults, "parameters", f" (at {listed})")
            if changed is not None:
                points.append((values, changed))
        return points

    def _steps(self, place: str, path: str, cell: OpenCell) -> tuple[Step, ...] | None:
        """Split a path into steps; None after a fault."""
        unread = path.startswith("scenarios.") and self.faults.touches("scenarios")
        return None if unread else self.faults.attempt(place, steps_of, path, cell.document)

    # -------------------------------------------------------------------------- policies

    def _policies(self) -> list[DeclaredPolicy]:
        """Return the policies whose structure is right."""
        declared: list[DeclaredPolicy] = []
        if not self.entry.policies and not self.faults.at("policies"):
            self.faults.add("policies", "the mapping is empty; name at least one policy")
        for name, given in self.entry.policies.items():
            path = f"policies.{name}"
            self._check_name(path, name)
            if self.entry.references and name in self.reserved:
                self.faults.add(path, f"{name!r} is a reference's name; choose another")
            keys = {"policy": given} if isinstance(given, str) else given
            if isinstance(keys, dict):
                declared += self._policy(path, name, keys)
            elif given is not None:  # that is a fault already
                remedy = "a policy's name, or a mapping of policy, estimator and settings"
                self.faults.add(path, f"{as_read(given)} is not allowed; it must be {remedy}")
        return declared

    def _policy(self, path: str, name: str, keys: Mapping[str, Any]) -> list[DeclaredPolicy]:
        """Return a policy, or nothing after at least one fault."""
        before = len(self.faults)
        texts: dict[str, str] = {}
        settings: dict[str, object] = {}
        for key, value in keys.items():
            place = f"{path}.{key}"
            if key in ("controller.policy", "controller.estimator"):
                self.faults.add(place, f"write it as `{key.removeprefix('controller.')}`")
            elif key.startswith(SETTINGS):
                settings[key] = value
            elif key not in ("policy", "estimator"):
                hint = nearest(key, ["policy", "estimator", *(f"{name}..." for name in SETTINGS)])
                self.faults.add(place, f"unknown key {key!r}; {hint}")
            elif isinstance(value, str) and value:
                texts[key] = value
            elif value is not None:
                has = as_read(value)
                self.faults.add(place, f"{has} is not allowed; it must be a text that is not empty")
        if len(self.faults) > before or self.faults.touches(path):
            return []
        policy = texts.get("policy", name)
        return [DeclaredPolicy(name, policy, texts.get("estimator"), settings)]

    def _with_estimator(self, declared: DeclaredPolicy, problem: Problem) -> DeclaredPolicy:
        """Return the policy with the estimator that its name asks for, as ``cusum+corrected``."""
        policy, estimator = problem.policy_and_estimator(declared.policy)
        if estimator is None:
            return declared
        if declared.estimator not in (None, estimator):
            self.faults.add(
                f"policies.{declared.name}.estimator",
                f"{declared.policy!r} names its estimator; leave {declared.estimator!r} out",
            )
        return declared._replace(policy=policy, estimator=estimator)

    def _check_names(self, policy: DeclaredPolicy, problem: Problem) -> None:
        """Check that the names that a policy gives are known."""
        from dwell.cellfile.assembly import unknown_names

        path = f"policies.{policy.name}"
        faults = {one.path: one for one in unknown_names(policy.policy, policy.estimator, problem)}
        if "policy" in faults:
            self.faults.add(path, faults["policy"].message)
        elif policy.name in problem.candidates and policy.policy != policy.name:
            self.faults.add(
                path,
                f"{policy.name!r} is a candidate's name, for the placement that never moves; give "
                f"{policy.policy!r} another one",
            )
        if "estimator" in faults:
            self.faults.add(f"{path}.estimator", faults["estimator"].message)

    def _check_settings(self, policy: DeclaredPolicy, points: Sequence[OpenCell]) -> None:
        """Check that the settings of a policy are right at every point."""
        from dwell.cellfile.assembly import is_estimator

        path = f"policies.{policy.name}"
        for cell in points:
            steps = {key: self._steps(path, key, cell) for key in policy.settings}
            check_apart({f"{path}.{key}": found for key, found in steps.items()}, self.faults)
            overrides = [
                Override(f"{path}.{key}", found, policy.settings[key])
                for key, found in steps.items()
                if found is not None
            ]
            if policy.estimator is not None and is_estimator(policy.estimator):
                place = f"{path}.estimator"
                overrides.append(Override(place, ("controller", "estimator"), policy.estimator))
            changed = cell.attempt(overrides, self.faults, path) if overrides else None
            if changed is not None:
                self._check_judged(path, cell.problem, changed.problem)

    def _check_judged(self, path: str, cell: Problem, changed: Problem) -> None:
        """Check that the cell's objective can judge the runs of a policy with other settings."""
        self.faults.attempt(path, cell.objective.require_judgeable, changed.objective)


#: Parameters of a study of a fleet: functions that apply a value.
FLEET_PARAMETERS: Mapping[str, Callable[[Fleet, Any], Fleet]] = {
    "fleet.count": lambda fleet, value: fleet.with_count(value),
    "fleet.phases": lambda fleet, value: fleet.changed(phases=value),
    "fleet.coordination": lambda fleet, value: fleet.changed(coordination=value),
}


class _FleetReading(_Reading):
    """The reading of one study of a fleet."""

    __slots__ = ()

    def _plays(self, grid: Grid, axes: Axes, policies: list[DeclaredPolicy]) -> _Plays | None:
        """Return the simulations of the fleet, or None if it cannot be read."""
        fleet = self._fleet()
        if fleet is None:
            return None
        first = fleet.entries[0]
        scenarios = tuple(self.entry.scenarios or (first.scenario,))
        for i, scenario in enumerate(scenarios):
            if scenario not in first.cell.scenarios:
                hint = nearest(scenario, first.cell.scenarios)
                message = f"{first.cell.name} has no scenario {scenario!r}; {hint}"
                self.faults.add(f"scenarios[{i}]", message)
        fleets = self._fleets(fleet, grid, axes)
        policies = [self._with_estimator(policy, first.cell) for policy in policies]
        cells = [*{one.cell.name: one.cell for one in fleet.entries}.values()]
        for cell in cells:
            for policy in policies:
                self._check_names(policy, cell)
        for policy in policies:
            for entry in fleet.entries if policy.settings else ():
                place = f"policies.{policy.name}"
                changed = self.faults.attempt(place, with_settings, entry.cell, policy.settings)
                if changed is not None:
                    self._check_judged(place, entry.cell, changed)
        points = tuple(DeclaredPoint(values, first.cell, one) for values, one in fleets)
        return _Plays(points, scenarios, policies, cells)

    def _fleet(self) -> Fleet | None:
        """Read the fleet as it is in its file."""
        from dwell.cellfile.fleet_file import load_fleet

        return self._opened("fleet", load_fleet)

    def _fleets(self, fleet: Fleet, grid: Grid, axes: Axes) -> list[tuple[dict[str, Value], Fleet]]:
        """Return every combination of the values of axes, and the fleet with them."""
        for path, values in grid.items():
            place = f"parameters.{path}"
            if path not in FLEET_PARAMETERS:
                hint = nearest(path, FLEET_PARAMETERS)
                self.faults.add(place, f"unknown parameter of a fleet {path!r}; {hint}")
                continue
            for i, value in enumerate(values):
                self._changed(fleet, {path: value}, f"{place}[{i}]")
        if self.faults.touches("parameters"):
            return []
        points = []
        for at, shown in _combinations(grid, axes):
            given = {path: grid[path][i] for path, i in at.items()}
            changed = self._changed(fleet, given, "parameters")
            if changed is not None:
                points.append((shown, changed))
        return points

    def _changed(self, fleet: Fleet, values: Mapping[str, Any], place: str) -> Fleet | None:
        """Return the fleet with some values, or None after a fault at a place."""
        try:
            for path, value in values.items():
                fleet = FLEET_PARAMETERS[path](fleet, value)
        except ProblemError as error:
            for fault in error.faults:
                self.faults.add(place, fault.message)
            return None
        return fleet


def _combinations(grid: Grid, axes: Axes) -> Iterator[tuple[dict[str, int], dict[str, Value]]]:
    """Yield every combination of the axes' values: their indices and shown values, by path."""
    shown = {path: _shown(values) for path, values in grid.items()}
    for picked in itertools.product(*(range(len(grid[first])) for first, *_ in axes)):
        at = {path: i for axis, i in zip(axes, picked, strict=True) for path in axis}
        yield at, {path: shown[path][i] for path, i in at.items()}


def _shown(values: Sequence[Any]) -> list[Value]:
    """Return the values of a parameter as a column can hold them: all numbers, or all texts."""
    for kind in (bool, str):
        if all(isinstance(value, kind) for value in values):
            return list(values)
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        whole = all(isinstance(value, int) for value in values)
        return list(values) if whole else [float(value) for value in values]
    return [value if isinstance(value, str) else json.dumps(value) for value in values]
