"""Run a study: items over processes or a cluster, parts as they are ready, tables at the end.

An item is one realisation, drawn once and played by every contender; it depends on nothing but the
study, its scenario and its seed. Tables are put together from the items in the order of the study.
So they are the same, byte for byte, whoever did the items, in whatever order, and in however many
attempts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from dwell.cellfile.work_folder import open_work_folder
from dwell.errors import SimulationError
from dwell.model.progress import Progress
from dwell.study.player import Example, PlayedItem, Player
from dwell.study.results import PARAMETER, StudyRuns
from dwell.study.software import describe, versions
from dwell.study.study import Item, Study
from dwell.study.study_folder import PARTS, STUDY, TABLES, finished, read_parts, write_table
from dwell.study.summary import latency_grid_ms
from dwell.study.workers import available_processes, require_importable, spread

if TYPE_CHECKING:
    import polars as pl

#: By their names, see `TABLES`.
Tables: TypeAlias = "dict[str, pl.DataFrame]"

LABELS = ("scenario", "policy", "seed")


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class StudyResult(StudyRuns):
    """All runs of a study in numbers, and the study.

    Parameters
    ----------
    folder : Path or None
        Where the tables are.
    """

    study: Study
    folder: Path | None


def run_study(
    study: Study,
    *,
    folder: Path | None = None,
    processes: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Simulate a study, or what is left to do of it.

    Parameters
    ----------
    folder : Path, optional
        Where a part for each finished item and the tables go (``runs.parquet``, ``costs.parquet``,
        ``latencies.parquet``); a study that was stopped there goes on. Nothing is written where
        None.
    processes : int, optional
        Over which the items are spread; one a CPU where None (see `dwell.study.workers`).
    dask : str, optional
        Address of a Dask scheduler, whose workers do the items instead.
    progress : callable, optional
        Called with the number of runs done and of all runs after each item; in a folder also at
        the begin, with what is done already.

    Raises
    ------
    ProblemError, PolicyError, TraceError
        If something named is unknown, or a trace is too short.
    RunError
        If the folder holds something else than this study, or another process works on it.
    SimulationError
        If the folder cannot be written, a worker ended early, or the cluster is out of reach. The
        items that are finished stay.
    """
    player = Player(study)
    if folder is None:
        tables, _ = play_in_memory(player, processes=processes, dask=dask, progress=progress)
    else:
        tables = _play_in_folder(player, folder, processes, dask, progress)
    return StudyResult(**results_of(study, tables), study=study, folder=folder)


def results_of(study: Study, tables: Tables) -> dict[str, Any]:
    """Return what all results of a study have: its plan, tables, and versions of the software."""
    names = ("name", "scenarios", "policies", "seeds", "windows", "labels")
    plan = {name: getattr(study, name) for name in names}
    return {**plan, **tables, "problem": study.points[0].problem, "versions": versions()}


def play_in_memory(
    player: Player,
    *,
    processes: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> tuple[Tables, dict[tuple[Item, int, str], Example]]:
    """Simulate a study and write nothing.

    Returns
    -------
    tables : dict of str to DataFrame
        See `StudyRuns`.
    examples : dict of (Item, point, policy) to Example
        The runs of the seeds that the player keeps.
    """
    import polars as pl

    _prepare(player, player.study.items(), processes, dask)
    count = _counter(player.study, progress)
    frames: list[pl.DataFrame] = []
    examples: dict[tuple[Item, int, str], Example] = {}

    def take(item: Item, played: PlayedItem) -> None:
        frames.append(_frame(played))
        examples.update({(item, *key): one for key, one in played.examples.items()})
        count([item])

    _play(player, player.study.items(), processes, dask, take)
    return _assembled(player.study, pl.concat(frames)), examples


def _play_in_folder(
    player: Player,
    folder: Path,
    processes: int | None,
    dask: str | None,
    progress: Progress | None,
) -> Tables:
    """Do the items whose parts are missing in a folder, and write the tables of all."""
    study = player.study
    items = study.items()
    names = [item.name for item in items]
    count = _counter(study, progress)

    def take(item: Item, played: PlayedItem) -> None:
        write_table(folder, f"{PARTS}/{item.name}", _frame(played))
        count([item])

    _prepare(player, [one for one in items if one.name not in finished(folder)], processes, dask)
    notes = {"labels": dict(study.labels)} if study.labels else {}
    with open_work_folder(folder, STUDY, describe(study), notes):
        known = finished(folder)
        count([item for item in items if item.name in known])
        missing = [item for item in items if item.name not in known]
        try:
            _play(player, missing, processes, dask, take)
            # From the files in any case: a study that was stopped makes its tables of the same.
            tables = _assembled(study, read_parts(folder, names))
            for name, table in tables.items():
                write_table(folder, name, table)
        except SimulationError as error:
            done = len(finished(folder).intersection(names))
            if not done:
                raise
            raise SimulationError(
                f"{error}\n{done} of {len(items)} items are finished and stay in {folder}: remove "
                "the cause, and run the study again to go on"
            ) from None
    return tables


def _counter(study: Study, progress: Progress | None) -> Callable[[Sequence[Item]], None]:
    """Return what counts the runs of items as they are done, and tells `progress`."""
    done = 0

    def count(items: Sequence[Item]) -> None:
        nonlocal done
        done += sum(len(item.points) for item in items) * len(study.contenders)
        if progress is not None:
            progress(done, study.runs)

    return count


def _prepare(
    player: Player, items: Sequence[Item], processes: int | None, dask: str | None
) -> None:
    """Refuse a study that cannot be played before a process or a folder is made for it."""
    if not items:
        return
    if dask is None and min(processes or available_processes(), len(items)) > 1:
        named = {one.name: (one.policy, one.estimator) for one in player.study.contenders}
        require_importable(named)
    player.rehearse()


def _play(
    player: Player,
    items: Sequence[Item],
    processes: int | None,
    dask: str | None,
    take: Callable[[Item, PlayedItem], None],
) -> None:
    """Do items, and hand over what came of each as soon as it is ready."""
    if not items:
        return
    if dask is None:
        spread(player, items, processes=processes or available_processes(), take=take)
    else:
        from dwell.study.cluster import spread_on_dask

        spread_on_dask(player, items, address=dask, take=take)


def _frame(played: PlayedItem) -> pl.DataFrame:
    """Return what came of an item as one row a run.

    Returns
    -------
    DataFrame
        The index of its ``point``, the columns of its row, and as lists its ``costs`` by candidate
        and the cycles ``within`` each point of the latency grid.
    """
    import polars as pl

    rows = [
        {
            "point": point,
            **summary.row,
            "costs": [
                {name: value for name, value in costs.items() if name not in LABELS}
                for costs in summary.costs
            ],
        }
        for point, summary in played.summaries
    ]
    within = np.stack([summary.within for _, summary in played.summaries])
    frame = pl.DataFrame(rows, infer_schema_length=None)
    return frame.with_columns(pl.Series("within", within).arr.to_list())


def _assembled(study: Study, frame: pl.DataFrame) -> Tables:
    """Return the tables of a study, of the rows of all items in any order (see `_frame`)."""
    import polars as pl

    places = zip(LABELS, (study.scenarios, study.policies, study.seeds), strict=True)
    ordered = frame.sort(
        "point",
        *(
            pl.col(column).replace_strict(list(names), list(range(len(names))))
            for column, names in places
        ),
    )
    costs = ordered.select("point", *LABELS, "costs").explode("costs").unnest("costs")
    tables = (
        _with_values(study, ordered.drop("costs", "within")),
        _with_values(study, costs).with_columns(pl.selectors.float().fill_nan(None)),
        _with_values(study, _latencies(study, ordered)),
    )
    return dict(zip(TABLES, tables, strict=True))


def _with_values(study: Study, frame: pl.DataFrame) -> pl.DataFrame:
    """Put the values of parameters in place of the index of a point."""
    import polars as pl

    values = [
        pl.Series(PARAMETER + name, [point.values[name] for point in study.points]).gather(
            frame["point"]
        )
        for name in study.parameters
    ]
    return pl.DataFrame([*values, *frame.drop("point")])


def _latencies(study: Study, ordered: pl.DataFrame) -> pl.DataFrame:
    """Return the distributions of latency over seeds, of runs in the order of the study."""
    import polars as pl

    grids = np.stack(
        [latency_grid_ms(point.problem.pipeline.deadline_ms) for point in study.points]
    )
    seeds, places = len(study.seeds), grids.shape[1]
    within = ordered["within"].explode().to_numpy().reshape(-1, seeds, places).sum(axis=1)
    cycles = ordered["cycles"].to_numpy().reshape(-1, seeds).sum(axis=1)
    groups = ordered.gather_every(seeds).select("point", "scenario", "policy")
    share = within / cycles[:, None]
    return groups[np.repeat(np.arange(len(groups)), places)].with_columns(
        pl.Series("latency_ms", grids[groups["point"].to_numpy()].ravel()),
        pl.Series("share", share.ravel()),
    )
