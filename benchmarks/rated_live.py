"""Kills of workers in a live cell with two rates: examples/inner-loop.yaml as real processes.

The controller of the cell runs at 100 Hz with a standby, the camera and the detector at 10 Hz. Each
worker is killed in turn, and the detector on both nodes at once. The actuator records each command
with the picture behind it.
"""

from __future__ import annotations

import math
import os
import signal
import struct
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle, pairwise
from pathlib import Path
from typing import NamedTuple

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.live import everywhere
from benchmarks.live_cell import OBSERVED, Applied, LightCell, records
from benchmarks.timing import ROOT
from dwell.live.stage import Message
from dwell.model.document import to_document
from dwell_lab.chaos.stalls import StallDetector

EXAMPLE = ROOT / "examples" / "inner-loop.yaml"
CHAIN, CAMERA = "see-act", "camera"
SECONDS, QUICK, BETWEEN_S, SETTLED_S = 600.0, 60.0, 20.0, 10.0
#: Workers that are killed, in turn; "detect" is the detector on both nodes.
TURNS = ("control@R", "detect@E", "detect@R", "control@R", "imu@R", "camera@R", "detect")
#: Cycle of the command, release, instant of the call, and cycle of the picture, or -1.
RECORD = struct.Struct("<qqqq")


@dataclass(frozen=True, slots=True)
class Command(Applied):
    """A command at the actuator, and the cycle of the picture behind it."""

    picture: int


class Kill(NamedTuple):
    """A kill, and the longest stall of the machine in the second after it."""

    whom: str
    at_ns: int
    stall_ms: float


class Actuator:
    """Records each command, and the cycle of the picture from which it descends."""

    def __init__(self) -> None:
        path = os.environ[OBSERVED]
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def apply(self, command: Message) -> None:
        """Write the command."""
        picture = command.origins.get(CAMERA, -1)
        row = command.cycle, command.released_ns, time.monotonic_ns(), picture
        os.write(self._file, RECORD.pack(*row))

    def hold(self) -> None:
        """Do nothing."""

    def zero(self) -> None:
        """Do nothing."""


class RatedCell(LightCell):
    """The example as real processes on this machine."""

    def __init__(self, folder: Path) -> None:
        found = to_document(dwell.load(EXAMPLE))
        found["live"]["actuators"] = {"control": "benchmarks.rated_live:Actuator"}
        found["tasks"]["control"]["on"]["R"]["standby"] = 1
        found["scenarios"] = {}
        super().__init__(found, folder, links=True, paths=[EXAMPLE.parent])

    def applied(self) -> Sequence[Command]:
        """Return the commands so far."""
        return [Command(*one) for one in records(self.observed, RECORD)]

    def kill(self, whom: str) -> None:
        """Kill a worker, or all workers of a task."""
        names = [name for name in self.pids() if whom in (name, name.partition("@")[0])]
        for name in names:
            os.kill(self.pids()[name], signal.SIGKILL)


def measure(quick: bool) -> Section:
    """See the module."""
    everywhere()
    seconds = QUICK if quick else SECONDS
    with tempfile.TemporaryDirectory() as folder, RatedCell(Path(folder) / "cell") as cell:
        time.sleep(SETTLED_S)
        kills = _kill_in_turn(cell, seconds)
        commands = cell.applied()
        cell.stop()
        run = next((Path(folder) / "cell" / "runs").iterdir())
        differences_ms = list(_differences_ms(dwell.open_run(run), commands))
    bound = cell.problem.controller.guard_cycles + 1
    return Section(
        f"Kills of workers at two rates, {EXAMPLE.relative_to(ROOT)}, {seconds:g} s",
        [
            *_figures(commands, kills, bound),
            Figure("windows without a gap", [len(differences_ms)], ""),
            Figure("recorded L95 of the age less the actuator's", differences_ms, "ms"),
        ],
        [f"a kill each {BETWEEN_S:g} s; missing commands are those of the second after it"],
    )


def _kill_in_turn(cell: RatedCell, seconds: float) -> list[Kill]:
    kills, begin_s = list[Kill](), time.monotonic()
    with StallDetector() as stalls:
        for whom in cycle(TURNS):
            time.sleep(BETWEEN_S)
            if time.monotonic() - begin_s > seconds:
                return kills
            at_ns = time.monotonic_ns()
            cell.kill(whom)
            time.sleep(1.0)
            kills.append(Kill(whom, at_ns, stalls.worst_ms(at_ns, time.monotonic_ns())))
    raise AssertionError


def _differences_ms(run: dwell.Run, commands: Sequence[Command]) -> Iterator[float]:
    """Yield the recorded L95 of the age less the one at the actuator, of windows without a gap."""
    by_number = {one.cycle: one for one in commands}
    numbers = dict(run.cycles.select("cycle", "number").iter_rows())
    for first, recorded_ms in run.windows.select("first_cycle", f"age_l95_{CHAIN}").iter_rows():
        window = range(first, first + run.problem.window_cycles)
        seen = [by_number.get(numbers.get(cycle, -1)) for cycle in window]
        pairs = [(one, by_number.get(one.picture)) for one in seen if one is not None]
        ages_ms = [(one.at_ns - of.released_ns) / 1e6 for one, of in pairs if of is not None]
        if len(ages_ms) == len(window):
            yield recorded_ms - sorted(ages_ms)[math.ceil(0.95 * len(ages_ms)) - 1]


def _figures(commands: Sequence[Command], kills: Sequence[Kill], bound: int) -> Iterator[Figure]:
    steps = [(one, two, two.cycle - one.cycle - 1) for one, two in pairwise(commands)]
    # A new worker has no picture before its first.
    seen = [one for one in commands if one.picture >= 0]
    pictures = [one.picture for one in seen]
    ends_ns = [(kill.at_ns, kill.at_ns + 1_000_000_000) for kill in kills]
    other = [
        missing
        for one, two, missing in steps
        if not any(two.at_ns >= begin and one.at_ns <= end for begin, end in ends_ns)
    ]
    yield Figure("commands", [len(commands)], "")
    yield Figure("commands out of order", [sum(step[2] < 0 for step in steps)], "", Goal(high=0))
    older = sum(late < early for early, late in pairwise(pictures))
    yield Figure("pictures older than one before", [older], "", Goal(high=0))
    yield Figure("missing commands without a kill", [sum(other)], "")
    for whom in dict.fromkeys(TURNS):
        mine = [kill for kill in kills if kill.whom == whom]
        missing = [
            max(n for one, two, n in steps if two.at_ns >= kill.at_ns and one.at_ns <= end)
            for kill in mine
            for end in [kill.at_ns + 1_000_000_000]
        ]
        if not mine:
            continue
        goal = Goal(high=bound) if whom.startswith("control") else None
        yield Figure(f"{whom} killed: missing in a row", missing, "", goal)
        ages = [
            max(one.cycle - one.picture for one in seen if 0 <= one.at_ns - kill.at_ns < 3e9)
            for kill in mine
        ]
        yield Figure(f"{whom} killed: oldest picture, in cycles", ages, "")
        yield Figure(f"{whom} killed: stall of the machine", [k.stall_ms for k in mine], "ms")
