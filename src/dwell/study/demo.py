"""The demo: the scenarios of a cell, its static placements and the policies, on twenty seeds.

Either on the canonical cell, or on the cells that replay measurements. The cells are files in the
repository's folder of examples; the measurements are not part of it.
"""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from dwell.errors import ProblemError, TraceError
from dwell.model import Problem
from dwell.model.controller_settings import AUTO
from dwell.model.progress import Progress
from dwell.study.comparison import Comparison, compare
from dwell.study.runner import StudyResult, run_study
from dwell.study.study import Contender, load_study

if TYPE_CHECKING:
    import polars as pl

#: The defaults of the settings for which the cells have the paper's.
USUAL = {
    "controller.decide_cycles": None,
    "controller.min_dwell": None,
    "controller.shadow_fraction": AUTO,
}
#: Policies with every candidate as a static placement. The cells have the paper's settings.
POLICIES = (
    "atp",
    Contender("DTP as printed", "dtp"),
    Contender("dtp, no caps", "dtp", settings={"objective.caps": {}}),
    "latency-first",
    Contender("DTP", "dtp", "corrected", USUAL),
    Contender("cusum+corrected", "cusum", "corrected"),
)
SEEDS = 20
WINDOWS = 150

#: Cells by the names of their files in the folder of examples.
CANONICAL = "canonical.yaml"
REAL = ("real.yaml", "real-5g.yaml")
#: Study of the assumption that decides the demo's answer, in the same folder.
TENANTS = "studies/tenants.yaml"
#: What `make deadlines` kept of the study of periods and perception times beside it.
DEADLINES = "studies/deadline.csv"

Folder: TypeAlias = "str | os.PathLike[str]"


def canonical_demo(
    examples: Folder,
    *,
    seeds: int = SEEDS,
    windows: int = WINDOWS,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare the policies on the canonical cell, in all of its scenarios.

    Parameters
    ----------
    examples : path-like
        Folder with `CANONICAL`.
    seeds : int
        Number of seeds: 1 to this.
    windows, processes, progress
        See `dwell.study.compare`.

    Raises
    ------
    ProblemError
        If the cell is missing or wrong.
    """
    from dwell.cellfile import load

    problem = load(Path(examples) / CANONICAL)
    return _compare_all([problem], seeds, windows, processes, progress)[0]


def tenants_demo(
    examples: Folder,
    *,
    seeds: int = SEEDS,
    windows: int = WINDOWS,
    processes: int | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Play the canonical cell with other shares of the edge taken by its tenants.

    Parameters
    ----------
    examples, seeds, windows, processes, progress
        See `canonical_demo`; the folder has `TENANTS`.

    Raises
    ------
    ProblemError
        If the study is missing or wrong.
    """
    study = load_study(Path(examples) / TENANTS)
    study = replace(study, seeds=tuple(range(1, seeds + 1)), windows=windows)
    return run_study(study, processes=processes, progress=progress)


def stored_deadlines(examples: Folder) -> pl.DataFrame:
    """Return V_D over P = D and perception's time on R1, as `make deadlines` played it.

    Returns
    -------
    DataFrame
        One row a scenario, policy and point, as the figure of the study's report has them:
        ``scenario``, ``policy``, ``at`` (P = D, ms), ``mean``, ``low``, ``high`` (%), ``panel``.

    Raises
    ------
    ProblemError
        If the file is missing.
    """
    import polars as pl

    file = Path(examples) / DEADLINES
    if not file.is_file():
        raise ProblemError(f"{file} is missing; `make deadlines` plays it again")
    return pl.read_csv(file)


def real_demo(
    examples: Folder,
    traces: Folder,
    *,
    seeds: int = SEEDS,
    windows: int = WINDOWS,
    processes: int | None = None,
    progress: Progress | None = None,
) -> tuple[Comparison, ...]:
    """Compare the policies on the cells that replay measurements.

    Parameters
    ----------
    examples : path-like
        Folder with the cells of `REAL`.
    traces : path-like
        Folder with the measurements that they name.
    seeds, windows, processes, progress
        See `canonical_demo`. A seed chooses where in the measurements replay starts; fewer windows
        are played where a trace that does not wrap is too short for them; progress counts the runs
        of all cells.

    Returns
    -------
    tuple of Comparison
        One a cell of `REAL`.

    Raises
    ------
    ProblemError
        If a cell is missing or wrong; a TraceError where a trace is.
    """
    from dwell.cellfile import load

    problems = [load(Path(examples) / name, traces=traces) for name in REAL]
    return _compare_all(problems, seeds, windows, processes, progress)


def longest_run(problem: Problem, windows: int) -> int:
    """Return `windows`, or how many the problem's traces last for where those are fewer.

    Raises
    ------
    TraceError
        If they do not last for a single window after the warm-up.
    """
    from dwell.sim import draw

    def too_many(length: int) -> bool:
        try:
            for scenario in problem.scenarios:
                draw(problem, scenario=scenario, seed=0, windows=length)
        except TraceError:
            # Not even the shortest run is possible.
            if length == lengths[0]:
                raise
            return True
        return False

    lengths = range(problem.warmup_windows + 1, windows + 1)
    enough = len(lengths)
    if lengths and too_many(windows):
        enough = bisect_left(lengths, True, key=too_many)
    return problem.warmup_windows + enough


def _compare_all(
    problems: Sequence[Problem],
    seeds: int,
    windows: int,
    processes: int | None,
    progress: Progress | None,
) -> tuple[Comparison, ...]:
    """Compare on one problem after another, counting the runs of all together."""
    policies: list[list[str | Contender]]
    policies = [[*problem.candidates, *POLICIES] for problem in problems]
    pairs = zip(problems, policies, strict=True)
    sizes = [len(problem.scenarios) * len(those) * seeds for problem, those in pairs]

    def count(before: int, done: int, _: int) -> None:
        if progress is not None:
            progress(before + done, sum(sizes))

    return tuple(
        compare(
            problem,
            policies=policies[index],
            seeds=range(1, seeds + 1),
            windows=longest_run(problem, windows),
            processes=processes,
            progress=partial(count, sum(sizes[:index])),
        )
        for index, problem in enumerate(problems)
    )
