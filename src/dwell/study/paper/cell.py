"""The cell of the paper's studies: the canonical one, with the dynamic scenarios beside its own."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias

from dwell.model import Problem
from dwell.study.study import load_study

__all__ = [
    "DYNAMIC",
    "RANDOM",
    "STEADY",
    "TIMETABLE",
    "by_length",
    "dynamic_scenarios",
    "paper_problem",
    "present",
    "steady_scenarios",
]

Folder: TypeAlias = "str | os.PathLike[str]"

#: One placement is best from the first cycle to the last.
STEADY = (
    "baseline",
    "robot-cpu-stress",
    "edge-cpu-stress",
    "network-impairment",
    "network-impairment-mild",
)
#: The best placement changes while the run goes on, by a timetable of 300 windows.
TIMETABLE = ("step", "drift")
#: It changes at random, from the begin of a run to its end, however long that is.
RANDOM = ("bursts", "flapping", "mixture")
DYNAMIC = (*TIMETABLE, *RANDOM)

#: The study that declares them, in the folder of examples.
STUDY = Path("studies", "dynamic.yaml")


def paper_problem(examples: Folder) -> Problem:
    """Read the canonical cell and put the dynamic scenarios into it.

    Parameters
    ----------
    examples : path-like
        Folder with the example cells and their studies.

    Raises
    ------
    ProblemError
        If the cell or the study is missing or wrong.
    """
    return load_study(Path(examples) / STUDY).points[0].problem


def present(problem: Problem, names: Iterable[str]) -> tuple[str, ...]:
    """Return those scenarios that a problem has."""
    return tuple(name for name in names if name in problem.scenarios)


def steady_scenarios(problem: Problem) -> tuple[str, ...]:
    """Return those of `STEADY` that a problem has."""
    return present(problem, STEADY)


def dynamic_scenarios(problem: Problem) -> tuple[str, ...]:
    """Return those of `DYNAMIC` that a problem has."""
    return present(problem, DYNAMIC)


def by_length(
    problem: Problem, names: Iterable[str], windows: int, timetable_windows: int
) -> list[tuple[str, tuple[str, ...], int]]:
    """Part scenarios by how long their runs have to be; a study has one length.

    Returns
    -------
    list of (str, tuple of str, int)
        What to add to the name of a study, its scenarios (those that the problem has, at least
        one) and the windows of its runs.
    """
    mine = present(problem, names)
    parts = (
        ("", tuple(name for name in mine if name not in TIMETABLE), windows),
        ("-timetable", tuple(name for name in mine if name in TIMETABLE), timetable_windows),
    )
    return [part for part in parts if part[1]]
