"""Pinning: the cores of this process during a measurement."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

from dwell.errors import ProfileError

RANGE = re.compile(r"(\d{1,6})(?:-(\d{1,6}))?")


def choose_cores(text: str | None) -> frozenset[int]:
    """Return the cores of a list such as ``2``, ``0,2`` or ``0-3``.

    Parameters
    ----------
    text : str or None
        The list; None selects the highest core that this process may use, because the lowest cores
        usually serve the interrupts.

    Raises
    ------
    ProfileError
        If the text is not a list of cores, or this process may not use all of them.
    """
    allowed = os.sched_getaffinity(0)
    if text is None:
        return frozenset({max(allowed)})
    cores: set[int] = set()
    for part in text.split(","):
        match = RANGE.fullmatch(part.strip())
        if match is None:
            raise ProfileError(
                f"core: {text!r} is no list of cores; write one, as 2, or some, as 0,2 or 0-3"
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ProfileError(f"core: {part.strip()!r} goes backwards; write {last}-{first}")
        cores.update(range(first, last + 1))
    missing = sorted(cores - allowed)
    if missing:
        raise ProfileError(
            f"core: this process has no core {_shown(missing)}; it may use {_shown(allowed)}"
        )
    return frozenset(cores)


@contextmanager
def pinned(cores: Collection[int]) -> Iterator[None]:
    """Run every thread of this process on `cores` only; restore the old cores at the end.

    A thread started in between inherits its parent's cores; at the end it gets the cores that the
    calling thread had at the start.
    """
    usual = os.sched_getaffinity(0)
    before = {}
    for thread in _threads():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            before[thread] = os.sched_getaffinity(thread)
            os.sched_setaffinity(thread, cores)
    try:
        yield
    finally:
        for thread in _threads():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(thread, before.get(thread, usual))


def _threads() -> list[int]:
    return [int(item.name) for item in Path("/proc/self/task").iterdir()]


def _shown(cores: Collection[int]) -> str:
    """Return cores as a list with ranges: 0-3,6."""
    parts = []
    # Core number minus index is constant within a run of consecutive cores.
    for _, row in groupby(enumerate(sorted(cores)), lambda pair: pair[1] - pair[0]):
        run = [core for _, core in row]
        parts.append(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]))
    return ",".join(parts)
