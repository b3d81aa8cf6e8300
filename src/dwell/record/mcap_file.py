"""MCAP files of a run's rows, as Foxglove, PlotJuggler and others open them.

A table is a topic, a row a JSON message of it, with the JSON Schema of the table's columns
(`dwell.record.schema.json_schema`). A cycle stands at its release, a window at its close, a
decision at the close that it was made at, a job where it became ready; in a simulated run in ns
since its beginning, in a live one by time of day, so that it lies beside whatever else was recorded
of the robot. The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import heapq
import json
import math
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from operator import itemgetter
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

from mcap.writer import Writer

from dwell.model import Problem
from dwell.record.schema import Values, json_schema

if TYPE_CHECKING:
    from pathlib import Path

    import polars as pl

    from dwell.record.run import Run

#: Bytes of messages that are compressed together.
CHUNK_BYTES = 1 << 20
#: Most bytes beside the content: of a message, with its place in an index; of a chunk, with its
#: place in the summary; and of a summary, beside the schemas.
MESSAGE_BYTES, INDEX_BYTES, SUMMARY_BYTES = 64, 512, 1 << 16
#: Name of the record that says what the file is of, and of all schemas before a dot.
NAMESPACE = "dwell"
#: What a run says of itself that stands there.
ABOUT = ("kind", "scenario", "policy", "estimator", "seed")
#: Column of a row's instant.
AT = "at_ns"
#: How instants count.
SINCE_BEGINNING, TIME_OF_DAY = "ns since the beginning of the run", "ns since 1970, UTC"

#: Instant, ns; table; values of a row.
Message: TypeAlias = tuple[int, str, Values]

_encode = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode


class McapFile:
    """Writes rows to an MCAP file.

    The disk's space is taken before it is needed: where it has no room for a row and what follows
    the last one, the row is refused, and the file can be finished with all rows before.

    Parameters
    ----------
    file : binary file
        Empty, open for writing.
    columns : mapping of str to collection of str
        By table: the columns that its rows have.
    """

    def __init__(
        self, file: BinaryIO, problem: Problem, columns: Mapping[str, Collection[str]]
    ) -> None:
        self._file = file
        # Chunks end where this class ends them, so that it knows what is still to be written.
        self._writer = Writer(file, chunk_size=sys.maxsize)
        schemas = {
            table: _encode(json_schema(table, problem, of)).encode()
            for table, of in columns.items()
        }
        self._unwritten = sum(map(len, schemas.values())) + SUMMARY_BYTES
        self._ending = self._unwritten
        self._written = self._reserved = self._rows = 0
        self._reserve(0)
        self._writer.start()
        self._channels = {
            table: self._writer.register_channel(
                f"/{table}",
                "json",
                self._writer.register_schema(f"{NAMESPACE}.{table}", "jsonschema", schema),
            )
            for table, schema in schemas.items()
        }

    def __repr__(self) -> str:
        return f"<McapFile of {', '.join(self._channels)}>"

    def add(self, *messages: Message) -> None:
        """Write rows: all of them, or none.

        Raises
        ------
        OSError
            If there is no room for them.
        """
        texts = [_text(values) for _, _, values in messages]
        self._reserve(sum(len(text) + MESSAGE_BYTES for text in texts))
        for (at_ns, table, _), text in zip(messages, texts, strict=True):
            self._writer.add_message(self._channels[table], at_ns, text, at_ns)
        self._rows += len(texts)
        if self._unwritten >= CHUNK_BYTES:
            self.flush()

    def _reserve(self, more_bytes: int) -> None:
        """Take the disk's space for what is to be written, and as much again for what follows."""
        unwritten = self._unwritten + more_bytes
        needed = self._written + unwritten + self._ending
        if needed > self._reserved:
            os.posix_fallocate(self._file.fileno(), 0, needed + CHUNK_BYTES)
            self._reserved = needed + CHUNK_BYTES
        self._unwritten = unwritten

    def flush(self) -> None:
        """Hand all rows to the operating system, compressed together."""
        if not self._rows:
            return
        self._writer.flush()
        self._written, self._unwritten, self._rows = self._file.tell(), 0, 0
        self._ending += INDEX_BYTES

    def finish(self, about: Mapping[str, object]) -> None:
        """Write what makes the file whole.

        Parameters
        ----------
        about : mapping
            What the file is of, for its metadata.
        """
        self.flush()
        self._writer.add_metadata(NAMESPACE, {name: str(value) for name, value in about.items()})
        self._writer.finish()
        self._file.flush()
        self._file.truncate(self._file.tell())


def _text(values: Values) -> bytes:
    """Return a row as JSON, without what that has no word for: nulls, NaN and infinities."""
    known = {
        name: value
        for name, value in values.items()
        if value is not None and not (isinstance(value, float) and not math.isfinite(value))
    }
    return _encode(known).encode()


def write_mcap(run: Run, path: Path) -> None:
    """Write a run to an MCAP file.

    Parameters
    ----------
    path : Path
        An empty file, as `dwell.files.write_whole` gives one.

    Raises
    ------
    RunError
        If the run's record of its cell is incomplete.
    OSError
        If there is no room for it.
    """
    origin_ns, tables = _instants(run)
    clock = SINCE_BEGINNING if origin_ns is None else TIME_OF_DAY
    with path.open("r+b") as file:
        made = McapFile(file, run.problem, {name: rows.columns for name, rows in tables.items()})
        rows = [_messages(name, of, origin_ns or 0) for name, of in tables.items()]
        for message in heapq.merge(*rows, key=itemgetter(0)):
            made.add(message)
        told = {name: run.meta.get(name) for name in ABOUT}
        made.finish({"cell": run.problem.name, **told, "clock": clock})


def _instants(run: Run) -> tuple[int | None, dict[str, pl.DataFrame]]:
    """Return the time of day of a live run's beginning, and its tables with an instant a row."""
    import polars as pl

    problem = run.problem
    pipeline, grace_ms = problem.pipeline, problem.controller.close_grace_ms
    after_ns = round(max(pipeline.period_ms + grace_ms, pipeline.deadline_ms) * 1e6)
    releases = run.cycles.select("cycle", (pl.col("release_ns") + after_ns).alias(AT))
    windows = run.windows.with_columns(cycle=pl.col("first_cycle") + problem.window_cycles - 1)
    # A cycle whose row was lost is stood for by the one before.
    windows = windows.join_asof(releases, on="cycle").drop("cycle")
    closes = windows.select("window", AT)
    tables = {
        "cycles": run.cycles.with_columns(pl.col("release_ns").alias(AT)),
        "windows": windows,
        "decisions": run.decisions.sort("last_cycle").join_asof(
            releases.rename({"cycle": "last_cycle"}), on="last_cycle"
        ),
    }
    if run.has_jobs:
        tables["jobs"] = run.jobs.with_columns(pl.col("ready_ns").alias(AT))
    if run.has_processes:
        tables["processes"] = run.processes.sort("window").join_asof(closes, on="window")
    origins = windows.select(pl.col("^closed_unix_ns$") - pl.col(AT)).drop_nulls()
    if origins.is_empty():
        return None, tables
    # A clock that was put right meanwhile, and a close that came late, move the middle one least.
    return origins.to_series().sort()[len(origins) // 2], tables


def _messages(table: str, rows: pl.DataFrame, origin_ns: int) -> Iterator[Message]:
    import polars as pl

    # Before the first close there is no instant, and before 1970 none can be written.
    instants = (pl.col(AT).fill_null(0) + origin_ns).clip(0)
    for row in rows.with_columns(instants).sort(AT, maintain_order=True).iter_rows(named=True):
        yield row.pop(AT), table, row
