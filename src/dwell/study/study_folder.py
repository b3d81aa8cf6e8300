"""The folder of a study: ``study.json``, which describes it, its parts, its shards, its tables."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from dwell.cellfile import from_record
from dwell.cellfile.forms import not_allowed
from dwell.cellfile.work_folder import FolderMark
from dwell.errors import DwellError, Fault, ProblemError, RunError
from dwell.record.json_documents import read_document
from dwell.record.run import read_table
from dwell.study.parts import PARTS
from dwell.study.results import StudyRuns

#: Folders of shards, by their names.
SHARDS = "shards"
STUDY = FolderMark("study", "study.json", 2, (PARTS, SHARDS))
#: Tables of a finished study, each a Parquet file.
TABLES = ("runs", "costs", "latencies")


class Shard(NamedTuple):
    """The i-th of n shards, from 1."""

    place: int
    of: int

    @classmethod
    def read(cls, text: str) -> Shard:
        """Return the shard of ``2/4``.

        Raises
        ------
        ProblemError
            If the text is not i/n with i from 1 to n.
        """
        found = re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", text)
        if found is None or int(found[1]) > int(found[2]):
            raise ProblemError(
                [Fault("shard", not_allowed(text, "i/n with i from 1 to n, as 2/4"))]
            )
        return cls(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.place}/{self.of}"

    def folder(self, study: Path) -> Path:
        """Return its folder in the folder of its study."""
        return study / SHARDS / f"{self.place}-of-{self.of}"

    def span(self, items: int) -> range:
        """Return the places of its items."""
        return range(items * (self.place - 1) // self.of, items * self.place // self.of)


def is_study(folder: Path) -> bool:
    """Whether a folder is a study's."""
    return (folder / STUDY.file).is_file()


def open_study(folder: str | Path) -> StudyRuns:
    """Read the folder of a finished study.

    Raises
    ------
    RunError
        If the folder contains no study, the study is unfinished, or a file cannot be read.
    """
    from dwell.study.results import StudyRuns

    folder = Path(folder)
    path = folder / STUDY.file
    if not is_study(folder):
        raise RunError(f"{folder} is no study: there is no {STUDY.file}")
    known = read_document(path)
    version = known.get(STUDY.key)
    if known and version != STUDY.version:
        raise RunError(
            f"{path}: version {version} of a study's folder, and this Dwell reads {STUDY.version}; "
            "run the study again in another folder"
        )
    try:
        problem = from_record(known["cell"])
        scenarios, policies = (tuple(map(str, known[name])) for name in ("scenarios", "policies"))
        seeds = tuple(map(int, known["seeds"]))
        windows = int(known["windows"])
        metrics = tuple(map(str, known.get("metrics", ())))
        labels = {str(path): str(label) for path, label in known.get("labels", {}).items()}
    except (ValueError, KeyError, TypeError, AttributeError, DwellError) as error:
        raise RunError(f"{path}: cannot be read ({error!r})") from None
    tables = {}
    for name in TABLES:
        table = folder / f"{name}.parquet"
        if not table.is_file():
            raise RunError(
                f"{folder}: the study is not finished: there is no {table.name}; run "
                "`dwell study` with its file again"
            )
        tables[name] = read_table(table)()
    software = {name: one for name, one in known.get("software", {}).items() if name != "sources"}
    return StudyRuns(
        name=str(known.get("name", folder.name)),
        problem=problem,
        scenarios=scenarios,
        policies=policies,
        seeds=seeds,
        windows=windows,
        **tables,
        versions=software,
        labels=labels,
        metrics=metrics,
    )
