"""State files of the processes of a live cell, which survive a crash of the process."""

from __future__ import annotations

import errno
import mmap
import os
import shlex
import stat
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import msgspec

from dwell.errors import LiveError
from dwell.live.roles.stamper import StamperState

_CYCLE = struct.Struct("<qq")
_LENGTH = struct.Struct("<QI")
# Number of writes, length of the content, and a checksum of both.
_SLOT = struct.Struct("<QII")
_BOOK_BYTES, _BEAT_BYTES = 2_048, 16_384
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
#: Bits of a folder's mode that permit writes by its group or by all users.
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def boot_id() -> str:
    """Return the id of the kernel's present boot; empty if the system has none."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def make_folder(path: Path) -> Path:
    """Make a folder for a node's files, which only this user may change.

    Raises a LiveError if the folder cannot be made or written to, belongs to another user, or other
    users may write to it.
    """
    try:
        # With `parents=True` and umask 002, the group could write to the parents.
        for folder in reversed(path.parents):
            if not folder.exists():
                folder.mkdir(exist_ok=True, mode=0o700)
        path.mkdir(exist_ok=True, mode=0o700)
    except OSError as error:
        raise LiveError(f"{path}: cannot be made ({error.strerror})") from None
    if not os.access(path, os.W_OK):
        raise LiveError(f"{path}: cannot be written to")
    status, own = path.stat(), os.geteuid()
    if status.st_uid != own:
        raise LiveError(
            f"{path}: belongs to user {status.st_uid}, and this process is user {own}'s: who has "
            "the folder can change what the node relies on; name another one"
        )
    if status.st_mode & OTHERS_WRITE:
        raise LiveError(
            f"{path}: others may write to it (mode {stat.S_IMODE(status.st_mode):o}), and change "
            f"what the node relies on; see what it holds, then chmod go-w {shlex.quote(str(path))}"
        )
    return path


def open_own(path: str | os.PathLike[str], flags: int) -> int:
    """Open a file of a node's folder (an opener for `open`); raises OSError (ELOOP) at a link."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def _mapped(path: Path, size: int) -> mmap.mmap:
    """Map a file of a fixed size; make the file if it is missing or has another size.

    The blocks on the disk are allocated at once. Otherwise a later write to the map on a full disk
    would kill the process. Raises an OSError if the disk is full, or the file is a symbolic link.
    """
    with open(path, "a+b", opener=open_own) as file:
        if file.seek(0, os.SEEK_END) != size:
            file.truncate(0)
        os.posix_fallocate(file.fileno(), 0, size)
        return mmap.mmap(file.fileno(), size)


def _required(path: Path, size: int) -> mmap.mmap:
    """Map a file that its process needs; raises a LiveError if that fails."""
    try:
        return _mapped(path, size)
    except OSError as error:
        link = error.errno == errno.ELOOP
        why = "is a symbolic link; remove it" if link else f"cannot be made ({error.strerror})"
        raise LiveError(f"{path}: {why}") from None


def kept_memory(path: Path, size: int) -> mmap.mmap | bytearray:
    """Map a file for counts; return private memory if that fails, as on a full disk."""
    try:
        return _mapped(path, size)
    except OSError:
        return bytearray(size)


class _Slots:
    """Two slots of mapped memory, written in turn.

    Mapped memory outlives its process, and can be written when the disk is full. A process that
    dies during a write damages only the older slot. The next write restores a removed file.
    """

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, _SLOT.size + size
        self._map = _required(path, 2 * self._size)
        self._file = _identity(path)
        self._number = 0
        self.content = b""
        self.read()

    def read(self) -> bytes:
        """Return the newest content, which another process may have written."""
        self._follow()
        for begin in (0, self._size):
            number, length, check = _SLOT.unpack_from(self._map, begin)
            content = self._map[begin + _SLOT.size : begin + _SLOT.size + length]
            if number > self._number and zlib.crc32(content, number & 0xFFFFFFFF) == check:
                self._number, self.content = number, content
        return self.content

    def _follow(self) -> None:
        """Map the file again if it was removed; if that fails, keep the old map."""
        if _identity(self._path) != self._file:
            with suppress(OSError):
                self._map = _mapped(self._path, 2 * self._size)
                self._file, self._number = _identity(self._path), 0

    def write(self, content: bytes) -> None:
        """Overwrite the older slot."""
        self._follow()
        self._number, self.content = self._number + 1, content
        begin = self._number % 2 * self._size
        place = begin + _SLOT.size
        self._map[place : place + len(content)] = content
        check = zlib.crc32(content, self._number & 0xFFFFFFFF)
        _SLOT.pack_into(self._map, begin, self._number, len(content), check)


def _identity(path: Path) -> tuple[int, int]:
    """Return device and inode of a file; (-1, -1) if it is missing."""
    try:
        status = os.lstat(path)
    except OSError:
        return -1, -1
    return status.st_dev, status.st_ino


class BookFile:
    """State file of a stamper."""

    def __init__(self, path: Path) -> None:
        self._slots = _Slots(path, _BOOK_BYTES)

    def read(self) -> StamperState | None:
        """Return the last written state; None if the file is empty or invalid."""
        try:
            return msgspec.json.decode(self._slots.content, type=StamperState)
        except msgspec.MsgspecError:
            return None

    def write(self, entry: StamperState) -> None:
        """Save the state."""
        text = msgspec.json.encode(entry)
        if len(text) > _BOOK_BYTES:
            raise LiveError(f"the placement's name is too long: {entry.placement[:40]}...")
        self._slots.write(text)


class HighestFile:
    """State file of a sink: the highest actuated cycle."""

    def __init__(self, path: Path) -> None:
        self._slots = _Slots(path, _CYCLE.size)

    def load(self) -> tuple[int, int]:
        """Return run and number of the cycle; (-1, -1) if unknown."""
        content = self._slots.content
        run, cycle = _CYCLE.unpack(content) if content else (-1, -1)
        return run, cycle

    def store(self, run: int, cycle: int) -> None:
        """Save run and number of the cycle."""
        self._slots.write(_CYCLE.pack(run, cycle))


class BeatFiles:
    """Slots of a node's processes in its folder; `who` is the process that writes."""

    def __init__(self, folder: Path, who: str) -> None:
        self._folder, self._who = folder, who
        self._slots: dict[str, _Slots] = {}

    def write(self, content: bytes) -> None:
        """See `BeatSlots`; content that does not fit, and a full disk, leave the slot as it is."""
        if len(content) <= _BEAT_BYTES and (slots := self._of(self._who)) is not None:
            slots.write(content)

    def read(self, who: str) -> bytes:
        """See `BeatSlots`."""
        slots = self._of(who)
        return b"" if slots is None else slots.read()

    def _of(self, who: str) -> _Slots | None:
        if who not in self._slots:
            try:
                self._slots[who] = _Slots(self._folder / f"{who}.beat", _BEAT_BYTES)
            except LiveError:
                return None
        return self._slots[who]


class InFlight:
    """Inputs of a worker's present job in mapped memory: the suspected cause if the worker dies."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0
        self._map: mmap.mmap | None = None

    def begin(self, content: bytes) -> None:
        """Record the inputs of a job that begins."""
        needed = _LENGTH.size + len(content)
        if self._map is None or needed > self._size:
            self._grow(needed)
        if self._map is not None:
            self._map[_LENGTH.size : needed] = content
            _LENGTH.pack_into(self._map, 0, len(content), 1)

    def end(self) -> None:
        """Record the end of the job."""
        if self._map is not None:
            _LENGTH.pack_into(self._map, 0, 0, 0)

    def _grow(self, needed: int) -> None:
        """Enlarge the file; on a full disk, continue without records."""
        size = 1 << (needed - 1).bit_length()
        try:
            self._map, self._size = _mapped(self._path, size), size
        except OSError:
            self._map, self._size = None, 0

    @staticmethod
    def read(path: Path) -> bytes | None:
        """Return the inputs of the job during which a worker died; None if it was idle."""
        try:
            data = path.read_bytes()
        except OSError:
            return None
        if len(data) < _LENGTH.size:
            return None
        length, at_work = _LENGTH.unpack_from(data)
        if not at_work or _LENGTH.size + length > len(data):
            return None
        return data[_LENGTH.size : _LENGTH.size + length]
