"""Run a study: simulate batches in processes or on a cluster, save parts, write tables at the end.

A run depends only on the study, its scenario, its seed and its contender. The tables therefore have
the same bytes for every number of processes, order of batches and number of attempts.
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

#: Assumed number of processes of a cluster, for the size of batches.
DASK_WORKERS = 64


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class StudyResult(StudyRuns):
    """All runs of a study in numbers, and the study.

    Parameters
    ----------
    folder : Path or None
        Folder of the tables; None if they are only in memory.
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
    """Simulate a study, or the missing runs of a study in a folder.

    Parameters
    ----------
    folder : Path, optional
        Folder for the parts and the tables (``runs.parquet``, ``costs.parquet``,
        ``latencies.parquet``). An interrupted study in it continues. If None, the tables stay in
        memory.
    processes : int, optional
        Number of worker processes. Default: one per CPU (see `dwell.study.workers`).
    dask : str, optional
        Address of a Dask scheduler; its workers replace the processes.
    progress : callable, optional
        Called with the number of finished runs and the number of all runs after each batch; with
        a folder also once at the start.

    Raises
    ------
    ProblemError, PolicyError, TraceError
        If a name is unknown, or a trace is too short.
    RunError
        If the folder contains another study, or another process works on it.
    SimulationError
        If the folder cannot be written, a worker ended early, or the cluster cannot be reached.
        Finished runs in the folder are kept.
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
    """Return the fields common to all results: plan, tables, and versions of the software."""
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
    """Simulate a study in memory; return its tables and the example runs that the player keeps."""
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
    """Refuse objects that local worker processes cannot import.

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
    """Open the folder of a study or shard, with a lock against other processes.

    Parameters
    ----------
    player : Player, optional
        If runs are missing, it rehearses before the folder is created.

    Raises
    ------
    RunError
        If the folder contains another study, or another process works on it.
    SimulationError
        If the folder cannot be created or written, or a metric cannot be imported.
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
            # Worker processes may have written parts since the last look.
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
    """Simulate the missing runs of a folder; see `run_study`."""
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
    # Workers of a cluster may not share a file system: this process writes their parts.
    writer = partial(play_and_write, player, folder, parts.digests)
    task = writer if dask is None else player
    try:
        _spread(task, missing, workers, dask, take)
    except KeyboardInterrupt:
        # The workers have finished their current batches.
        look()
        raise
    parts.clear()


def write_tables(parts: Parts) -> Tables:
    """Write the tables of a study from its complete set of parts.

    Raises
    ------
    RunError
        If a part cannot be read.
    SimulationError
        If a table cannot be written.
    """
    # Always from the files: an interrupted study gives the same tables.
    remedy = "; remove it and run the study again"
    tables = tables_of(parts.study, (read_table(file, remedy)() for file in parts.files))
    for name, table in tables.items():
        write_parquet(parts.folder / f"{name}.parquet", table)
    return tables


def _workers(processes: int | None, dask: str | None) -> int:
    """Return the number of processes that share the work; for a cluster, a guess."""
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
    """Simulate batches, and call `take` with each result as soon as it is ready."""
    rest = operator.attrgetter("rest")
    if dask is None:
        spread(task, batches, processes=processes, take=take, rest=rest)
    else:
        from dwell.study.cluster import spread_on_dask

        spread_on_dask(task, batches, address=dask, take=take, rest=rest)
