"""Shards: parts of a study, simulated separately (for example on several computers) and merged.

A shard has its own folder in the folder of its study, such as ``shards/2-of-4``.
"""

from __future__ import annotations

from pathlib import Path

from dwell.errors import RunError
from dwell.files import write_whole
from dwell.model.progress import Progress
from dwell.record.json_documents import read_document
from dwell.study.parts import PARTS
from dwell.study.player import Player
from dwell.study.runner import (
    StudyResult,
    open_parts,
    play_parts,
    require_sendable,
    results_of,
    write_tables,
)
from dwell.study.software import modules_of, own_sources
from dwell.study.study import Study
from dwell.study.study_folder import SHARDS, STUDY, Shard


def run_shard(
    study: Study,
    shard: Shard,
    *,
    folder: Path,
    processes: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> int:
    """Simulate the missing runs of a shard, and return the shard's number of runs.

    Parameters
    ----------
    folder : Path
        Folder of the study; it will contain the shard's folder.
    processes, dask, progress
        See `dwell.study.run_study`, also for the exceptions.
    """
    require_sendable(study, processes, dask)
    player = Player(study)
    with open_parts(study, shard.folder(folder), shard, player=player) as parts:
        play_parts(parts, player, processes=processes, dask=dask, progress=progress)
        return parts.total


def merge_shards(study: Study, folder: Path) -> StudyResult:
    """Merge the shards of a study in its folder, and write its tables.

    Parameters
    ----------
    folder : Path
        Folder of the study, with all its shards.

    Raises
    ------
    RunError
        If a shard is missing, duplicate or unfinished, or belongs to another study or version.
    SimulationError
        If the folder cannot be written.
    """
    files, modules = [], modules_of(own_sources(study))
    for shard, place in _complete(study, folder).items():
        there = read_document(place / STUDY.file).get("modules", {})
        changed = [name for name, digest in modules.items() if there.get(name) != digest]
        if changed:
            raise RunError(
                f"{place} was played with another source of {changed[0]}; play it again with "
                f"`--shard {shard}`"
            )
        with open_parts(study, place, shard) as parts:
            if parts.missing(1):
                raise RunError(
                    f"{place} is not finished: {parts.done} of {parts.total} runs are there; play "
                    f"the rest with `--shard {shard}`"
                )
            files += parts.files
    with open_parts(study, folder) as parts:
        for old in parts.files:
            old.unlink()
        for file in files:
            write_whole(folder / PARTS / file.name, file.read_bytes())
        parts.look()
        tables = write_tables(parts)
    return StudyResult(**results_of(study, tables), study=study, folder=folder)


def _complete(study: Study, folder: Path) -> dict[Shard, Path]:
    """Return the folders of the shards; refuse duplicate and missing items with a RunError."""
    items, of, found = len(study.items()), 1, {}
    places: dict[int, Path] = {}
    for file in sorted((folder / SHARDS).glob(f"*/{STUDY.file}")):
        named, place = read_document(file).get("shard"), file.parent
        if not isinstance(named, list):
            raise RunError(f"{place} does not hold a shard of a study; remove it")
        shard = Shard(*named)
        for item in shard.span(items):
            if places.setdefault(item, place) != place:
                raise RunError(f"{places[item]} and {place} hold the same runs; remove one of them")
        found[shard], of = place, max(of, shard.of)
    if not found:
        raise RunError(f"{folder / SHARDS} holds no shard; play each of them with `--shard i/n`")
    absent = {*range(items)}.difference(places)
    shards = (Shard(i + 1, of) for i in range(of))
    missing = [str(one) for one in shards if absent.intersection(one.span(items))]
    if missing:
        raise RunError(
            f"{folder / SHARDS}: missing shard {', '.join(missing)} of the study; play it with "
            f"`--shard {missing[0]}`, or copy its folder there"
        )
    return found
