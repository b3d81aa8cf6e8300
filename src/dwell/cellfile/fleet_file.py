"""Read a fleet file: cells that share nodes, and how they are coordinated."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path
from typing import Any

from dwell.cellfile.assembly import unknown_names
from dwell.cellfile.cell import load
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import (
    FAULTY,
    Definitions,
    Entry,
    Form,
    JsonSchema,
    ListForm,
    NumberForm,
    TextForm,
    optional,
    refused,
    required,
    shape_of,
)
from dwell.cellfile.structure import FileKind, read_structure
from dwell.cellfile.yaml_text import read_yaml
from dwell.model import Problem
from dwell.model.bounds import NOT_EMPTY, Bound
from dwell.model.fleet import PHASE_WAYS, PHASES, Fleet, FleetEntry, Kind, fleet_faults
from dwell.model.semantics import bad_name


class PhasesForm(Form):
    """A word, or a list of phases."""

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the word, or the phases of a list."""
        if isinstance(value, list):
            found = ListForm(NumberForm(Bound(0))).read(value, path, faults)
            return found if found is FAULTY else tuple(found)
        return value if isinstance(value, str) else refused(value, PHASE_WAYS, path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return both."""
        return {"anyOf": [{"enum": list(PHASES)}, {"type": "array", "items": {"type": "number"}}]}


GIVEN = TextForm(NOT_EMPTY)
CELL = required("cell", GIVEN, "The cell file, relative to this file's folder.")
ENTRY = shape_of(FleetEntry, {}, further=(CELL,))
SETTINGS = shape_of(
    Fleet,
    {},
    instead={"phases": PhasesForm()},
)
FLEET = FileKind.of(
    "fleet",
    "dwell-fleet",
    1,
    SETTINGS.title,
    SETTINGS.says,
    optional("name", TextForm(), "Name of the fleet.", "the file's"),
    required(
        "cells",
        ListForm(ENTRY, keeps=True),
        "Cells by kind.",
        [],
    ),
    *SETTINGS.keys,
)


def load_fleet(path: str | PathLike[str]) -> Fleet:
    """Read a fleet file, and the cells that it names.

    Parameters
    ----------
    path : str or path
        A YAML 1.2 (or JSON) file.

    Raises
    ------
    ProblemError
        With every fault found in it, each with its line and field path. A fault of a cell is one
        at its ``cell``.
    """
    source = fspath(path)
    faults = Faults(source)
    document = read_yaml(source, faults, FLEET.what, FLEET.begin)
    entry = read_structure(document, faults, FLEET)
    fleet = _Reading(entry, Path(source), faults).fleet()
    if fleet is None or faults:
        raise faults.error()
    return fleet


class _Reading:
    """The reading of one fleet file."""

    def __init__(self, entry: Entry, path: Path, faults: Faults) -> None:
        self.entry, self.path, self.faults = entry, path, faults
        self.known: dict[str, Problem | None] = {}

    def fleet(self) -> Fleet | None:
        """Return the fleet, or None after at least one fault."""
        entry, faults = self.entry, self.faults
        name = entry.name or self.path.stem
        if message := bad_name(name):
            faults.add("name", message)
        read = [self._entry(f"cells[{i}]", one) for i, one in enumerate(entry.cells)]
        cells = [cell for cell in self.known.values() if cell is not None]
        for cell in cells:
            self._check_names("", entry, cell)
        given = {key: entry.values[key] for key in SETTINGS.names if key in entry.values}
        given["shared"] = tuple(given.get("shared", ()))
        if not faults.at("cells"):
            phases = given.get("phases", "sync")
            wrong = [faults.at(f"cells[{i}].count") for i in range(len(read))]
            if not isinstance(phases, str) and (any(wrong) or None in entry.cells):
                # The required number of phases is known only if all counts are.
                phases = "sync"
            for fault in fleet_faults([kind for kind, _ in read], given["shared"], phases):
                faults.add(fault.path, fault.message)
        if faults:
            return None
        entries = tuple(made for _, made in read if made is not None)
        return faults.attempt("", Fleet, name, entries, file=str(self.path), **given)

    def _entry(self, path: str, entry: Entry | None) -> tuple[Kind, FleetEntry | None]:
        """Return count and cell of an entry, and the fleet's entry; None after a fault."""
        if entry is None:
            return (1, None), None
        values = dict(entry.values)
        cell = self._cell(f"{path}.cell", values.pop("cell"))
        kind = (values.get("count", 1), cell)
        if cell is None:
            return kind, None
        self._check_names(f"{path}.", entry, cell)
        return kind, self.faults.attempt(path, FleetEntry, cell, **values)

    def _cell(self, path: str, file: str) -> Problem | None:
        """Return a cell; every file is read once."""
        if file not in self.known:
            self.known[file] = self.faults.of_file(path, load, self.path.parent / file)
        return self.known[file]

    def _check_names(self, path: str, entry: Entry, cell: Problem) -> None:
        """Check that a policy and an estimator that are named are known."""
        policy, estimator = entry.policy, entry.estimator
        if policy is not None:
            policy, named = cell.policy_and_estimator(policy)
            estimator = named or estimator
        for fault in unknown_names(policy, estimator, cell):
            self.faults.add(f"{path}{fault.path}", fault.message)
