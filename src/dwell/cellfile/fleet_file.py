"""Read a fleet file: cells that share nodes, and how they are coordinated."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path
from typing import Any

from dwell.cellfile.cell import load
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import (
    ChoiceForm,
    Entry,
    ListForm,
    NumberForm,
    TextForm,
    WrittenForm,
    not_allowed,
    optional,
    required,
    shape_of,
)
from dwell.cellfile.structure import FileKind, read_structure
from dwell.cellfile.yaml_text import read_yaml
from dwell.errors import ProblemError
from dwell.estimators.registry import names as estimator_names
from dwell.model import Problem
from dwell.model.bounds import NOT_EMPTY, Bound
from dwell.model.fleet import COORDINATIONS, OBJECTIVES, PHASES, Fleet, FleetEntry
from dwell.model.semantics import bad_name, nearest, nearest_of
from dwell.model.user_classes import is_class_path
from dwell.policies.registry import names as policy_names

VERSION = 1
PHASE = NumberForm(Bound(0))


def _phases(value: Any) -> str | tuple[float, ...]:
    """Return a word, or the phases of a list."""
    if isinstance(value, list):
        return tuple(PHASE.number(phase) for phase in value)
    if value not in PHASES:
        hint = nearest(value, PHASES) if isinstance(value, str) else ""
        remedy = f"; {hint}" if hint.startswith("did") else ""
        ways = f"one of {', '.join(PHASES)}, or a list of ms{remedy}"
        raise ValueError(not_allowed(value, ways))
    return str(value)


NAME, GIVEN = TextForm(), TextForm(NOT_EMPTY)
POLICY = optional("policy", GIVEN, "Policy of cells that name none.", "the cell's")
ESTIMATOR = optional("estimator", GIVEN, "Estimator of cells that name none.", "the cell's")
FLEET = FileKind.of(
    "fleet",
    "dwell-fleet",
    VERSION,
    "Fleet",
    "Several cells that share nodes, each with a controller of its own.",
    optional("name", NAME, "Name of the fleet.", "the file's"),
    optional("shared", ListForm(GIVEN), "Nodes that are one computer for all cells.", "none"),
    required(
        "cells",
        ListForm(
            shape_of(
                FleetEntry,
                {},
                further=(
                    required("cell", GIVEN, "The cell file, relative to this file's folder."),
                ),
            ),
            keeps=True,
        ),
        "Cells by kind.",
        [],
    ),
    optional(
        "phases",
        WrittenForm("`sync`, `even`, `random`, list of ms", _phases),
        "When each cell begins: all at once, evenly spread, drawn, or by a list.",
        "random",
    ),
    optional(
        "coordination",
        ChoiceForm(COORDINATIONS),
        "What a move is asked for: nothing, a chance, or the ledger.",
        "ledger",
    ),
    optional("objective", ChoiceForm(OBJECTIVES), "What the ledger lowers.", "sum"),
    POLICY,
    ESTIMATOR,
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
    if faults.at(""):
        raise faults.error()
    if isinstance(document, dict) and "dwell" in document and FLEET.key not in document:
        faults.refuse("dwell", f"this is a cell; a fleet file begins with `{FLEET.begin}`")
    entry = read_structure(document, faults, FLEET)
    fleet = _Reading(entry, Path(source), faults).fleet()
    if fleet is None or faults:
        raise faults.error()
    return fleet


class _Reading:
    """One fleet file on its way to what it says."""

    def __init__(self, entry: Entry, path: Path, faults: Faults) -> None:
        self.entry, self.path, self.faults = entry, path, faults
        self.known: dict[str, Problem | None] = {}

    def fleet(self) -> Fleet | None:
        """Return the fleet, or None beside at least one fault."""
        entry = self.entry
        name = entry.name or self.path.stem
        if message := bad_name(name):
            self.faults.add("name", message)
        made = [self._entry(f"cells[{i}]", one) for i, one in enumerate(entry.cells)]
        entries = tuple(one for one in made if one is not None)
        cells = [cell for cell in self.known.values() if cell is not None]
        any(self._check_names("", entry, cell) for cell in cells)
        if len(entries) < len(made):
            return None
        given = {
            key: getattr(entry, key)
            for key in ("shared", "phases", "coordination", "objective", "policy", "estimator")
            if getattr(entry, key) is not None
        }
        if "shared" in given:
            given["shared"] = tuple(given["shared"])
        return self.faults.attempt("", Fleet, name, entries, **given)

    def _entry(self, path: str, entry: Entry | None) -> FleetEntry | None:
        """Return cells of one kind; None beside a fault."""
        if entry is None:
            return None
        values = dict(entry.values)
        file = values.pop("cell")
        cell = self._cell(f"{path}.cell", file)
        if cell is None:
            return None
        self._check_names(f"{path}.", entry, cell)
        return self.faults.attempt(path, FleetEntry, cell, **values)

    def _cell(self, path: str, file: str) -> Problem | None:
        """Return a cell; every file is read once."""
        if file in self.known:
            return self.known[file]
        self.known[file] = None
        try:
            self.known[file] = load(self.path.parent / file)
        except ProblemError as error:
            for line in str(error).splitlines():
                self.faults.add(path, line)
        return self.known[file]

    def _check_names(self, path: str, entry: Entry, cell: Problem) -> bool:
        """Check that a policy and an estimator that are named are known; whether one is not."""
        before = len(self.faults)
        policy, estimator = entry.policy, entry.estimator
        if policy is not None:
            policy, named = cell.policy_and_estimator(policy)
            estimator = named or estimator
            known = [*policy_names(), *cell.candidates]
            if policy not in known and not is_class_path(policy):
                hint = nearest_of(policy, known, "policies")
                self.faults.add(f"{path}policy", f"unknown policy {policy!r}; {hint}")
        known = estimator_names()
        if estimator is not None and estimator not in known and not is_class_path(estimator):
            hint = nearest(estimator, known)
            self.faults.add(f"{path}estimator", f"unknown estimator {estimator!r}; {hint}")
        return len(self.faults) > before
