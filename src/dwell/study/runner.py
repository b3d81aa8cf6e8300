"""Run a study: batches over processes or a cluster, parts as they are ready, tables at the end.

A run depends only on the study, its scenario, its seed and its contender. So the tables have the
same bytes, however the batches are played: by which process, in which order, in how many attempts.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.cellfile.work_folder import open_work_folder
from dwell.errors import SimulationError
from dwell.model.progress import Progress
from dwell.record.run import read_table
from dwell.study.parts import (
    Parts,
    batches_of,
    frame_of,
    play_and_write,
    write_parquet,
    write_parts,
)
from dwell.study.player import Batch, Example, PlayedBatch, Player
from dwell.study.results import StudyRuns
from dwell.study.software import describe, modules_of, own_sources, part_digests, versions
from dwell.study.study import Item, Study
from dwell.study.study_folder import STUDY, TABLES, Shard
from dwell.study.study_tables import Tables, tables_of
from dwell.study.workers import available_processes, require_importable, spread

if TYPE_CHECKING:
    import polars as pl

#: Processes of a cluster, for the size of batches: it may have more or fewer.
DASK_WORKERS = 64


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
        For the parts and the tables (``runs.parquet``, ``costs.parquet``, ``latencies.parquet``);
        a study that was stopped there continues. If None, the tables stay in memory.
    processes : int, optional
        Over which the batches are spread; one per CPU where None (see `dwell.study.workers`).
    dask : str, optional
        Address of a Dask scheduler, whose workers play the batches instead.
    progress : callable, optional
        Called with the number of runs done and of all runs after each batch; in a folder also
        once before.

    Raises
    ------
    ProblemError, PolicyError, TraceError
        If something named is unknown, or a trace is too short.
    RunError
        If the folder holds something else than this study, or another process works on it.
    SimulationError
        If the folder cannot be written, a worker ended early, or the cluster is out of reach. The
        runs that are finished stay.
    """
    if folder is None:
        tables, _ = play_in_memory(Player(study), processes=processes, dask=dask, progress=progress)
    else:
        require_sendable(study, processes, dask)
        player = Player(study)
        with open_parts(study, folder, player=player) as parts:
            play_parts(parts, player, processes=processes, dask=dask, progress=progress)
            tables = write_tables(parts)
    return StudyResult(**results_of(study, tables), study=study, folder=folder)


def results_of(study: Study, tables: Tables) -> dict[str, Any]:
    """Return what all results of a study have: its plan, tables, and versions of the software."""
    names = ("name", "scenarios", "policies", "seeds", "windows", "labels")
    plan = {name: getattr(study, name) for name in names}
    more = {"metrics": tuple(study.metrics), "versions": versions()}
    return {**plan, **tables, "problem": study.points[0].problem, **more}


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
    study, done = player.study, 0
    frames: list[pl.DataFrame] = []
    examples: dict[tuple[Item, int, str], Example] = {}

    def take(_: Batch, played: PlayedBatch) -> None:
        nonlocal done
        frames.extend(map(frame_of, played.summaries.values()))
        examples.update(played.examples)
        done += len(study.contenders) * sum(len(item.points) for item in played.batch.items)
        if progress is not None:
            progress(done, study.runs)

    workers = _workers(processes, dask)
    everything = dict.fromkeys(range(len(study.items())), study.players)
    require_sendable(study, processes, dask)
    player.rehearse()
    _spread(player, batches_of(study, everything, workers), workers, dask, take)
    return tables_of(study, frames), examples


def require_sendable(study: Study, processes: int | None, dask: str | None) -> None:
    """Refuse objects that worker processes cannot import, if there will be some.

    Raises
    ------
    SimulationError
        If an object does not pickle, or its class is in no module.
    """
    if dask is None and min(_workers(processes, dask), len(study.items())) > 1:
        require_importable({one.name: (one.policy, one.estimator) for one in study.contenders})


@contextmanager
def open_parts(
    study: Study,
    folder: Path,
    shard: Shard | None = None,
    *,
    player: Player | None = None,
) -> Iterator[Parts]:
    """Open the folder of a study, or of a shard, for this process alone.

    Parameters
    ----------
    player : Player, optional
        If runs are missing, it rehearses before the folder is made.

    Raises
    ------
    RunError
        If the folder holds something else than this study, or another process works on it.
    SimulationError
        If it cannot be made or written, or a metric cannot be imported.
    """
    description, sources = describe(study), own_sources(study)
    digests = part_digests(description, sources)
    notes = {
        **({"labels": dict(study.labels)} if study.labels else {}),
        **({"modules": modules} if (modules := modules_of(sources)) else {}),
    }
    span = range(len(study.items()))
    if shard is not None:
        span, description = shard.span(len(span)), {**description, "shard": [*shard]}
    parts = Parts(folder, study, digests, span)
    if player is not None and parts.done < parts.total:
        player.rehearse()
    with open_work_folder(folder, STUDY, description, notes):
        parts.look()
        try:
            yield parts
        except SimulationError as error:
            # This process may not know yet what the others have written.
            parts.look()
            if not parts.done:
                raise
            raise SimulationError(
                f"{error}\n{parts.done} of {parts.total} runs are finished and stay in {folder}: "
                "remove the cause, and run the same command again"
            ) from None


def play_parts(
    parts: Parts,
    player: Player,
    *,
    processes: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Play what a folder misses; see `run_study`."""
    folder, workers = parts.folder, _workers(processes, dask)
    missing = parts.missing(workers)

    def look() -> None:
        parts.look()
        if progress is not None:
            progress(parts.done, parts.total)

    def take(_: Batch, played: PlayedBatch) -> None:
        write_parts(folder, parts.digests, played)
        look()

    look()
    if not missing:
        return
    for name in TABLES:
        (folder / f"{name}.parquet").unlink(missing_ok=True)
    # Workers of a cluster have no file system in common.
    writer = partial(play_and_write, player, folder, parts.digests)
    task = writer if dask is None else player
    try:
        _spread(task, missing, workers, dask, take)
    except KeyboardInterrupt:
        # Workers have finished the batches that they had begun.
        look()
        raise
    parts.clear()


def write_tables(parts: Parts) -> Tables:
    """Write the tables of a study whose parts are all there.

    Raises
    ------
    RunError
        If a part cannot be read.
    SimulationError
        If a table cannot be written.
    """
    # From the files in any case: a study that was stopped makes its tables of the same.
    remedy = "; remove it and run the study again"
    tables = tables_of(parts.study, (read_table(file, remedy)() for file in parts.files))
    for name, table in tables.items():
        write_parquet(parts.folder / f"{name}.parquet", table)
    return tables


def _workers(processes: int | None, dask: str | None) -> int:
    """Return how many processes share the work; of a cluster, a guess."""
    if dask is not None:
        return DASK_WORKERS
    return available_processes() if processes is None else processes


def _spread(
    task: Callable[[Batch], PlayedBatch],
    batches: Sequence[Batch],
    processes: int,
    dask: str | None,
    take: Callable[[Batch, PlayedBatch], None],
) -> None:
    """Play batches, and hand over each result as soon as it is ready."""
    rest = operator.attrgetter("rest")
    if dask is None:
        spread(task, batches, processes=processes, take=take, rest=rest)
    else:
        from dwell.study.cluster import spread_on_dask

        spread_on_dask(task, batches, address=dask, take=take, rest=rest)
