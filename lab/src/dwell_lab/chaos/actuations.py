"""Actuations: the calls of the actuator, read from its log (see `stages.Witness`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Self

from dwell_lab.chaos.light_cell import CANDIDATES
from dwell_lab.chaos.stages import APPLY, HOLD, NODES, RECORD, ZERO

_PLACEMENTS = {(p["perception"], p["planning"]): name for name, p in CANDIDATES.items()}


@dataclass(frozen=True, slots=True)
class Seen:
    """A call of the actuator.

    Parameters
    ----------
    what : int
        `APPLY`, `HOLD`, `ZERO`, or `START` of its process.
    placement : str
        Candidate of the light cell whose nodes the command names; ``?`` for other nodes.
    cycle : int
        Cycle number that the runtime passed.
    said : int
        Cycle number in the command.
    released_ns : int
        Release that the source read.
    at_ns : int
        Instant of the call on the true clock.
    """

    what: int
    placement: str
    pid: int
    cycle: int
    said: int
    released_ns: int
    at_ns: int

    @classmethod
    def of(cls, what: int, perception: int, planning: int, pid: int, *numbers: int) -> Self:
        """Return the call of a record of the actuator (see `stages.RECORD`)."""
        where = _PLACEMENTS.get((NODES[perception], NODES[planning]), "?")
        return cls(what, where, pid, *numbers)


class Actuations:
    """Reader of the actuator's log; `all` contains the calls read so far."""

    def __init__(self, path: Path) -> None:
        self.path, self.all = path, list[Seen]()
        self._read = 0

    def look(self) -> None:
        """Read the new complete records."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(self._read)
            data = file.read()
        whole = len(data) - len(data) % RECORD.size
        self._read += whole
        for at in range(0, whole, RECORD.size):
            self.all.append(Seen.of(*RECORD.unpack_from(data, at)))

    @property
    def applied(self) -> list[Seen]:
        """Applied commands read so far."""
        return [seen for seen in self.all if seen.what == APPLY]

    def healthy(self, home: str | None = None) -> int:
        """Return the number of actuated cycles since the last lost one, or one away from `home`."""
        self.look()
        count, following = 0, None
        for seen in reversed(self.all):
            if seen.what != APPLY:
                continue
            gap = following is not None and following - seen.cycle > 1
            if gap or (home is not None and seen.placement != home):
                break
            count, following = count + 1, seen.cycle
        return count

    def last(self) -> Seen | None:
        """Return the last applied command, if any."""
        self.look()
        return next((seen for seen in reversed(self.all) if seen.what == APPLY), None)

    def since(self, at_ns: int) -> list[Seen]:
        """Return the calls of the actuator since an instant of the true clock."""
        self.look()
        calls = []
        for seen in reversed(self.all):
            if seen.at_ns < at_ns:
                break
            calls.append(seen)
        return calls[::-1]


def out_of_order(applied: Sequence[Seen]) -> list[str]:
    """Return commands that are repeated, out of order, or carry another cycle's number."""
    violations = [
        f"cycle {later.cycle} actuated after {before.cycle}"
        for before, later in pairwise(applied)
        if later.cycle <= before.cycle
    ]
    return violations + [f"cycle {s.cycle} carries {s.said}" for s in applied if s.cycle != s.said]


def unsafe(seen: Sequence[Seen], limit_ms: float) -> list[str]:
    """Return gaps between commands in which ``hold`` or ``zero`` was not called in time.

    A dead or frozen sink cannot call them; other checks cover the age and order of its commands.
    """
    silences = []
    commands = [place for place, one in enumerate(seen) if one.what == APPLY]
    for before, later in pairwise(commands):
        gap_ms = (seen[later].at_ns - seen[before].at_ns) / 1e6
        stopped_ns = [one.at_ns for one in seen[before + 1 : later] if one.what in (HOLD, ZERO)]
        if gap_ms <= limit_ms:
            continue
        waited_ms = (stopped_ns[0] - seen[before].at_ns) / 1e6 if stopped_ns else gap_ms
        if waited_ms > limit_ms:
            silences.append(
                f"no command for {gap_ms:.0f} ms after cycle {seen[before].cycle}, "
                f"and no hold() within {limit_ms:.0f} ms"
            )
    return silences
