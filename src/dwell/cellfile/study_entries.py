"""The structure of a study file: its keys, their types and bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from dwell.cellfile.document_faults import Step
from dwell.cellfile.entries import Entry, Number, optional, wrong
from dwell.cellfile.rendering import as_read
from dwell.cellfile.structure import Form
from dwell.model.bounds import MAX_COUNT, SEEDS, Bound

VERSION = 1

WINDOWS = Bound(1, MAX_COUNT, whole=True)
SEED = Bound(0, 10**15, whole=True)


@dataclass(frozen=True, slots=True)
class _Read:
    """A value that may be written in several ways, read by a function, as an annotation."""

    read: Callable[[object], object]

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)


def _seeds(value: object) -> tuple[int, ...]:
    """Return the seeds of ``20`` (1 to 20), of a list, or of ``{from: 101, count: 20}``."""
    if isinstance(value, dict):
        return _seeds_from(value)
    if isinstance(value, list):
        if not value:
            raise wrong("the list is empty; name at least one seed")
        return tuple(_each_once([int(Number(SEED).read(seed)) for seed in value]))
    if isinstance(value, bool) or not isinstance(value, int | float):
        ways = "a number of seeds, a list of seeds, or {from: 101, count: 20}"
        raise wrong(f"{as_read(value)} is not allowed; it must be {ways}")
    return tuple(range(1, int(Number(SEEDS).read(value)) + 1))


def _seeds_from(value: dict[str, object]) -> tuple[int, ...]:
    unknown = [key for key in value if key not in ("from", "count")]
    if unknown:
        raise wrong(f"unknown key {unknown[0]!r}; known: from, count")
    missing = [key for key in ("from", "count") if value.get(key) is None]
    if missing:
        raise wrong(f"`{missing[0]}` is missing; write it as {{from: 101, count: 20}}")
    first, count = int(Number(SEED).read(value["from"])), int(Number(SEEDS).read(value["count"]))
    return tuple(range(first, first + count))


def _each_once(values: list[Any]) -> list[Any]:
    seen: set[Any] = set()
    for value in values:
        if value in seen:
            raise wrong(f"{as_read(value)} is given twice; name each once")
        seen.add(value)
    return values


def _names(value: object, what: str) -> list[str]:
    """Return a list of names, each given once."""
    if not isinstance(value, list) or not all(isinstance(name, str) and name for name in value):
        raise wrong(f"{as_read(value)} is not allowed; it must be a list of {what}, or a mapping")
    if not value:
        raise wrong(f"the list is empty; name at least one of {what}")
    return _each_once(value)


def _scenarios(value: object) -> dict[str, object]:
    """Return what each scenario is: a list of disturbances, or None for the cell's own."""
    if isinstance(value, dict):
        if not value:
            raise wrong("the mapping is empty; name at least one scenario")
        return value
    return dict.fromkeys(_names(value, "scenarios"))


def _policies(value: object) -> dict[str, object]:
    """Return what each policy is: its name, or a mapping of what it is."""
    if isinstance(value, dict):
        return value
    return {name: name for name in _names(value, "policies")}


def _parameters(value: object) -> dict[str, object]:
    """Return a mapping of paths."""
    if isinstance(value, dict):
        return value
    raise wrong(
        f"{as_read(value)} is not allowed; it must be a mapping of paths in the cell to lists of "
        "values"
    )


class StudyEntry(Entry):
    """Scenarios, policies, parameters and seeds, of which every combination is simulated."""

    version: Literal[1] = Field(alias="dwell-study", description="Version of this format.")
    name: str | None = optional("Name of the study; default: the file's.")
    cell: str = Field(description="The cell file, relative to this file's folder.")
    traces: str | None = optional(
        "Folder where the cell's trace files are, relative to this file's; default: the cell's.",
        min_length=1,
    )
    scenarios: Annotated[dict[str, object], _Read(_scenarios)] | None = optional(
        "Scenarios of the cell, or a mapping of names to disturbances; default: all of the cell's."
    )
    windows: Annotated[int, Number(WINDOWS)] | None = optional(
        "Length of every run, the warm-up included; default 300."
    )
    seeds: Annotated[tuple[int, ...], _Read(_seeds)] | None = optional(
        "A number of seeds, or which; default 20."
    )
    references: bool | None = optional(
        "Whether to play the references in hindsight as well; default false."
    )
    policies: Annotated[dict[str, object], _Read(_policies)] = Field(
        description="Policies and candidates, or a mapping of names to what they are."
    )
    parameters: Annotated[dict[str, object], _Read(_parameters)] | None = optional(
        "Values by their path in the cell; every combination is a point."
    )
    zip: list[list[str]] | None = optional(
        "Groups of parameters whose values go together, the first with the first; default: none."
    )
    labels: dict[str, Annotated[str, Field(min_length=1)]] | None = optional(
        "Names of parameters in figures and tables, by their paths; default: the paths."
    )


def _own_scenario(steps: tuple[Step, ...]) -> bool:
    """Nothing given for a scenario means the cell's own."""
    return len(steps) == 2 and steps[0] == "scenarios"


STUDY: Form[StudyEntry] = Form(
    StudyEntry,
    "study",
    "dwell-study",
    VERSION,
    # What is at fault is replaced by these, which must therefore be valid here.
    sections={"dwell-study": VERSION, "cell": "", "policies": {}},
    may_be_empty=_own_scenario,
)
