"""Recorder of a live cell: writes the cycles and windows of an observer to an MCAP file.

The rows have the columns of a run's tables, as far as an observer knows them; cycles have the
numbers of their stamps. The recorder reads the observer's feeds at its own pace. It drops and
counts cycles and windows that have left the feed or that it cannot write.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from dwell.dash.feed import Feed
from dwell.dash.observer import ObservedCycle, ObservedWindow, Observer
from dwell.live.failures import start_repeating
from dwell.model.table_columns import LIVE
from dwell.record import column_types
from dwell.record.mcap_file import TIME_OF_DAY, McapFile, Message

#: Time between two readings of the feeds; a killed recorder loses this time.
EVERY_S = 2.0
TABLES = ("cycles", "windows", "decisions", "jobs")
#: Outcomes in a run's tables by the observer's outcomes; every other outcome is ``done``.
OUTCOMES = {
    "not_applied": "not_applied",
    "replaced": "replaced",
    "lost": "dropped",
    "untold": "dropped",
    "idle": "idle",
}

T = TypeVar("T")


class CellRecorder:
    """Recorder of one cell; a context manager.

    Parameters
    ----------
    path : Path
        New file; it must not exist.
    say : callable
        Prints a line when writing fails, when it works again, and at the end.

    Attributes
    ----------
    published, recorded, dropped : int
        Number of cycles and windows since the start: all, written and not written.

    Raises
    ------
    OSError
        If the file exists or cannot be created.
    """

    def __init__(self, observer: Observer, path: Path, say: Callable[[str], object]) -> None:
        self.published = self.recorded = self.dropped = 0
        self._observer, self._path, self._say = observer, path, say
        self._trouble = ""
        self._read = {"cycles": observer.cycles.upto, "windows": observer.windows.upto}
        self._origin_ns: int | None = None
        self._stopped = threading.Event()
        problem = observer.problem
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("xb")
        columns = {table: column_types(table, problem, LIVE) for table in TABLES}
        try:
            self._file = McapFile(self._stream, problem, columns)
        except OSError as error:
            self._stream.close()
            path.unlink()
            raise OSError(error.errno, error.strerror, str(path)) from None

    def __enter__(self) -> CellRecorder:
        """Start the thread that reads the feeds."""
        self._thread = start_repeating("recorder", EVERY_S, self._stopped, self._look)
        return self

    def __exit__(self, *_: object) -> None:
        """Write the remaining cycles and windows, then finish and close the file."""
        self._stopped.set()
        self._thread.join()
        self._look(last=True)
        counts = {name: getattr(self, name) for name in ("published", "recorded", "dropped")}
        cell = self._observer.problem.name
        self._file.finish({"cell": cell, "kind": "live", "clock": TIME_OF_DAY, **counts})
        self._stream.close()
        self._say(
            f"{self._path}: {self.recorded} cycles and windows recorded + {self.dropped} dropped = "
            f"{self.published} published"
        )

    def _look(self, *, last: bool = False) -> None:
        """Write new cycles and windows, once the first stamp has set the origin of time."""
        observer = self._observer
        if self._origin_ns is None:
            at_s = observer.now().at_s
            if at_s == 0 and not last:
                return
            self._origin_ns = time.time_ns() - round(at_s * 1e9)
        self._take("cycles", observer.cycles, _of_cycle)
        self._take("windows", observer.windows, self._of_window)
        self._file.flush()

    def _take(self, name: str, feed: Feed[T], rows: Callable[[T], Iterator[Message]]) -> None:
        news = feed.since(self._read[name])
        self.published += news.upto - self._read[name]
        self.dropped += news.dropped
        self._read[name] = news.upto
        for item in news.items:
            self._write(rows(item))

    def _write(self, rows: Iterable[Message]) -> None:
        origin_ns = self._origin_ns or 0
        try:
            self._file.add(*((max(at_ns + origin_ns, 0), table, row) for at_ns, table, row in rows))
        except OSError as error:
            self.dropped += 1
            if self._trouble != (trouble := str(error.strerror)):
                self._say(
                    f"error: {self._path}: cannot be written ({trouble}); new rows are dropped"
                )
            self._trouble = trouble
            return
        self.recorded += 1
        if self._trouble:
            lost = f"{self.dropped} cycles and windows were dropped"
            self._say(f"{self._path}: can be written again; {lost}")
            self._trouble = ""

    def _of_window(self, window: ObservedWindow) -> Iterator[Message]:
        """Yield a window and the decision on it."""
        said, at_ns = window.said, round(window.at_s * 1e9)
        used, costs, predicted = (
            said.get(name) or {} for name in ("utilisation", "estimates", "predicted")
        )
        known = self._observer.problem
        yield (
            at_ns,
            "windows",
            {
                "window": window.number,
                "placement": said.get("placement"),
                "seen_l95_ms": said.get("l95_ms"),
                "seen_violation_rate": said.get("violation_rate"),
                "cost": said.get("cost"),
                **{f"u_{name}": used.get(name) for name in known.fabric.resources},
                **(said.get("ages") or {}),
            },
        )
        yield (
            at_ns,
            "decisions",
            {
                "window": window.number,
                "last_cycle": said.get("last_cycle"),
                "cycles": said.get("cycles"),
                "incumbent": said.get("placement"),
                "reason": said.get("reason"),
                **{f"j_{name}": costs.get(name) for name in known.candidates},
                **{
                    f"est_{of}_{name}": (predicted.get(name) or {}).get(of)
                    for name in known.candidates
                    for of in ("l95_ms", "violation_rate")
                },
            },
        )


def _of_cycle(cycle: ObservedCycle) -> Iterator[Message]:
    """Yield a cycle and its jobs."""
    yield (
        cycle.release_ns,
        "cycles",
        {
            "cycle": cycle.number,
            "release_ns": cycle.release_ns,
            "placement": cycle.placement,
            "latency_ns": cycle.latency_ns,
            "missed": cycle.missed,
            "outcome": OUTCOMES.get(cycle.outcome, "done"),
            "run": cycle.run,
            "number": cycle.number,
            "term": cycle.term,
            "heard": cycle.known,
            "actuated": cycle.outcome == "actuated",
        },
    )
    for job in cycle.jobs:
        ready_ns = job["ready_ns"]
        if isinstance(ready_ns, int):
            yield ready_ns, "jobs", job
