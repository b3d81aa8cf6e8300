"""What it costs the others that a process is started again: the example cell, some of it killed.

A worker that no cycle needs is killed, or one that all need; or nothing is, for comparison. The
cycles that stay without actuation within the next ten seconds are counted, on the machine as it is
and beside twice as many busy threads as there are CPUs.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.live_cell import Applied, LightCell
from benchmarks.timing import ROOT
from dwell.live.local.burner import Burner
from dwell.model.document import to_document
from dwell_lab.chaos.stalls import StallDetector

EXAMPLE = ROOT / "examples" / "live" / "cell.yaml"
#: Where the cell is pinned; the workers of E have no cycles then.
HOME = "LOC"
UNUSED = ("perception@E", "planning@E", "perception@E.shadow")
USED = ("perception@R1", "planning@R2")
OBSERVED_S = 10.0
HEALTHY_CYCLES = 50
#: How long after it was sent the last beat of the process before may be heard, over the detour.
LATE_MS = 400
#: A busy machine takes long for everything.
PATIENCE_S = 120.0


@dataclass(slots=True)
class _Seen:
    """What ten seconds brought, a value each time."""

    lost: list[float] = field(default_factory=list)
    run: list[float] = field(default_factory=list)
    gap_ms: list[float] = field(default_factory=list)
    stall_ms: list[float] = field(default_factory=list)
    own: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    ready_s: list[float] = field(default_factory=list)


def measure(quick: bool) -> Section:
    """Kill workers of the example cell, on the machine as it is and on a busy one."""
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    times = 2 if quick else 6
    cpus = sorted(os.sched_getaffinity(0))
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory() as folder, _example(Path(folder)) as cell:
        bound = cell.problem.controller.guard_cycles + cell.problem.pipeline.open_cycles
        for load in (0, 2 * len(cpus)):
            with _busy(cpus, load):
                figures += _figures(_watch(cell, times), f"{load} busy, " if load else "", bound)
    return Section(
        f"Restarts of workers, {EXAMPLE.relative_to(ROOT)} at "
        f"{1e3 / cell.problem.pipeline.period_ms:g} Hz on {len(cpus)} CPUs",
        figures,
        [
            f"in turns, {OBSERVED_S:g} s each, {times} times: nothing is killed, a worker without "
            "cycles, one with",
            "the run of the kill itself is what the guard takes to move the cell, not the restart",
        ],
    )


def _figures(seen: Mapping[str, _Seen], when: str, bound: int) -> Iterator[Figure]:
    quiet = not when
    for what, one in seen.items():
        goal = Goal(high=0) if quiet and what != "nothing" else None
        yield Figure(f"{when}{what}: cycles lost", one.lost, "", goal)
        yield Figure(f"{when}{what}: longest run", one.run, "", None if quiet else Goal(high=bound))
        yield Figure(f"{when}{what}: longest gap", one.gap_ms, "ms")
        yield Figure(f"{when}{what}: longest stall of the machine", one.stall_ms, "ms")
        if one.own:
            yield Figure(f"{when}{what}: run of the kill itself", one.own, "", Goal(high=bound))
        if one.cpu_ms:
            yield Figure(f"{when}{what}: CPU time until it is ready", one.cpu_ms, "ms")
            yield Figure(f"{when}{what}: ready after", one.ready_s, "s")


@contextmanager
def _example(folder: Path) -> Iterator[LightCell]:
    """The example cell, with an actuator that writes down what it is called."""
    found: dict[str, Any] = to_document(dwell.load(EXAMPLE))
    found["live"]["actuators"] = {"control": "benchmarks.live_cell:Actuator"}
    del found["live"]["hosts"]
    with LightCell(found, folder / "cell", links=True, paths=[EXAMPLE.parent]) as cell:
        cell.client.ask("pin", HOME)
        yield cell


@contextmanager
def _busy(cpus: list[int], threads: int) -> Iterator[None]:
    burner = Burner(cpus)
    burner.start(threads)
    try:
        yield
    finally:
        burner.stop()


def _watch(cell: LightCell, times: int) -> dict[str, _Seen]:
    found = {
        "nothing": _Seen(),
        "a worker without cycles": _Seen(),
        "a worker with cycles": _Seen(),
    }
    with StallDetector() as stalls:
        for turn in range(times):
            whom = None, UNUSED[turn % len(UNUSED)], USED[turn % len(USED)]
            for (what, seen), who in zip(found.items(), whom, strict=True):
                cell.wait_for("the cell at home", lambda: _at_home(cell), PATIENCE_S)
                begin_ns = time.monotonic_ns()
                _kill(cell, who, seen, own=what == "a worker with cycles")
                seen.stall_ms.append(stalls.worst_ms(begin_ns, time.monotonic_ns()))
    return found


def _at_home(cell: LightCell) -> bool:
    """Whether the cell is where it is pinned, everybody is ready, and cycles complete again."""
    said = cell.said()
    lately = [one.cycle for one in cell.applied()[-HEALTHY_CYCLES:]]
    time.sleep(0.3)
    return (
        said.get("placement") == HOME
        and all(one["ready"] for one in said["processes"].values())
        and len(lately) == HEALTHY_CYCLES
        and time.monotonic_ns() - cell.applied()[-1].at_ns < 500_000_000
    )


def _kill(cell: LightCell, who: str | None, seen: _Seen, *, own: bool) -> None:
    """Kill a process, or nothing, and look what the actuator gets."""
    begin_ns = time.monotonic_ns()
    if who is not None:
        before = cell.pids()[who]
        begin_ns = time.monotonic_ns()
        os.kill(before, signal.SIGKILL)
        cell.wait_for(f"{who} again", lambda: cell.pids().get(who, before) != before, PATIENCE_S)
        again, since_ns = psutil.Process(cell.pids()[who]), time.monotonic_ns()
        cell.wait_for(f"{who} ready", lambda: _ready(cell, who, since_ns), PATIENCE_S)
        times = again.cpu_times()
        seen.cpu_ms.append(1e3 * (times.user + times.system))
        seen.ready_s.append((time.monotonic_ns() - begin_ns) / 1e9)
    end_ns = begin_ns + round(OBSERVED_S * 1e9)
    time.sleep(max((end_ns - time.monotonic_ns()) / 1e9, 0.0))
    cell.wait_for("a cycle", lambda: cell.applied()[-1].at_ns > end_ns, PATIENCE_S)
    applied = cell.applied()
    steps = [(a, b) for a, b in pairwise(applied) if b.at_ns >= begin_ns and a.at_ns <= end_ns]
    if own:
        seen.own.append(max(map(_missing, steps[:4])))
        steps = steps[4:]
    seen.lost.append(sum(map(_missing, steps)))
    seen.run.append(max(map(_missing, steps)))
    seen.gap_ms.append(max((b.at_ns - a.at_ns) / 1e6 for a, b in steps))


def _missing(step: tuple[Applied, Applied]) -> int:
    before, after = step
    return after.cycle - before.cycle - 1


def _ready(cell: LightCell, who: str, since_ns: int) -> bool:
    """Whether the controller has heard that it is, since."""
    told = cell.said().get("processes", {}).get(who)
    passed_ms = (time.monotonic_ns() - since_ns) / 1e6
    return told is not None and told["ready"] and told["age_ms"] < passed_ms - LATE_MS
