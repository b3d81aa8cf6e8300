"""Journal of a live run: a kill at any moment loses at most the frame that is being written.

A live run appends its rows to ``journal.bin`` in its folder. Each frame contains rows that belong
together, such as a window with its cycles and its decision; readers take complete frames only. A
later row of a cycle or window replaces an earlier row with the same number. `open_run` reads a
folder that has only a journal. `seal_run` writes the tables, then ``run.json``, and removes the
journal.

A frame consists of a mark, the length of its text, a checksum of both, and the text (JSON, ASCII;
the mark is not ASCII). A writer cuts off a torn end; a reader skips damage up to the next mark.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from dwell.errors import RunError, UnwritableError
from dwell.model.table_columns import TABLES
from dwell.record.schema import SCHEMA_VERSION, Columns, Types, polars_schema, require_version

if TYPE_CHECKING:
    import polars as pl

JOURNAL = "journal.bin"

Rows: TypeAlias = Mapping[str, Sequence[Sequence[Any]]]
T = TypeVar("T")

NUMBERED = tuple(name for name, table in TABLES.items() if table.numbered)
TYPES = ("Int64", "Float64", "Boolean", "String")

MARK = b"\xd3DJ1"
HEAD = struct.Struct("<II")
BEGIN = len(MARK) + HEAD.size
#: Largest text of a frame that is written.
MAX_FRAME_BYTES = 1 << 28
#: Number of rows that are kept as Python objects before they become a table.
CHUNK_ROWS = 20_000


def framed(content: Mapping[str, object]) -> bytes:
    """Return a frame of a journal."""
    text = json.dumps(content, separators=(",", ":"), default=_plain).encode("ascii")
    if len(text) > MAX_FRAME_BYTES:
        raise RunError(f"{len(text)} bytes of rows at once; the journal takes {MAX_FRAME_BYTES}")
    return MARK + HEAD.pack(len(text), _checksum(text)) + text


def _plain(value: object) -> object:
    """Return a NumPy number as a Python number."""
    item = getattr(value, "item", None)
    if item is None:
        raise TypeError(f"{value!r} cannot be written to a journal")
    return item()


def _checksum(text: bytes) -> int:
    return zlib.crc32(text, zlib.crc32(len(text).to_bytes(4, "little")))


def _frames(data: bytes | mmap.mmap) -> Iterator[tuple[int, bytes]]:
    """Yield the offset and the text of every complete frame."""
    place = data.find(MARK)
    while place >= 0:
        text = _text_at(place, data)
        if text is not None:
            yield place, text
        place = data.find(MARK, place + (1 if text is None else BEGIN + len(text)))


def _text_at(place: int, data: bytes | mmap.mmap) -> bytes | None:
    if len(data) < place + BEGIN:
        return None
    length, checksum = HEAD.unpack(data[place + len(MARK) : place + BEGIN])
    if length > len(data) - place - BEGIN:
        return None
    text = bytes(data[place + BEGIN : place + BEGIN + length])
    return text if _checksum(text) == checksum else None


class _Table:
    """Rows of one table; packed rows become a data frame, other rows remain lists."""

    def __init__(self, name: str, columns: Types, *, packed: bool) -> None:
        self.name, self.columns, self.packed = name, columns, packed
        self.rows: list[Sequence[object]] = []
        self.chunks: list[pl.DataFrame] = []

    def add(self, rows: Sequence[Sequence[object]]) -> None:
        self.rows += rows
        if self.packed and len(self.rows) >= CHUNK_ROWS:
            self._pack()

    def _pack(self) -> None:
        import polars as pl

        schema = polars_schema(self.columns)
        try:
            self.chunks.append(pl.DataFrame(self.rows, schema=schema, orient="row"))
        except (pl.exceptions.PolarsError, TypeError, ValueError, OverflowError) as error:
            why = str(error).partition("\n")[0]
            raise RunError(f"its {self.name} do not fit their columns ({why})") from None
        self.rows = []

    def frame(self) -> pl.DataFrame:
        """Return the table; a numbered table has one row per number, in ascending order."""
        import polars as pl

        if self.rows or not self.chunks:
            self._pack()
        frame = pl.concat(self.chunks)
        if self.name in NUMBERED:
            number = frame.columns[0]
            frame = frame.unique(number, keep="last", maintain_order=True).sort(number)
        return frame

    def plain(self) -> dict[str, list[Any]]:
        """Return the columns as lists; needs rows that are not packed."""
        rows: Sequence[Sequence[Any]] = self.rows
        if self.name in NUMBERED:
            last = {row[0]: row for row in rows}
            rows = [last[number] for number in sorted(last)]
        return {name: [row[i] for row in rows] for i, name in enumerate(self.columns)}


@dataclass(slots=True)
class _Contents:
    """Combined frames of a journal, with or without their rows.

    Parameters
    ----------
    end : int
        Offset of the end of the last complete frame.
    damaged : list of int
        Length in bytes of each damaged part before a complete frame.
    torn_bytes : int
        Number of bytes after the last complete frame.
    """

    run: str | None = None
    meta: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, dict[str, str | list[str]]] = field(default_factory=dict)
    tables: dict[str, _Table] = field(default_factory=dict)
    following: dict[str, int] = field(default_factory=dict)
    opened: int = 0
    end: int = 0
    damaged: list[int] = field(default_factory=list)
    torn_bytes: int = 0
    keep: bool = True
    packed: bool = True

    def take(self, frame: Any) -> None:
        if not isinstance(frame, dict):
            raise RunError("no journal of a run: a frame is not a mapping")
        if "run" in frame:
            self._take_header(frame)
        elif self.run is None:
            raise RunError("its beginning is damaged: rows before any header")
        self.meta.update(frame.get("meta", {}))
        for name, rows in frame.get("rows", {}).items():
            if name not in self.columns:
                raise RunError(f"it has rows of an unknown table {name!r}")
            if name in NUMBERED and rows:
                last = max(int(row[0]) for row in rows)
                self.following[name] = max(self.following.get(name, 0), last + 1)
            if self.keep:
                self.tables[name].add(rows)

    def _take_header(self, frame: Mapping[str, Any]) -> None:
        require_version(frame)
        if self.run is None:
            self.run = str(frame["run"])
            self.columns = frame["columns"]
            self.tables = {
                name: _Table(name, kinds, packed=self.packed)
                for name, kinds in self.columns.items()
            }
        elif self.run != frame["run"] or self.columns != frame["columns"]:
            raise RunError("its headers contradict one another")
        self.opened = max(self.opened, int(frame["opened"]))


def _read(data: bytes | mmap.mmap, *, keep: bool = True, packed: bool = True) -> _Contents:
    contents = _Contents(keep=keep, packed=packed)
    for place, text in _frames(data):
        if place > contents.end:
            contents.damaged.append(place - contents.end)
        contents.take(json.loads(text))
        contents.end = place + BEGIN + len(text)
    contents.torn_bytes = len(data) - contents.end
    return contents


def read_journal(
    folder: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, pl.DataFrame]]:
    """Read a folder's journal as data frames, also while a process writes it.

    Returns
    -------
    meta : dict
        Metadata from the writer; ``recovered`` counts the losses.
    tables : dict of str to DataFrame

    Raises
    ------
    RunError
        If the journal is missing or unreadable.
    """
    contents, tables = _parsed(Path(folder) / JOURNAL, _Table.frame, packed=True)
    recovered = {
        "sealed": False,
        "opened": contents.opened,
        "torn_bytes": contents.torn_bytes,
        "damaged_bytes": sum(contents.damaged),
        "damaged_places": len(contents.damaged),
        **{
            f"missing_{name}": contents.following.get(name, 0) - len(tables[name])
            for name in NUMBERED
            if name in tables
        },
    }
    windows = len(tables["windows"]) if "windows" in tables else 0
    return {"windows": windows, **contents.meta, "recovered": recovered}, tables


def read_plain_journal(
    folder: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, dict[str, list[Any]]]]:
    """Read a folder's journal as lists, without Polars.

    Returns
    -------
    meta : dict
        Metadata from the writer.
    tables : dict of str to dict of str to list
        Columns of each table.

    Raises
    ------
    RunError
        If the journal is missing or unreadable.
    """
    contents, tables = _parsed(Path(folder) / JOURNAL, _Table.plain, packed=False)
    return contents.meta, tables


def _parsed(
    file: Path, made: Callable[[_Table], T], *, packed: bool
) -> tuple[_Contents, dict[str, T]]:
    """Combine the frames of a journal; return them and each table as converted by `made`."""
    try:
        with file.open("rb") as stream:
            if os.fstat(stream.fileno()).st_size == 0:
                raise RunError("empty; the run was killed before it began")
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
                contents = _read(data, packed=packed)
        tables = {name: made(table) for name, table in contents.tables.items()}
    except FileNotFoundError:
        raise RunError(f"{file.parent}: no journal there") from None
    except OSError as error:
        raise RunError(f"{file}: cannot be read ({error.strerror})") from None
    except RunError as error:
        raise RunError(f"{file}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise RunError(f"{file}: no journal of a run ({error!r})") from None
    if contents.run is None:
        raise RunError(f"{file}: nothing in it can be read; the run was killed before it began")
    return contents, tables


def note_in_journal(folder: str | os.PathLike[str], **meta: object) -> None:
    """Add metadata to the journal of a run that has ended without being sealed.

    Raises
    ------
    RunError
        If a process is writing the journal, or it cannot be written.
    """
    file = Path(folder) / JOURNAL
    try:
        with file.open("r+b") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            end = _read(stream.read(), keep=False).end
            stream.truncate(end)
            stream.seek(end)
            stream.write(framed({"meta": meta}))
    except OSError as error:
        raise RunError(f"{file}: cannot be written ({error.strerror})") from None


class Journal:
    """The journal of a run, open for appending.

    Parameters
    ----------
    folder : path-like
        Folder of the run, created if missing. A journal of the same run is continued after its
        torn end, if any, has been cut off.
    run : str
        Id of the run.
    meta : mapping
        JSON-able metadata of the run (see `Run`). If the disk is full when the journal opens, the
        metadata are written with the first rows that fit.
    columns : mapping
        Type of every column of ``cycles``, ``windows``, ``decisions`` and other tables.

    Attributes
    ----------
    cut_bytes : int
        Length of the torn end that was cut off.
    meta : dict
        Metadata of the run, from this writer and earlier writers.

    Raises
    ------
    RunError
        If the folder holds a finished run, the journal of another run, a journal with other
        columns or with a writer, or other files.
    UnwritableError
        If the journal cannot be created or opened.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        run: str,
        meta: Mapping[str, Any],
        columns: Columns,
    ) -> None:
        self.folder = Path(folder)
        self.run = run
        self.columns = {
            table: {
                name: kind if isinstance(kind, str) else list(kind) for name, kind in of.items()
            }
            for table, of in columns.items()
        }
        _require_types(self.columns)
        self.cut_bytes = 0
        self.file = self.folder / JOURNAL
        # Encode the header before the file is created: an error must not leave half a journal.
        version = {"schema_version": SCHEMA_VERSION}
        header = {"run": run, **version, "meta": dict(meta), "columns": self.columns}
        framed({**header, "opened": 1})
        self._require_place()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self.file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            self._lock()
            contents = self._go_on()
            self._following = contents.following
            self.meta: dict[str, Any] = {**contents.meta, **meta}
            frame = framed({**header, "opened": contents.opened + 1})
            # Write the header twice: the second copy serves if the first is damaged.
            self._header = frame + frame if contents.opened == 0 else frame
            with suppress(UnwritableError):
                self._write(b"")
        except BaseException:
            os.close(self._descriptor)
            self._descriptor = -1
            raise

    def __repr__(self) -> str:
        return f"<Journal of {self.run} in {str(self.folder)!r}>"

    def _require_place(self) -> None:
        if (self.folder / "run.json").is_file():
            raise RunError(f"{self.folder} holds a finished run; choose another folder")
        if self.folder.exists() and not self.file.is_file():
            if not self.folder.is_dir():
                raise RunError(f"{self.folder} is not a folder")
            if any(self.folder.iterdir()):
                raise RunError(f"{self.folder} exists and is not a run; choose another folder")

    def _lock(self) -> None:
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise RunError(f"{self.file}: another process is writing this run") from None

    def _go_on(self) -> _Contents:
        """Read the existing frames, cut off the torn end, and seek to the end."""
        size = os.fstat(self._descriptor).st_size
        if size == 0:
            return _Contents()
        try:
            with mmap.mmap(self._descriptor, 0, access=mmap.ACCESS_READ) as data:
                contents = _read(data, keep=False)
                self.cut_bytes = contents.torn_bytes
        except (RunError, KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise RunError(f"{self.file}: {error}") from None
        if contents.run is None:
            contents = _Contents()
        elif contents.run != self.run:
            raise RunError(f"{self.file} is of run {contents.run}, not {self.run}")
        elif contents.columns != self.columns:
            raise RunError(f"{self.file} has other columns: the cell or the estimator has changed")
        os.ftruncate(self._descriptor, size - self.cut_bytes)
        os.lseek(self._descriptor, 0, os.SEEK_END)
        return contents

    def _unwritable(self, error: OSError) -> UnwritableError:
        return UnwritableError(f"{self.file}: cannot be written ({error.strerror})")

    def _write(self, data: bytes) -> None:
        """Write bytes without a sync: they survive the end of the process, but not a power loss.

        If the disk has too little room, the file keeps its former length.
        """
        if self._descriptor < 0:
            raise RunError(f"{self.file}: the journal is closed")
        rest = memoryview(self._header + data)
        end = os.lseek(self._descriptor, 0, os.SEEK_CUR)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._descriptor, end)
                os.lseek(self._descriptor, end, os.SEEK_SET)
            raise self._unwritable(error) from None
        self._header = b""

    def following(self, table: str) -> int:
        """Return the next row number of a numbered table; 0 if the table is empty."""
        return self._following.get(table, 0)

    def append(self, rows: Rows, **meta: object) -> None:
        """Write rows as one frame, which readers take completely or skip.

        Parameters
        ----------
        rows : mapping of str to sequence of rows
            Rows by table, with values in the order of the columns and None for null.
        **meta : JSON-able
            Metadata to add to the run.

        Raises
        ------
        RunError
            If the number of values in a row differs from the number of columns.
        UnwritableError
            If the disk is full or fails; the rows can be appended again.
        """
        for name, of in rows.items():
            width = len(self.columns.get(name, ()))
            wrong = next((row for row in of if len(row) != width), None)
            if wrong is not None:
                raise RunError(f"a row of {name} has {len(wrong)} values; it has {width} columns")
        content: dict[str, object] = {"rows": {name: of for name, of in rows.items() if of}}
        if meta:
            content["meta"] = meta
        self._write(framed(content))
        self.meta.update(meta)
        for name in NUMBERED:
            for row in rows.get(name, ()):
                self._following[name] = max(self._following.get(name, 0), int(row[0]) + 1)

    @staticmethod
    def written(folder: str | os.PathLike[str]) -> bool:
        """Whether a process is writing a folder's journal."""
        try:
            with (Path(folder) / JOURNAL).open("rb") as stream:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return False

    def close(self) -> None:
        """Stop writing; the journal can be continued or sealed. Safe to call twice."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _require_types(columns: Columns) -> None:
    for table, kinds in columns.items():
        for name, kind in kinds.items():
            if isinstance(kind, str) and kind not in TYPES:
                known = ", ".join(TYPES)
                raise RunError(f"column {name} of {table}: type {kind!r} is none of {known}")
