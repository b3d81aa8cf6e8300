"""Log: lines of a process on stderr, limited in rate and safe to show on a terminal."""

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
    """Return a text with characters that are not printable escaped, except for those in `keep`.

    A terminal could interpret them as commands; the text may come from the network.
    """
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one in keep else one.encode("unicode_escape").decode()
        for one in text
    )


class _Escaping(io.TextIOWrapper):
    """Escapes characters that are not printable, except for newlines and tabs."""

    def write(self, text: str) -> int:
        super().write(printable(text, keep="\n\t"))
        return len(text)


def escape_output() -> None:
    """Escape all later output of this process, and write it without a buffer."""
    for name in ("stdout", "stderr"):
        before = getattr(sys, name)
        with suppress(OSError):
            before.flush()
        raw = io.FileIO(before.fileno(), "wb", closefd=False)
        setattr(sys, name, _Escaping(raw, encoding="utf-8", write_through=True))


class _Unfinished(threading.local):
    """Text of a thread's unfinished line."""

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
    """Write all later output on stderr as JSON, one document per line."""
    sys.stderr.flush()
    sys.stderr = _JsonLines(io.FileIO(sys.stderr.fileno(), "wb", closefd=False), who)


def say(line: str) -> None:
    """Print a line on stderr; errors such as a full disk are ignored."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


class Log:
    """Passes on at most one line per `every_s` seconds, with the number of lines left out."""

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
        """Log a line, unless the last one was too recent."""
        with self._lock:
            now_s = self._clock()
            if now_s < self._next_s:
                self._left_out += 1
                return
            more = f" (and {self._left_out} lines before it)" if self._left_out else ""
            self._next_s, self._left_out = now_s + self._every_s, 0
        # A full disk must not end the process.
        with suppress(OSError):
            self._say(printable(f"{line}{more}"))
