"""Origin of an error in a user's code, in one line."""

from __future__ import annotations

import traceback
from pathlib import Path
from types import TracebackType

LONGEST = 300


def describe_raised(error: BaseException) -> str:
    """Return ``ValueError: no frame (stages.py:12)``; only the first line of a long message."""
    lines = str(error).strip().splitlines()
    message = f": {lines[0][:LONGEST]}" if lines else ""
    return f"{type(error).__name__}{message}{_where(error)}"


def _where(error: BaseException) -> str:
    if isinstance(error, SyntaxError):
        return f" ({Path(error.filename).name}:{error.lineno})" if error.filename else ""
    frames = traceback.extract_tb(error.__traceback__)
    if not frames or "importlib" in frames[-1].filename or _own(frames[-1].filename):
        return ""
    return f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})"


def raised_here(trace: TracebackType | None) -> bool:
    """Whether an error was raised by a call itself and not inside of what it called.

    A call with arguments that do not fit ends so.
    """
    frames = traceback.extract_tb(trace)
    return bool(frames) and _own(frames[-1].filename)


def _own(filename: str) -> bool:
    return Path(filename).parent == Path(__file__).parent
