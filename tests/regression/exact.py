"""Long runs, to the last bit: what a change of the engine must leave as it is.

`python -m tests.regression exact FILE` plays `cases` (see `runs`) of all examples, 300 windows
each, and writes a line a run: its case, and a digest of every value of its tables. Two files of two
versions of the code are equal where all their values are. It takes minutes, and computers may
differ in last bits, so that no digest is kept here.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import polars as pl

import dwell
from tests.regression.runs import EXAMPLES, Case, cases, load

WINDOWS = 300
TABLES = ("cycles", "windows", "decisions")
#: Every job's instants are kept, too, in one run of so many.
JOBS_EVERY = 7


def lines() -> Iterator[str]:
    """Yield a line a run: example, case, and the digest of its tables."""
    todo = [
        (number, example, case)
        for number, (example, case) in enumerate(
            (example, case) for example in EXAMPLES for case in cases(load(example))
        )
    ]
    with ProcessPoolExecutor() as pool:
        for (_, example, case), found in zip(todo, pool.map(_played, todo), strict=True):
            yield ",".join((example, *case, found))


def _played(item: tuple[int, str, Case]) -> str:
    number, example, case = item
    jobs = number % JOBS_EVERY == 0
    run = dwell.simulate(
        load(example),
        scenario=case.scenario,
        policy=case.policy,
        estimator=case.estimator,
        seed=int(case.seed),
        windows=WINDOWS,
        guard=case.guard == "yes",
        jobs=jobs,
    )
    found = hashlib.sha256()
    for name in (*TABLES, "jobs") if jobs else TABLES:
        table: pl.DataFrame = getattr(run, name)
        for column in table.iter_columns():
            found.update(f"{name}.{column.name} {column.dtype} {len(column)}\n".encode())
            found.update(_bytes(column))
    return found.hexdigest()[:16]


def _bytes(column: pl.Series) -> bytes:
    """Return every value of a column, and which are null."""
    null = column.is_null()
    if column.dtype == pl.String:
        values = "\n".join(column.fill_null("")).encode()
    else:
        physical = column.to_physical()
        values = (
            physical.fill_null(0 if physical.dtype != pl.Boolean else False).to_numpy().tobytes()
        )
    return values + (null.to_numpy().tobytes() if null.any() else b"")


def write(file: Path) -> str:
    """Write a line a run into a file; returns the digest of all."""
    found = hashlib.sha256()
    with file.open("w", encoding="utf-8") as out:
        for count, line in enumerate(lines(), 1):
            out.write(line + "\n")
            found.update(line.encode())
            if sys.stderr.isatty():
                print(f"\r{count} runs", end="", file=sys.stderr)
    return found.hexdigest()
