"""What every process of a cell has in common: it hears, it wakes, it beats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Protocol

from dwell.errors import LiveError
from dwell.live.hearing import Hearing
from dwell.live.keys import Keys
from dwell.live.messages import MAX_HEADER_BYTES, Beat, Carried, Header, decode, encode
from dwell.live.offsets import Offsets
from dwell.live.transport.protocol import Sample, Transport
from dwell.model import Problem
from dwell.model.document import fingerprint

#: What PTP and chrony on one network keep to.
SYSTEM_BOUND_NS = 1_000_000

__all__ = ["Place", "Pulse", "Role"]


class Role(Protocol):
    """A process of a cell, without its threads, sockets and clock.

    Whoever runs it calls one method at a time: `receive` for every message under its
    `subscriptions`, `wake` when the instant has come that the last call returned.
    """

    def subscriptions(self) -> Iterable[str]:
        """Key expressions that it wants to hear."""
        ...

    def receive(self, sample: Sample, now_ns: int) -> None:
        """Take a message in."""
        ...

    def wake(self, now_ns: int) -> int:
        """Do what is due; returns the next instant at which something is."""
        ...


@dataclass(slots=True)
class Place:
    """Where a role runs.

    Parameters
    ----------
    problem : Problem
    who, node : str
        Name of the process, unique in the cell, and its node.
    transport : Transport
    life : int
        Grows with every start of the process.
    complaints : dict of str to int
        How often something arrived that could not be used, by what was wrong with it.
    """

    problem: Problem
    who: str
    node: str
    transport: Transport
    life: int = 0
    complaints: dict[str, int] = field(default_factory=dict)

    @property
    def keys(self) -> Keys:
        """Keys of its cell."""
        return Keys(self.problem.name)

    @property
    def period_ns(self) -> int:
        """P."""
        return round(self.problem.pipeline.period_ms * 1e6)

    @property
    def relay(self) -> str:
        """Node whose agent carries small messages where a direct link fails."""
        return self.problem.live.relay or self.problem.controller_node

    @property
    def patience_ns(self) -> int:
        """Age beyond which what was heard counts no more: g periods."""
        return self.problem.controller.guard_cycles * self.period_ns

    @property
    def stamper(self) -> tuple[str, str]:
        """Node and name of the stamper."""
        node = self.problem.stamper_node
        return node, f"stamper@{node}"

    def offsets(self) -> Offsets:
        """Make what compares clocks with that of the stamper's node."""
        system = self.problem.live.clock == "system"
        return Offsets(
            self.node,
            self.problem.stamper_node,
            system_bound_ns=SYSTEM_BOUND_NS if system else None,
        )

    def put_twice(self, key: str, payload: bytes) -> None:
        """Send a small message directly, and over the detour.

        Those on the relay's own node do so, too: the detour reaches whoever has no connection of
        its own to the sender.
        """
        self.transport.put(key, payload)
        self.transport.put(self.keys.relay(key), payload)

    def around(self, sample: Sample) -> list[Sample]:
        """Return the messages that came over the detour together."""
        try:
            carried = decode(sample.payload, Carried)
        except LiveError as error:
            self.complain(error)
            return []
        return [Sample(self.keys.detour(key), payload) for key, payload in carried.messages]

    def complain(self, error: LiveError) -> None:
        """Count a message that could not be used; a flood of them takes no memory."""
        what = str(error)[:200]
        if what in self.complaints or len(self.complaints) < 100:
            self.complaints[what] = self.complaints.get(what, 0) + 1

    def header(self, sample: Sample) -> Header | None:
        """Read the header of a data message; None, and a complaint, where it is none."""
        try:
            return decode(sample.header, Header, limit=MAX_HEADER_BYTES)
        except LiveError as error:
            self.complain(error)
            return None


class Pulse:
    """Beats of a process: its own, and those that it hears.

    Parameters
    ----------
    place : Place
    state : callable
        Returns whether the process is ready, and what keeps it from that or went wrong last.
    holds : callable, optional
        Returns the stamper's term and placement.
    hears : iterable of (str, str), optional
        Nodes and processes, or ``*``, whose beats it wants; by default the stamper's only.
    every : int
        Periods between two of its beats.
    """

    def __init__(
        self,
        place: Place,
        state: Callable[[], tuple[bool, str]],
        holds: Callable[[], tuple[int, str]] | None = None,
        *,
        hears: Iterable[tuple[str, str]] | None = None,
        every: int = 1,
    ) -> None:
        self.place = place
        self._hears = (place.stamper,) if hears is None else tuple(hears)
        self.hearing = Hearing(place.who, place.patience_ns)
        self._state, self._holds = state, holds
        self._every_ns = every * place.period_ns
        self._digest = fingerprint(place.problem)
        self._next_ns = -(1 << 62)
        keys = place.keys
        self._key = keys.beat(place.node, place.who)
        direct = keys.beat("", "").removesuffix("/")
        self._prefix = direct, keys.detour(direct)

    def subscriptions(self) -> tuple[str, ...]:
        """Key expressions of beats."""
        keys = self.place.keys
        return tuple(keys.beat(node, who) for node, who in self._hears)

    def receive(self, sample: Sample, now_ns: int) -> Beat | None:
        """Take a beat in; None where it is none, or no news."""
        if not sample.key.startswith(self._prefix):
            return None
        try:
            beat = decode(sample.payload, Beat)
        except LiveError as error:
            self.place.complain(error)
            return None
        if beat.cell != self._digest:
            self.place.complain(
                LiveError(f"{beat.who} has another cell file ({beat.cell} is not {self._digest})")
            )
            return None
        news = self.hearing.hear(beat, now_ns, direct=sample.key.startswith(self._prefix[0]))
        return beat if news else None

    def hears(self, sample: Sample) -> bool:
        """Whether a message is a beat."""
        return sample.key.startswith(self._prefix)

    def wake(self, now_ns: int) -> int:
        """Send the beat that is due; returns when the next is."""
        if now_ns >= self._next_ns:
            self.send(now_ns)
            late = now_ns >= self._next_ns + self._every_ns
            self._next_ns = (now_ns if late else self._next_ns) + self._every_ns
        return self._next_ns

    def send(self, now_ns: int) -> None:
        """Send a beat."""
        place = self.place
        ready, note = self._state()
        term, placement = self._holds() if self._holds is not None else (0, "")
        heard = self.hearing.heard()
        beat = Beat(
            *(place.who, place.node, place.life, now_ns, ready, heard, term, placement),
            *(self._digest, note[:2000]),
        )
        place.put_twice(self._key, encode(beat))
