"""Run a study: items over processes or a cluster, parts as they are ready, tables at the end.

An item is one realisation, drawn once and played by every contender; it depends on nothing but the
study, its scenario and its seed. Tables are put together from the items in the order of the study.
So they are the same, byte for byte, whoever did the items, in whatever order, and in however many
attempts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from dwell.display import Displayed
from dwell.errors import SimulationError
from dwell.study.over_seeds import over_seeds
from dwell.study.parts import opened
from dwell.study.player import Example, PlayedItem, Player
from dwell.study.software import describe, versions
from dwell.study.study import Item, Study
from dwell.study.summary import latency_grid_ms
from dwell.study.workers import available_processes, spread

if TYPE_CHECKING:
    import polars as pl

__all__ = [
    "PARAMETER",
    "Progress",
    "StudyResult",
    "StudyTables",
    "as_frame",
    "assemble",
    "play",
    "play_in_memory",
    "run_study",
]

Progress: TypeAlias = Callable[[int, int], None]

#: Begin of the columns that hold the values of parameters.
PARAMETER = "parameter."

TABLES = ("runs", "costs", "latencies")
LABELS = ("scenario", "policy", "seed")


@dataclass(frozen=True, slots=True)
class StudyTables:
    """The tables of a study (see `StudyResult`)."""

    runs: pl.DataFrame
    costs: pl.DataFrame
    latencies: pl.DataFrame


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult(Displayed):
    """All runs of a study in numbers.

    Parameters
    ----------
    runs : DataFrame
        One row a point, scenario, policy and seed: the values of the point's parameters in columns
        that begin with `PARAMETER`, ``scenario``, ``policy``, ``seed``, and what
        `dwell.study.summary` makes of the run. ``cost`` is J by the objective of the point,
        whatever the settings of the contender. With references, also ``reference_cost``,
        ``best_static``, ``regret``, and ``share_kept`` (see `dwell.study.reference.kept`).
    costs : DataFrame
        One row a run and candidate: mean J ``estimated`` while it was not active, mean J
        ``measured`` while it was, both by the contender's own objective.
    latencies : DataFrame
        Distribution of final latencies over all seeds: ``share`` of the cycles that finished
        within ``latency_ms``, by point, scenario and policy.
    versions : mapping of str to str
        Versions of the software that made the runs, by package.
    folder : Path or None
        Where the tables are.
    """

    study: Study
    runs: pl.DataFrame
    costs: pl.DataFrame
    latencies: pl.DataFrame
    versions: Mapping[str, str]
    folder: Path | None

    def __repr__(self) -> str:
        return f"<StudyResult of {self.study!r}>"

    @property
    def parameters(self) -> tuple[str, ...]:
        """Columns that hold the values of parameters."""
        return tuple(PARAMETER + name for name in self.study.parameters)

    def table(self, columns: Sequence[str] | None = None) -> pl.DataFrame:
        """Return one row a point, scenario and policy: columns over seeds with their intervals.

        Parameters
        ----------
        columns : sequence of str, optional
            Of `runs`; all that hold numbers where None.
        """
        return over_seeds(self.runs, (*self.parameters, "scenario", "policy"), columns)


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
    return StudyResult(
        study=study,
        runs=tables.runs,
        costs=tables.costs,
        latencies=tables.latencies,
        versions=versions(),
        folder=folder,
    )


def play_in_memory(
    player: Player,
    *,
    processes: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> tuple[StudyTables, dict[tuple[Item, int, str], Example]]:
    """Simulate a study and write nothing.

    Parameters
    ----------
    processes, dask, progress
        See `run_study`.

    Returns
    -------
    tables : StudyTables
    examples : dict of (Item, point, policy) to Example
        The runs of the seeds that the player keeps.
    """
    import polars as pl

    items = player.study.items()
    count = _Count(player.study, progress)
    frames: dict[Item, pl.DataFrame] = {}
    examples: dict[tuple[Item, int, str], Example] = {}

    def take(item: Item, played: PlayedItem) -> None:
        frames[item] = as_frame(played)
        examples.update({(item, *key): one for key, one in played.examples.items()})
        count([item])

    play(player, items, processes=processes, dask=dask, take=take)
    return assemble(player.study, pl.concat(frames.values())), examples


def _play_in_folder(
    player: Player,
    folder: Path,
    processes: int | None,
    dask: str | None,
    progress: Progress | None,
) -> StudyTables:
    """Do the items whose parts are missing in a folder, and write the tables of all."""
    study = player.study
    items = study.items()
    count = _Count(study, progress)
    with opened(folder, describe(study), [item.name for item in items]) as parts:

        def take(item: Item, played: PlayedItem) -> None:
            parts.write(item.name, as_frame(played))
            count([item])

        finished = parts.finished()
        count([item for item in items if item.name in finished])
        missing = [item for item in items if item.name not in finished]
        try:
            play(player, missing, processes=processes, dask=dask, take=take)
            # From the files in any case: a study that was stopped makes its tables of the same.
            tables = assemble(study, parts.read([item.name for item in items]))
            for name in TABLES:
                parts.write_table(name, getattr(tables, name))
        except SimulationError as error:
            done = len(parts.finished())
            if not done:
                raise
            raise SimulationError(
                f"{error}\n{done} of {len(items)} items are finished and stay in {folder}: remove "
                "the cause, and run the study again to go on"
            ) from None
    return tables


@dataclass(slots=True)
class _Count:
    """Counts runs as items are done, and tells whoever wants to know."""

    study: Study
    progress: Progress | None
    done: int = 0

    def __call__(self, items: Sequence[Item]) -> None:
        self.done += sum(len(item.points) for item in items) * len(self.study.contenders)
        if self.progress is not None:
            self.progress(self.done, self.study.runs)


def play(
    player: Player,
    items: Sequence[Item],
    *,
    processes: int | None = None,
    dask: str | None = None,
    take: Callable[[Item, PlayedItem], None],
) -> None:
    """Do items, and hand over what came of each.

    Parameters
    ----------
    items : sequence of Item
    processes, dask
        See `run_study`.
    take : callable
        Called in this process with each item and what came of it, as soon as that is ready.
    """
    if not items:
        return
    player.rehearse()
    if dask is None:
        workers = available_processes() if processes is None else processes
        spread(player, items, processes=workers, take=take)
    else:
        from dwell.study.cluster import spread_on_dask

        spread_on_dask(player, items, address=dask, take=take)


def as_frame(played: PlayedItem) -> pl.DataFrame:
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


def assemble(study: Study, frame: pl.DataFrame) -> StudyTables:
    """Put the tables of a study together.

    Parameters
    ----------
    frame : DataFrame
        Those of all items (see `as_frame`), one below the other in any order.
    """
    import polars as pl

    places = {
        "scenario": study.scenarios,
        "policy": study.policies,
        "seed": study.seeds,
    }
    ordered = frame.sort(
        "point",
        *(
            pl.col(column).replace_strict(list(names), list(range(len(names))))
            for column, names in places.items()
        ),
    )
    runs = _with_values(study, ordered.drop("costs", "within"))
    costs = ordered.select("point", *LABELS, "costs").explode("costs").unnest("costs")
    return StudyTables(
        runs=runs,
        costs=_with_values(study, costs).with_columns(pl.selectors.float().fill_nan(None)),
        latencies=_with_values(study, _latencies(study, ordered)),
    )


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
