"""Playing: applies a scenario's changes to a running testbed, and records them in its run."""

from __future__ import annotations

import math
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from dwell.errors import DwellError, LiveError
from dwell.live.host.hosting import clock_of
from dwell.live.local.conditions import Conditions
from dwell.live.local.testbed import Testbed
from dwell.live.local.timeline import Change, Timeline, first_ns, last_ns, step_ns
from dwell.model import Disturbance, Problem
from dwell.model.document import disturbance_document
from dwell.record import Run, open_run, seal_run
from dwell.record.journal import read_plain_journal

#: Period of the calls of `look`.
LOOK_S = 0.5
#: Utilisation above which a node is full, given counters with steps of 10 ms.
FULL = 0.97


@dataclass(slots=True)
class Played:
    """Record of the applied changes in a run, which its controller does not know.

    `made_ns` has the time of each change by its place and planned time. `threads` has (time, number
    of foreign threads) by node. Times are of the clock of the cell's processes on this computer.
    """

    problem: Problem
    scenario: str
    seed: int
    timeline: Timeline
    made_ns: dict[tuple[str, int], int] = field(default_factory=dict)
    threads: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    def changed(self, change: Change, at_ns: int | None = None) -> None:
        """Record that a change was made, at a time or now."""
        at_ns = clock_of(self.problem)() if at_ns is None else at_ns
        self.made_ns[change.place, change.at_ns] = at_ns
        if not isinstance(change.state, Conditions):
            self.threads.setdefault(change.place, []).append((at_ns, change.state.threads))

    def begun_ns(self, item: Disturbance) -> int | None:
        """Return the begin of a disturbance of the timeline; None before it."""
        made_ns = self.made_ns.get((item.place, first_ns(item)))
        return None if made_ns is None else made_ns - step_ns(item)

    def ended_ns(self, item: Disturbance) -> int | None:
        """Return the end of a disturbance of the timeline; None before it."""
        made_ns = self.made_ns.get((item.place, last_ns(item)))
        return None if made_ns is None else made_ns + step_ns(item)

    def active(self) -> list[Disturbance]:
        """Return the disturbances that have begun and not ended."""
        return [
            item
            for item in self.timeline.items
            if self.begun_ns(item) is not None and self.ended_ns(item) is None
        ]

    def least_threads(self, node: str, begin_ns: int, end_ns: int) -> int:
        """Return the least number of foreign threads of a node between two times."""
        found = 0
        for at_ns, threads in self.threads.get(node, ()):
            if at_ns >= end_ns:
                break
            found = threads if at_ns <= begin_ns else min(found, threads)
        return found

    def note(self, folder: Path, span: tuple[int, int] | None = None, **more: Any) -> Run:
        """Record the scenario and more values in a run, whose time begins with the first release.

        `span` has the first and the last release [default: from the run].
        """
        span = begun(open_run(folder)) if span is None else span
        return seal_run(folder, **self.notes(span), **more)

    def notes(self, span: tuple[int, int] | None) -> dict[str, object]:
        """Return the record of the scenario for a run with this first and last release, if any."""
        notes: dict[str, object] = {"scenario": self.scenario, "seed": self.seed}
        if span is not None:
            items = (self._as_played(item, *span) for item in self.timeline.items)
            notes["played"] = [item for item in items if item is not None]
        return notes

    def _as_played(
        self, item: Disturbance, origin_ns: int, end_ns: int
    ) -> Mapping[str, object] | None:
        """Return a disturbance with its times in the run; None if it has not begun.

        A disturbance that has not ended is recorded until the end of the run, unless it has a ramp,
        which keeps its planned length and slope.
        """
        begun_ns, ended_ns = self.begun_ns(item), self.ended_ns(item)
        if begun_ns is None:
            return None
        at_s = round((begun_ns - origin_ns) / 1e9, 3)
        if item.ramp_s and ended_ns is None:
            return {**disturbance_document(item), "at_s": at_s}
        # A disturbance that has begun after the last release is recorded with length 0.
        end_ns = max(end_ns if ended_ns is None else ended_ns, begun_ns)
        for_s = round((end_ns - begun_ns) / 1e9, 3)
        shorter = replace(item, ramp_s=min(item.ramp_s, for_s / 2, item.for_s / 2))
        return {**disturbance_document(shorter), "at_s": at_s, "for_s": for_s}


def begun(run: Run) -> tuple[int, int] | None:
    """Return first and last release of a run, ns of its stamper's clock; None without cycles."""
    origin_ns, cycles = run.meta.get("origin_ns"), run.cycles
    if not isinstance(origin_ns, int) or cycles.is_empty():
        return None
    return origin_ns, origin_ns + int(cycles["release_ns"][-1])


def crowded(run: Run, problem: Problem) -> list[str]:
    """Return warnings about nodes that were full without a disturbance.

    A node is full if its utilisation is at least `FULL` in most windows without a recorded
    disturbance.
    """
    import polars as pl

    span_s = problem.window_ms / 1e3
    # The join drops windows whose first cycle is missing from the record.
    begun = run.cycles.select(pl.col("release_ns") / 1e9, first_cycle="cycle")
    windows = run.windows.filter(~pl.col("warmup")).join(begun, on="first_cycle")
    at_s = pl.col("release_ns")
    for item in run.played or ():
        windows = windows.filter((at_s + span_s < item.at_s) | (item.end_s < at_s))
    warnings = []
    for node in problem.fabric.nodes:
        full = int((windows[f"u_{node}"] >= FULL).sum())
        if 2 * full > windows.height:
            warnings.append(
                f"{node} was full ({FULL:.0%} busy or more) in {full} of {windows.height} windows "
                "in which nothing was to disturb it: this machine has too little for the cell, and "
                "what was missed says little about placements"
            )
    return warnings


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


@contextmanager
def _handled(numbers: Sequence[int], handler: Any) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)


def interruptible() -> AbstractContextManager[None]:
    """Raise KeyboardInterrupt at SIGTERM and SIGHUP (end of the terminal), as at Ctrl-C."""
    return _handled((signal.SIGTERM, signal.SIGHUP), _interrupt)


def undisturbed() -> AbstractContextManager[None]:
    """Ignore signals while this process ends all parts of a testbed."""
    return _handled((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_IGN)


def make_folder(out: Path, mark: str, whose: str) -> None:
    """Make the folder of a run, and replace a folder with the file `mark`.

    Raises a LiveError if the path has other content.
    """
    if (out / mark).is_file():
        shutil.rmtree(out)
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise LiveError(f"{out} exists and is not {whose}; choose another folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    (out / mark).touch()


def play(
    changes: Sequence[Change],
    seconds: float,
    now_s: Callable[[], float],
    apply: Callable[[Change], None],
    look: Callable[[float], None],
) -> None:
    """Apply the changes of a scenario, sorted by time, at their times.

    `now_s` returns the time since the begin. `look` is called with the time after each change, and
    at each multiple of `LOOK_S`.
    """
    waiting = list(changes)
    while (at_s := now_s()) < seconds:
        while waiting and waiting[0].at_s <= at_s:
            apply(waiting.pop(0))
        look(at_s)
        # Multiples of `LOOK_S` avoid a drift; changes between them are applied on time.
        following_s = min((math.floor(at_s / LOOK_S) + 1) * LOOK_S, seconds)
        if waiting:
            following_s = min(following_s, waiting[0].at_s)
        time.sleep(max(following_s - now_s(), 0.0))


def play_on(
    testbed: Testbed,
    played: Played,
    seconds: float,
    look: Callable[[float], None] = lambda at_s: None,
) -> None:
    """Apply a timeline to a started testbed, and record the time of each change.

    `seconds` count from the first release; `look` is called as in `play`.
    """
    clock = clock_of(played.problem)

    def apply(change: Change) -> None:
        testbed.apply(change)
        played.changed(change)

    changes = played.timeline.changes
    play(changes, seconds, lambda: (clock() - testbed.begun_ns) / 1e9, apply, look)


def require_run(out: Path) -> Path:
    """Return the longest run in a testbed's folder; raises a LiveError without a run."""
    folder = longest_run(out / "runs")
    if folder is None:
        raise LiveError(f"{out}: the controller has written no run; see {out}/controller*.log")
    return folder


def longest_run(runs: Path) -> Path | None:
    """Return the longest run in a folder, if any."""
    return _longest(runs, lambda folder: int(open_run(folder).meta.get("windows", 0)))


def longest_journal(runs: Path) -> Path | None:
    """Return the longest journal in a folder, if any: runs stay journals without Polars."""
    return _longest(runs, lambda folder: len(read_plain_journal(folder)[1]["windows"]["window"]))


def _longest(runs: Path, windows_of: Callable[[Path], int]) -> Path | None:
    lengths: list[tuple[int, Path]] = []
    for folder in sorted(runs.iterdir()) if runs.is_dir() else ():
        with suppress(DwellError):
            lengths.append((windows_of(folder), folder))
    return max(lengths)[1] if lengths else None
