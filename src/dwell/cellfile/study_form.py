"""The form of a study file: its keys, their types and bounds."""

from __future__ import annotations

from typing import Any

from dwell.cellfile.forms import (
    FlagForm,
    ListForm,
    MappingForm,
    NumberForm,
    TextForm,
    WrittenForm,
    not_allowed,
    optional,
    required,
)
from dwell.cellfile.structure import FileKind
from dwell.model.bounds import FUNCTION_PATH, MAX_COUNT, NOT_EMPTY, SEEDS, Bound, as_read

VERSION = 1

WINDOWS = Bound(1, MAX_COUNT, whole=True)
SEED, COUNT = NumberForm(Bound(0, 10**15, whole=True)), NumberForm(SEEDS)


def _seeds(value: Any) -> tuple[int, ...]:
    """Return the seeds of ``20`` (1 to 20), of a list, or of ``{from: 101, count: 20}``."""
    if isinstance(value, dict):
        return _seeds_from(value)
    if isinstance(value, list):
        if not value:
            raise ValueError("the list is empty; name at least one seed")
        return tuple(_each_once([SEED.number(seed) for seed in value]))
    if isinstance(value, bool) or not isinstance(value, int | float):
        ways = "a number of seeds, a list of seeds, or {from: 101, count: 20}"
        raise ValueError(not_allowed(value, ways))
    return tuple(range(1, COUNT.number(value) + 1))


def _seeds_from(value: dict[str, object]) -> tuple[int, ...]:
    unknown = [key for key in value if key not in ("from", "count")]
    if unknown:
        raise ValueError(f"unknown key {unknown[0]!r}; known: from, count")
    missing = [key for key in ("from", "count") if value.get(key) is None]
    if missing:
        raise ValueError(f"`{missing[0]}` is missing; write it as {{from: 101, count: 20}}")
    first, count = SEED.number(value["from"]), COUNT.number(value["count"])
    return tuple(range(first, first + count))


def _each_once(values: list[Any]) -> list[Any]:
    seen: set[Any] = set()
    for value in values:
        if value in seen:
            raise ValueError(f"{as_read(value)} is given twice; name each once")
        seen.add(value)
    return values


def _names(value: object, what: str) -> list[str]:
    """Return a list of names, each given once."""
    if not isinstance(value, list) or not all(isinstance(name, str) and name for name in value):
        raise ValueError(not_allowed(value, f"a list of {what}, or a mapping"))
    if not value:
        raise ValueError(f"the list is empty; name at least one of {what}")
    return _each_once(value)


def _scenarios(value: object) -> dict[str, object]:
    """Return what each scenario is: a list of disturbances, or None for the cell's own."""
    if isinstance(value, dict):
        if not value:
            raise ValueError("the mapping is empty; name at least one scenario")
        return value
    return dict.fromkeys(_names(value, "scenarios"))


def _policies(value: object) -> dict[str, object]:
    """Return the policies by name: their names, or mappings of their keys."""
    if isinstance(value, dict):
        return value
    return {name: name for name in _names(value, "policies")}


def _parameters(value: object) -> dict[str, object]:
    """Return a mapping of paths."""
    if isinstance(value, dict):
        return value
    raise ValueError(not_allowed(value, "a mapping of paths in the cell to lists of values"))


NAME, NO_TEXT = TextForm(), TextForm(NOT_EMPTY)
STUDY = FileKind.of(
    "study",
    "dwell-study",
    VERSION,
    "Study",
    "Scenarios, policies, parameters and seeds; every combination is simulated.",
    optional("name", NAME, "Name of the study.", "the file's"),
    required("cell", NAME, "The cell file, relative to this file's folder.", ""),
    optional(
        "traces",
        NO_TEXT,
        "Folder where the cell's trace files are, relative to this file's.",
        "the cell's",
    ),
    optional(
        "scenarios",
        WrittenForm("list of names, name → list of disturbances", _scenarios, may_be_empty=True),
        "Scenarios of the cell, or a mapping of names to disturbances.",
        "all of the cell's",
    ),
    optional("windows", NumberForm(WINDOWS), "Length of every run, the warm-up included.", "300"),
    optional(
        "seeds",
        WrittenForm("number, list, `{from, count}`", _seeds),
        "Number of seeds, or the seeds.",
        "20",
    ),
    optional(
        "references",
        FlagForm(),
        "Whether to simulate the clairvoyant and the oracle, too.",
        "false",
    ),
    required(
        "policies",
        WrittenForm("list of names, name → policy", _policies),
        "Policies and candidates, or a mapping from names to policies.",
        {},
    ),
    optional(
        "parameters",
        WrittenForm("path → list of values", _parameters),
        "Values by their path in the cell; every combination is a point.",
    ),
    optional(
        "zip",
        ListForm(ListForm(NAME)),
        "Groups of parameters whose values go together, the first with the first.",
        "none",
    ),
    optional(
        "metrics",
        MappingForm(TextForm(FUNCTION_PATH), keeps=True),
        "Numbers of your own: name → function of a Run that returns a number.",
        "none",
    ),
    optional(
        "labels",
        MappingForm(NO_TEXT),
        "Names of parameters in figures and tables, by their paths.",
        "the paths",
    ),
)
FLEET_STUDY = FileKind.of(
    "study",
    "dwell-study",
    VERSION,
    "FleetStudy",
    "Policies, parameters and seeds; every combination is simulated for the cells of a fleet.",
    required("fleet", NAME, "The fleet file, relative to this file's folder.", ""),
    *(
        key
        for key in STUDY.shape.keys
        if key.name not in ("version", "cell", "traces", "scenarios", "references")
    ),
    optional(
        "scenarios",
        ListForm(NO_TEXT),
        "Scenarios of the first entry's cells; the others keep theirs.",
        "the fleet's",
    ),
)
