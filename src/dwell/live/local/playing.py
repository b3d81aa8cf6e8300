"""Playing: a scenario's changes are made to a cell that runs, and noted in its run."""

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

#: Time between two looks at a cell.
LOOK_S = 0.5
#: Utilisation of a node that is full, as far as counters of 10 ms can tell.
FULL = 0.97


@dataclass(slots=True)
class Played:
    """Record of the changes made in a run: its controller knows nothing of them.

    Instants are of the clock that the cell's processes read on this computer.

    Parameters
    ----------
    made_ns : dict of (str, int) to int
        When changes were made, by the place and the instant of each.
    threads : dict of str to list of (int, int)
        By node: since when it had how many foreign threads.
    """

    problem: Problem
    scenario: str
    seed: int
    timeline: Timeline
    made_ns: dict[tuple[str, int], int] = field(default_factory=dict)
    threads: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    def changed(self, change: Change, at_ns: int | None = None) -> None:
        """Note that a change has been made, at an instant or now."""
        at_ns = clock_of(self.problem)() if at_ns is None else at_ns
        self.made_ns[change.place, change.at_ns] = at_ns
        if not isinstance(change.state, Conditions):
            self.threads.setdefault(change.place, []).append((at_ns, change.state.threads))

    def begun_ns(self, item: Disturbance) -> int | None:
        """Return when a disturbance of the timeline has begun; None where it has not."""
        made_ns = self.made_ns.get((item.place, first_ns(item)))
        return None if made_ns is None else made_ns - step_ns(item)

    def ended_ns(self, item: Disturbance) -> int | None:
        """Return when a disturbance of the timeline has ended; None where it has not."""
        made_ns = self.made_ns.get((item.place, last_ns(item)))
        return None if made_ns is None else made_ns + step_ns(item)

    def active(self) -> list[Disturbance]:
        """Return the disturbances that are on now."""
        return [
            item
            for item in self.timeline.items
            if self.begun_ns(item) is not None and self.ended_ns(item) is None
        ]

    def least_threads(self, node: str, begin_ns: int, end_ns: int) -> int:
        """Return how many foreign threads a node had at least between two instants."""
        found = 0
        for at_ns, threads in self.threads.get(node, ()):
            if at_ns >= end_ns:
                break
            found = threads if at_ns <= begin_ns else min(found, threads)
        return found

    def note(self, folder: Path, span: tuple[int, int] | None = None, **more: Any) -> Run:
        """Note in a run, whose time begins with the first release, what was played.

        Parameters
        ----------
        span : (int, int), optional
            First and last release; what the run says of them if left out.
        **more
            To be said of it as well.
        """
        span = begun(open_run(folder)) if span is None else span
        return seal_run(folder, **self.notes(span), **more)

    def notes(self, span: tuple[int, int] | None) -> dict[str, object]:
        """Return what is noted in a run with this first and last release, where it has any."""
        notes: dict[str, object] = {"scenario": self.scenario, "seed": self.seed}
        if span is not None:
            items = (self._as_played(item, *span) for item in self.timeline.items)
            notes["played"] = [item for item in items if item is not None]
        return notes

    def _as_played(
        self, item: Disturbance, origin_ns: int, end_ns: int
    ) -> Mapping[str, object] | None:
        """Return a disturbance with its times in the run; None where it was not played.

        A disturbance that was on at the end is told as on until then; a ramp keeps its slope.
        """
        begun_ns, ended_ns = self.begun_ns(item), self.ended_ns(item)
        if begun_ns is None:
            return None
        at_s = round((begun_ns - origin_ns) / 1e9, 3)
        if item.ramp_s and ended_ns is None:
            return {**disturbance_document(item), "at_s": at_s}
        # What has begun after the last release is told as on for no time.
        end_ns = max(end_ns if ended_ns is None else ended_ns, begun_ns)
        for_s = round((end_ns - begun_ns) / 1e9, 3)
        shorter = replace(item, ramp_s=min(item.ramp_s, for_s / 2, item.for_s / 2))
        return {**disturbance_document(shorter), "at_s": at_s, "for_s": for_s}


def begun(run: Run) -> tuple[int, int] | None:
    """Return the first and the last release of a run, ns of its stamper's clock; None without."""
    origin_ns, cycles = run.meta.get("origin_ns"), run.cycles
    if not isinstance(origin_ns, int) or cycles.is_empty():
        return None
    return origin_ns, origin_ns + int(cycles["release_ns"][-1])


def crowded(run: Run, problem: Problem) -> list[str]:
    """Return warnings of nodes that were full although nothing disturbed them.

    A node is full whose utilisation is 97 % or more in most of the windows without a disturbance;
    the run's meta say when it was disturbed.
    """
    import polars as pl

    span_s = problem.window_ms / 1e3
    # A window whose first cycle is missing from the record is left out.
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
    """Have SIGTERM, and the end of the terminal, interrupt this process as Ctrl-C does."""
    return _handled((signal.SIGTERM, signal.SIGHUP), _interrupt)


def undisturbed() -> AbstractContextManager[None]:
    """Have no signal interrupt this process while it takes everything down."""
    return _handled((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_IGN)


def make_folder(out: Path, mark: str, whose: str) -> None:
    """Make the folder of a run; a folder with the mark is replaced.

    Raises
    ------
    LiveError
        If it holds something else.
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
    """Make the changes of a scenario at their times.

    Parameters
    ----------
    changes : sequence of Change
        In the order of time.
    seconds : float
        How long it is played.
    now_s : callable
        Returns the time since the beginning.
    apply : callable
        Makes a change.
    look : callable
        Takes the time; called after every change, and at every multiple of `LOOK_S`.
    """
    waiting = list(changes)
    while (at_s := now_s()) < seconds:
        while waiting and waiting[0].at_s <= at_s:
            apply(waiting.pop(0))
        look(at_s)
        # Looks do not drift, and what begins or ends in between does so in time.
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
    """Play a timeline on a testbed that has been started, and note when each change was made.

    Parameters
    ----------
    seconds : float
        From the first release on.
    look : callable
        As of `play`.
    """
    clock = clock_of(played.problem)

    def apply(change: Change) -> None:
        testbed.apply(change)
        played.changed(change)

    changes = played.timeline.changes
    play(changes, seconds, lambda: (clock() - testbed.begun_ns) / 1e9, apply, look)


def require_run(out: Path) -> Path:
    """Return the longest of the runs of a testbed's folder.

    Raises
    ------
    LiveError
        If there is none.
    """
    folder = longest_run(out / "runs")
    if folder is None:
        raise LiveError(f"{out}: the controller has written no run; see {out}/controller*.log")
    return folder


def longest_run(runs: Path) -> Path | None:
    """Return the longest of the runs in a folder; None where there is none."""
    return _longest(runs, lambda folder: int(open_run(folder).meta.get("windows", 0)))


def longest_journal(runs: Path) -> Path | None:
    """Return the longest of the runs that stay journals, where Polars is not installed."""
    return _longest(runs, lambda folder: len(read_plain_journal(folder)[1]["windows"]["window"]))


def _longest(runs: Path, windows_of: Callable[[Path], int]) -> Path | None:
    lengths: list[tuple[int, Path]] = []
    for folder in sorted(runs.iterdir()) if runs.is_dir() else ():
        with suppress(DwellError):
            lengths.append((windows_of(folder), folder))
    return max(lengths)[1] if lengths else None
