"""Parts of a study: the runs of one player in a batch of items, each part a Parquet file.

A part's name includes a digest of all inputs of its runs, and the range of its items. A process
writes a part under a temporary name, syncs it to disk, and renames it, so each part is complete.
After an interruption, the items without a part are simulated.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dwell.cellfile.work_folder import unwritable
from dwell.files import write_whole
from dwell.study.player import Batch, PlayedBatch, Player
from dwell.study.study import Study
from dwell.study.summary import Summary

if TYPE_CHECKING:
    import polars as pl

PARTS = "parts"
#: Columns that tell runs apart.
LABELS = ("scenario", "policy", "seed")
#: Runs of a batch at most: enough that a file's fixed size does not count.
BATCH_RUNS = 512
#: Batches per process: all processes end at about the same time.
BATCHES = 4
NAME = re.compile(r"([0-9a-f]{16})-(\d+)-(\d+)\.parquet")


class PartName(NamedTuple):
    """Name of a part: its player's digest, its first item, and the item after its last."""

    digest: str
    first: int
    end: int

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.digest}-{self.first:06d}-{self.end:06d}.parquet"


class Parts:
    """The parts of a study in a folder.

    Parameters
    ----------
    folder : Path
        Folder of the study, or of a shard.
    digests : mapping of str to str
        Digest of all inputs of a player's runs, by player.
    span : range
        Indices of the items of the folder.
    """

    def __init__(self, folder: Path, study: Study, digests: Mapping[str, str], span: range) -> None:
        self.folder, self.study, self.digests, self.span = folder, study, digests, span
        items = study.items()
        self.points = [0, *itertools.accumulate(len(item.points) for item in items)]
        self.look()

    def look(self) -> None:
        """Know the parts that are in the folder, of each player some that share no item."""
        self.known: dict[str, list[PartName]] = {name: [] for name in self.digests}
        players = {digest: name for name, digest in self.digests.items()}
        matches = (NAME.fullmatch(path.name) for path in (self.folder / PARTS).glob("*.parquet"))
        found = [PartName(match[1], int(match[2]), int(match[3])) for match in matches if match]
        for part in sorted(found, key=lambda part: (part.first, -part.end)):
            if part.digest in players:
                known = self.known[players[part.digest]]
                # A worker may outlive its study by a moment, and write what is played again.
                if not known or part.first >= known[-1].end:
                    known.append(part)

    @property
    def total(self) -> int:
        """Number of runs that belong into the folder."""
        points = self.points[self.span.stop] - self.points[self.span.start]
        return points * len(self.study.contenders)

    @property
    def done(self) -> int:
        """Number of finished runs."""
        parts = (part for one in self.study.contenders for part in self.known[one.name])
        return sum(self.points[part.end] - self.points[part.first] for part in parts)

    @property
    def files(self) -> list[Path]:
        """The files of all parts."""
        names = (part.file for parts in self.known.values() for part in parts)
        return [self.folder / PARTS / name for name in names]

    def missing(self, processes: int) -> list[Batch]:
        """Return the items without parts, in batches for some processes."""
        left: dict[int, tuple[str, ...]] = dict.fromkeys(self.span, ())
        for name, parts in self.known.items():
            there = {place for part in parts for place in range(part.first, part.end)}
            left |= {place: (*left[place], name) for place in self.span if place not in there}
        return batches_of(self.study, {place: who for place, who in left.items() if who}, processes)

    def clear(self) -> None:
        """Remove the parts of other versions of a user's own code."""
        for path in {*(self.folder / PARTS).glob("*.parquet")}.difference(self.files):
            path.unlink(missing_ok=True)


def batches_of(study: Study, left: Mapping[int, tuple[str, ...]], processes: int) -> list[Batch]:
    """Return batches of items that follow each other and that the same players have left.

    Parameters
    ----------
    left : mapping of int to tuple of str
        The players of an item that have no part with it, by the item's place, in order.
    processes : int
        How many share the batches.
    """
    items = study.items()
    most = len(study.contenders) * max((len(items[place].points) for place in left), default=1)
    size = max(1, min(-(-len(left) // (BATCHES * processes)), BATCH_RUNS // most))
    # Places that follow each other are as far apart as their numbers in the order.
    stretches = itertools.groupby(
        enumerate(left), lambda numbered: (numbered[1] - numbered[0], left[numbered[1]])
    )
    batches = []
    for (_, players), group in stretches:
        places = [place for _, place in group]
        for begin in range(places[0], places[-1] + 1, size):
            end = min(begin + size, places[-1] + 1)
            batches.append(Batch(begin, items[begin:end], players))
    return batches


def play_and_write(
    player: Player, folder: Path, digests: Mapping[str, str], batch: Batch
) -> PlayedBatch:
    """Simulate a batch in a worker, write its parts, and return the result without summaries.

    Raises
    ------
    SimulationError
        If that fails.
    """
    played = player(batch)
    write_parts(folder, digests, played)
    return replace(played, summaries={})


def write_parts(folder: Path, digests: Mapping[str, str], played: PlayedBatch) -> None:
    """Write a part for each player of a batch.

    Raises
    ------
    SimulationError
        If that fails.
    """
    for name, summaries in played.summaries.items():
        part = PartName(digests[name], played.batch.first, played.batch.end)
        # Statistics of each column would be a third of a small file.
        write_parquet(folder / PARTS / part.file, frame_of(summaries), statistics=False)


def write_parquet(path: Path, frame: pl.DataFrame, *, statistics: bool = True) -> None:
    """Write a table.

    Raises
    ------
    SimulationError
        If that fails.
    """
    # To memory first: how a disk is full is then the system's own answer.
    data = io.BytesIO()
    frame.rechunk().write_parquet(data, statistics=statistics)
    try:
        write_whole(path, data.getvalue())
    except OSError as error:
        raise unwritable(path, error) from None


def frame_of(summaries: Sequence[tuple[int, Summary]]) -> pl.DataFrame:
    """Return runs with the index of their points as one row per run.

    Returns
    -------
    DataFrame
        The index of its ``point``, the columns of its row, what compares it with the references,
        and as lists its ``costs`` by candidate and the cycles ``within`` each point of the latency
        grid.
    """
    import polars as pl

    rows = [
        {
            "point": point,
            **summary.row,
            **summary.compared,
            "costs": [
                {name: value for name, value in costs.items() if name not in LABELS}
                for costs in summary.costs
            ],
        }
        for point, summary in summaries
    ]
    within = np.stack([summary.within for _, summary in summaries])
    frame = pl.DataFrame(rows, infer_schema_length=None)
    return frame.with_columns(pl.Series("within", within).arr.to_list())
