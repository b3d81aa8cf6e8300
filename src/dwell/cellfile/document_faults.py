"""Faults of one document, collected while it is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, ParamSpec, TypeVar

from dwell.errors import Fault, ProblemError, TraceError

P = ParamSpec("P")
T = TypeVar("T")


class Faults:
    """Faults of one document, at most one a path and message, in the order of its lines.

    Parameters
    ----------
    source : str, optional
        Name of the document in messages.
    is_record : bool
        Whether another machine may have written it: policies and estimators need not be known here.
    """

    def __init__(self, source: str | None = None, *, is_record: bool = False) -> None:
        self.source, self.is_record = source, is_record
        self.lines: dict[str, int] = {}
        # A mapping keeps their order and finds one again, however many an alias multiplies.
        self._faults: dict[Fault, type[ProblemError]] = {}
        self._paths: set[str] = set()
        # By kind and value: 1 and true are one key of a mapping, and two names.
        self._unquoted: dict[tuple[type, object], str] = {}

    def add(
        self,
        path: str,
        message: str,
        *,
        line: int | None = None,
        kind: type[ProblemError] = ProblemError,
    ) -> None:
        """Record a fault at a path; its line is looked up where it is not given."""
        fault = Fault(path, message, self.line(path) if line is None else line)
        self._faults.setdefault(fault, kind)
        self._paths.add(path)

    def take_as_text(self, path: str, key: object, text: str, line: int | None = None) -> str:
        """Record that a key is no text, once for all places with its value; return its text."""
        if self.unquoted(key) is None:
            self._unquoted[type(key), key] = text
            message = f"the key {text} is not a text; put it in quotes everywhere"
            self.add(path, message, line=line)
        return text

    def unquoted(self, value: object) -> str | None:
        """Return the text of the key with this value that is no text, or None."""
        plain = value is None or isinstance(value, bool | int | float)
        return self._unquoted.get((type(value), value)) if plain else None

    def excuse(self, path: str) -> None:
        """Count a path as faulty; another fault reports the cause."""
        self._paths.add(path)

    def attempt(
        self, path: str, make: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> T | None:
        """Return the result of `make`, or record its faults below `path`."""
        try:
            return make(*args, **kwargs)
        except ProblemError as error:
            for fault in error.faults:
                inner = f"{path}.{fault.path}" if path and fault.path else path or fault.path
                if not self.at(inner):
                    self.add(inner, fault.message)
            return None

    def of_file(self, path: str, read: Callable[[Path], T], file: Path) -> T | None:
        """Return the contents of a file, or record each of its faults at `path`."""
        try:
            return read(file)
        except ProblemError as error:
            for line in str(error).splitlines():
                self.add(path, line)
            return None

    def __len__(self) -> int:
        """Number of faults so far."""
        return len(self._faults)

    def line(self, path: str) -> int | None:
        """Line of a path, or of its nearest parent with a line."""
        while path and path not in self.lines:
            path = path[: max(path.rfind("."), path.rfind("["), 0)]
        return self.lines.get(path)

    def at(self, path: str) -> bool:
        """Whether there is a fault at exactly this path."""
        return path in self._paths

    def touches(self, path: str) -> bool:
        """Whether there is a fault at this path, around it or beneath it."""
        return any(_around(known, path) or _around(path, known) for known in self._paths)

    def refuse(self, path: str, message: str) -> NoReturn:
        """Raise this fault alone; it makes all others meaningless."""
        raise ProblemError([Fault(path, message, self.line(path))], self.source)

    def error(self) -> ProblemError:
        """Return one error with every fault; a TraceError if only traces are faulty."""
        kind = TraceError if set(self._faults.values()) == {TraceError} else ProblemError
        ordered = sorted(self._faults, key=lambda fault: fault.line or 0)
        shown = [Fault(_plain(f.path), _plain(f.message), f.line) for f in ordered]
        return kind(shown, self.source)


def _plain(text: str) -> str:
    """Escape line breaks and characters that cannot be printed."""
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)


def _around(outer: str, path: str) -> bool:
    return path.startswith(outer) and (len(path) == len(outer) or path[len(outer)] in ".[")
