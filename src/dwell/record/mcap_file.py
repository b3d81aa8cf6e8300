"""MCAP files of a run's rows, for Foxglove, PlotJuggler and other viewers.

Each table becomes a topic, and each row a JSON message with the JSON Schema of the table
(`dwell.record.schema.json_schema`). A cycle has the time of its release, a job the time of its
readiness. A window or decision has the time when its last cycle was due: the later of deadline and
period + grace after the release. Simulated runs count ns from their start. Live runs use the time
of day, which aligns them with other recordings of the robot. The format: https://mcap.dev/spec.
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

#: Size in bytes above which messages are compressed as one chunk.
CHUNK_BYTES = 1 << 20
#: Upper bounds of the overhead in bytes: of a message with its index entry, of a chunk with its
#: summary entry, and of a summary without the schemas.
MESSAGE_BYTES, INDEX_BYTES, SUMMARY_BYTES = 64, 512, 1 << 16
#: Name of the metadata record, and prefix of the schema names.
NAMESPACE = "dwell"
#: Keys of `Run.meta` that the metadata record contains.
ABOUT = ("kind", "scenario", "policy", "estimator", "seed")
#: Column with the time of a row.
AT = "at_ns"
#: Names of the clocks.
SINCE_BEGINNING, TIME_OF_DAY = "ns since the beginning of the run", "ns since 1970, UTC"

#: Time (ns), table, and values of a row.
Message: TypeAlias = tuple[int, str, Values]

_encode = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode


class McapFile:
    """Writer of rows to an MCAP file.

    Disk space is reserved in advance, for each row and for the end of the file. If the disk is
    full, `add` raises, and the file can still be finished with all earlier rows.

    Parameters
    ----------
    file : binary file
        Empty, open for writing.
    columns : mapping of str to collection of str
        Columns of the rows, by table.
    """

    def __init__(
        self, file: BinaryIO, problem: Problem, columns: Mapping[str, Collection[str]]
    ) -> None:
        self._file = file
        # Only `flush` ends a chunk, because this class counts the unwritten bytes.
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
        """Write all rows; write none if the disk is full.

        Raises
        ------
        OSError
            If the disk is full.
        """
        texts = [_text(values) for _, _, values in messages]
        self._reserve(sum(len(text) + MESSAGE_BYTES for text in texts))
        for (at_ns, table, _), text in zip(messages, texts, strict=True):
            self._writer.add_message(self._channels[table], at_ns, text, at_ns)
        self._rows += len(texts)
        if self._unwritten >= CHUNK_BYTES:
            self.flush()

    def _reserve(self, more_bytes: int) -> None:
        """Reserve disk space for all unwritten bytes and for the end of the file."""
        unwritten = self._unwritten + more_bytes
        needed = self._written + unwritten + self._ending
        if needed > self._reserved:
            os.posix_fallocate(self._file.fileno(), 0, needed + CHUNK_BYTES)
            self._reserved = needed + CHUNK_BYTES
        self._unwritten = unwritten

    def flush(self) -> None:
        """Write all pending rows as one compressed chunk."""
        if not self._rows:
            return
        self._writer.flush()
        self._written, self._unwritten, self._rows = self._file.tell(), 0, 0
        self._ending += INDEX_BYTES

    def finish(self, about: Mapping[str, object]) -> None:
        """Write the metadata and the summary, and truncate the file to its length."""
        self.flush()
        self._writer.add_metadata(NAMESPACE, {name: str(value) for name, value in about.items()})
        self._writer.finish()
        self._file.flush()
        self._file.truncate(self._file.tell())


def _text(values: Values) -> bytes:
    """Return a row as JSON, without nulls, NaN and infinities."""
    known = {
        name: value
        for name, value in values.items()
        if value is not None and not (isinstance(value, float) and not math.isfinite(value))
    }
    return _encode(known).encode()


def write_mcap(run: Run, path: Path) -> None:
    """Write a run to an empty file.

    Raises
    ------
    RunError
        If the record of the cell is incomplete.
    OSError
        If the disk is full.
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
    """Return the start of a live run (ns since 1970), and the tables with the time of each row."""
    import polars as pl

    problem = run.problem
    pipeline, grace_ms = problem.pipeline, problem.controller.close_grace_ms
    after_ns = round(max(pipeline.period_ms + grace_ms, pipeline.deadline_ms) * 1e6)
    releases = run.cycles.select("cycle", (pl.col("release_ns") + after_ns).alias(AT))
    windows = run.windows.with_columns(cycle=pl.col("first_cycle") + problem.window_cycles - 1)
    # If the row of a window's last cycle was lost, use the last cycle before it.
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
    # The median is robust against late windows and corrections of the clock.
    return origins.to_series().sort()[len(origins) // 2], tables


def _messages(table: str, rows: pl.DataFrame, origin_ns: int) -> Iterator[Message]:
    import polars as pl

    # Use 0 for rows without a time; MCAP has no times before 1970.
    instants = (pl.col(AT).fill_null(0) + origin_ns).clip(0)
    for row in rows.with_columns(instants).sort(AT, maintain_order=True).iter_rows(named=True):
        yield row.pop(AT), table, row
