"""A study's folder, read again: what was studied, and the tables of its runs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.cellfile import from_record
from dwell.display import Displayed
from dwell.errors import DwellError, RunError
from dwell.model import Problem
from dwell.study.parts import STUDY
from dwell.study.runner import PARAMETER, StudyResult

if TYPE_CHECKING:
    import polars as pl

__all__ = ["SavedStudy", "is_study", "open_study"]


@dataclass(frozen=True, slots=True, eq=False)
class SavedStudy(Displayed):
    """A finished study, as its folder has it.

    Parameters
    ----------
    problem : Problem
        Of its first point.
    scenarios, policies : tuple of str
    seeds : tuple of int
    windows : int
        Length of every run, the warm-up included.
    parameters : tuple of str
        Columns of `runs` that hold the values of parameters.
    runs, costs, latencies : DataFrame
        See `dwell.study.StudyResult`.
    versions : mapping of str to str
    """

    name: str
    problem: Problem
    scenarios: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    windows: int
    parameters: tuple[str, ...]
    runs: pl.DataFrame
    costs: pl.DataFrame
    latencies: pl.DataFrame
    versions: Mapping[str, str]

    def __repr__(self) -> str:
        return (
            f"<SavedStudy {self.name}: {self.runs.height} runs, {len(self.scenarios)} scenarios, "
            f"{len(self.policies)} policies, {len(self.seeds)} seeds, {self.windows} windows>"
        )

    @classmethod
    def of(cls, result: StudyResult) -> SavedStudy:
        """Return what the folder of a study's result would hold."""
        study = result.study
        return cls(
            name=study.name,
            problem=study.points[0].problem,
            scenarios=study.scenarios,
            policies=study.policies,
            seeds=study.seeds,
            windows=study.windows,
            parameters=result.parameters,
            runs=result.runs,
            costs=result.costs,
            latencies=result.latencies,
            versions=result.versions,
        )


def is_study(folder: Path) -> bool:
    """Whether a folder is a study's."""
    return (folder / STUDY.file).is_file()


def open_study(folder: str | Path) -> SavedStudy:
    """Read the folder of a study that is finished.

    Raises
    ------
    RunError
        If it is none, its runs are not finished, or a file of it cannot be read.
    """
    import polars as pl

    folder = Path(folder)
    path = folder / STUDY.file
    if not path.is_file():
        raise RunError(f"{folder} is no study: there is no {STUDY.file}")
    try:
        known: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        problem = from_record(known["cell"])
        names = tuple(PARAMETER + name for name in known["parameters"])
        scenarios, policies = (tuple(map(str, known[name])) for name in ("scenarios", "policies"))
        seeds = tuple(map(int, known["seeds"]))
        windows = int(known["windows"])
    except (OSError, ValueError, KeyError, TypeError, DwellError) as error:
        raise RunError(f"{path}: cannot be read ({error!r})") from None
    tables = {}
    for name in ("runs", "costs", "latencies"):
        table = folder / f"{name}.parquet"
        if not table.is_file():
            raise RunError(
                f"{folder}: the study is not finished: there is no {table.name}; `dwell study` "
                "with its file goes on with it"
            )
        try:
            tables[name] = pl.read_parquet(table, glob=False)
        except (OSError, pl.exceptions.PolarsError) as error:
            raise RunError(f"{table}: cannot be read ({error})") from None
    software = {name: one for name, one in known.get("software", {}).items() if name != "sources"}
    return SavedStudy(
        name=str(known.get("name", folder.name)),
        problem=problem,
        scenarios=scenarios,
        policies=policies,
        seeds=seeds,
        windows=windows,
        parameters=names,
        runs=tables["runs"],
        costs=tables["costs"],
        latencies=tables["latencies"],
        versions=software,
    )
