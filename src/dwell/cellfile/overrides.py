"""Overrides: values that take the place of a cell's own, at dotted paths.

A study's parameters, its policies' settings and ``dwell run --set`` put them into the cell's
document, which is then read like a file: a wrong value gets the message that it would get there,
at the place where it was given.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.cellfile.cell import read_cell, read_problem
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.study_paths import put
from dwell.errors import ProblemError
from dwell.model import Problem
from dwell.model.dotted_paths import Step, dotted, overlap_faults, steps_of

if TYPE_CHECKING:
    from dwell.cellfile.traces import Tables


@dataclass(frozen=True, slots=True)
class Override:
    """A value that is put into a cell, and the place where it is given."""

    place: str
    steps: tuple[Step, ...]
    value: object

    @property
    def path(self) -> str:
        """Dotted path of the value in the cell."""
        return dotted(self.steps)


@dataclass(frozen=True, slots=True)
class OpenCell:
    """A cell that takes other values: its document and its problem."""

    document: Any
    problem: Problem
    folder: Path
    traces: dict[object, Tables] = field(repr=False)

    def changed(self, overrides: Iterable[Override]) -> OpenCell:
        """Return the cell with overridden values.

        Raises
        ------
        ProblemError
            With every fault found.
        """
        document = self.document
        for one in overrides:
            document = put(document, one.steps, one.value)
        name, home = self.problem.name, self.problem.folder
        problem = read_problem(document, Faults(), self.folder, name, self.traces, home=home)
        return OpenCell(document, problem, self.folder, self.traces)

    def attempt(
        self, overrides: Sequence[Override], faults: Faults, otherwise: str, where: str = ""
    ) -> OpenCell | None:
        """Return the cell with overridden values, or None with faults at the overrides' places.

        Parameters
        ----------
        otherwise : str
            Place of faults that several values cause together.
        where : str
            Text added to their messages.
        """
        try:
            return self.changed(overrides)
        except ProblemError as error:
            for fault in error.faults:
                beneath = Faults()
                beneath.add(fault.path, "")
                mine = [one for one in overrides if beneath.touches(one.path)]
                exact = bool(mine) and mine[0].path == fault.path
                message = fault.message if exact else str(fault)
                if mine:
                    faults.add(mine[0].place, message)
                else:
                    faults.add(otherwise, message + where)
            return None


def open_cell(file: Path, traces: Path | None = None) -> OpenCell:
    """Read a cell file as it is.

    Parameters
    ----------
    traces : Path, optional
        Folder where the relative names of trace files start; the cell's own where None.

    Raises
    ------
    ProblemError
        With every fault found in the file.
    """
    folder = file.parent if traces is None else traces
    tables: dict[object, Tables] = {}
    return OpenCell(*read_cell(str(file), folder, tables), folder, tables)


def check_apart(places: Mapping[str, tuple[Step, ...] | None], faults: Faults) -> None:
    """Refuse a path that begins with another path; the keys of `places` are for messages."""
    known = {place: steps for place, steps in places.items() if steps is not None}
    for fault in overlap_faults(known):
        faults.add(fault.path, fault.message)


def load_with(
    file: str | PathLike[str], settings: Sequence[str], traces: Path | None = None
) -> Problem:
    """Read a cell file and put values into it.

    Parameters
    ----------
    settings : sequence of str
        Each as ``PATH=VALUE``: a path as ``links[0].delay_ms``, a value as YAML.
    traces : Path, optional
        See `open_cell`.

    Raises
    ------
    ProblemError
        With every fault found in the file; or, where it has none, in the settings, each at
        ``--set PATH``.
    """
    cell = open_cell(Path(file), traces)
    faults = Faults(fspath(file))
    given: set[str] = set()
    overrides = [one for text in settings for one in _override(text, cell, faults, given)]
    check_apart({one.place: one.steps for one in overrides}, faults)
    if faults:
        raise faults.error()
    if len(overrides) == 1:
        changed = cell.attempt(overrides, faults, overrides[0].place)
    else:
        changed = cell.attempt(overrides, faults, "--set", f" (with {', '.join(settings)})")
    if changed is None:
        raise faults.error()
    return changed.problem


def _override(text: str, cell: OpenCell, faults: Faults, given: set[str]) -> Iterator[Override]:
    """Yield the override ``PATH=VALUE``; nothing after a fault."""
    from dwell.cellfile.yaml_text import read_value

    path, equals, value = text.partition("=")
    place = f"--set {path}"
    if not equals:
        faults.add(place, "has no `=`; write PATH=VALUE, such as `period_ms=40`")
        return
    if path in given:
        faults.add(place, "is given twice; give it once")
        return
    given.add(path)
    read = read_value(value, faults, place)
    if read is None and not faults.at(place):
        faults.add(place, "nothing is given; give a value, as `period_ms=40`")
    try:
        steps = steps_of(path, cell.document)
    except ProblemError as error:
        for fault in error.faults:
            faults.add(place, fault.message)
        return
    if not faults.at(place):
        yield Override(place, steps, read)
