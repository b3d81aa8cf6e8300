"""Log: what went wrong, without its floods, and as it can be shown on a terminal."""

from __future__ import annotations

import io
import json
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime


def printable(text: str, keep: str = "") -> str:
    """Return a text with escapes in place of all that a terminal may take for something else.

    Parameters
    ----------
    text : str
        Text of a user's code, or from the network.
    keep : str
        Characters that stay.
    """
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one in keep else one.encode("unicode_escape").decode()
        for one in text
    )


class _Escaping(io.TextIOWrapper):
    """Writes printable lines."""

    def write(self, text: str) -> int:
        super().write(printable(text, keep="\n\t"))
        return len(text)


def escape_output() -> None:
    """Have all that this process prints from now on escaped, at once and line by line."""
    for name in ("stdout", "stderr"):
        before = getattr(sys, name)
        with suppress(OSError):
            before.flush()
        raw = io.FileIO(before.fileno(), "wb", closefd=False)
        setattr(sys, name, _Escaping(raw, encoding="utf-8", write_through=True))


class _Unfinished(threading.local):
    """What a thread has written of its line."""

    text = ""


class _JsonLines(io.TextIOWrapper):
    """Writes each line as a JSON document with its time, level and process."""

    def __init__(self, raw: io.FileIO, who: str) -> None:
        super().__init__(raw, encoding="utf-8", write_through=True)
        self._who, self._unfinished = who, _Unfinished()

    def write(self, text: str) -> int:
        *lines, self._unfinished.text = (self._unfinished.text + text).split("\n")
        for line in filter(str.strip, lines):
            level, _, rest = line.partition(": ")
            known = level.lower() in ("warning", "error")
            document = {
                "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "level": level.lower() if known else "info",
                "process": self._who,
                "message": printable(rest if known else line, keep="\t"),
            }
            super().write(f"{json.dumps(document)}\n")
        return len(text)


def log_as_json(who: str) -> None:
    """Have all that this process prints on stderr from now on be JSON, one document per line."""
    sys.stderr.flush()
    sys.stderr = _JsonLines(io.FileIO(sys.stderr.fileno(), "wb", closefd=False), who)


def say(line: str) -> None:
    """Print a line on stderr; a log on a disk that is full does not end its writer."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


class Log:
    """Passes on a line a second at most, and says how many it has left out.

    Parameters
    ----------
    clock : callable
        Seconds.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        every_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._say, self._every_s, self._clock = say, every_s, clock
        self._next_s = float("-inf")
        self._left_out = 0
        self._lock = threading.Lock()

    def __call__(self, line: str) -> None:
        """Take a line."""
        with self._lock:
            now_s = self._clock()
            if now_s < self._next_s:
                self._left_out += 1
                return
            more = f" (and {self._left_out} lines before it)" if self._left_out else ""
            self._next_s, self._left_out = now_s + self._every_s, 0
        # A log on a disk that is full must not end who writes it.
        with suppress(OSError):
            self._say(printable(f"{line}{more}"))
