"""Processes that all hear each other, over either transport, and what they have heard."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from dwell.live.transport.zenoh import ZenohSettings, ZenohTransport
from dwell.live.wire.transport import Arrival, Lane, Transport
from dwell.live.wire.wiring import SESSIONS, Locator, Role, WiringEntry
from tests.live.memory_transport import Network
from tests.ports import free_ports
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]

#: Between two ends of a new connection Zenoh delivers everything at first, then nothing for a
#: moment, and then what is subscribed to: one message that is heard does not promise the next.
STEADY = 3


class Mesh(Protocol):
    """Processes named ``NAME@NODE``, each of which may be opened, closed and opened again."""

    def open(self, who: str) -> Transport:
        """Let a process join."""
        ...

    def inbox(self) -> Inbox:
        """Something that can be subscribed with."""
        ...

    def until(self, condition: Callable[[], bool]) -> None:
        """Let messages travel until something holds; fail where it never will."""
        ...

    def joined(self, condition: Callable[[], bool], again: Callable[[], None]) -> None:
        """Do something again and again until something holds."""
        ...

    def close(self) -> None:
        """End every process."""
        ...


class Inbox:
    """Everything a subscription was handed, in order."""

    def __init__(self, notify: Callable[[], None]) -> None:
        self.samples: list[Arrival] = []
        self._notify = notify

    def __call__(self, sample: Arrival) -> None:
        self.samples.append(sample)
        self._notify()

    @property
    def payloads(self) -> list[bytes]:
        return [sample.payload for sample in self.samples]

    @property
    def keys(self) -> list[str]:
        return [sample.key for sample in self.samples]


class MemoryMesh:
    """On the network in memory."""

    def __init__(self) -> None:
        self.network = Network(seed=1, delay_ns=1_000)

    def open(self, who: str) -> Transport:
        return self.network.transport(who)

    def inbox(self) -> Inbox:
        return Inbox(lambda: None)

    def until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            assert self.network.step(), "nothing is under way, and what should hold does not"

    def joined(self, condition: Callable[[], bool], again: Callable[[], None]) -> None:
        while not condition():
            again()
            while self.network.step():
                pass

    def close(self) -> None:
        pass


class ZenohMesh:
    """On loopback; names given later connect to those given earlier, in every session."""

    def __init__(self, names: Sequence[str], settings: ZenohSettings | None = None) -> None:
        self.names = list(names)
        self.first_port = free_ports(3 * len(names))
        self.settings = settings
        self.changed = threading.Condition()
        self._open: list[ZenohTransport] = []
        self._children: list[subprocess.Popen[bytes]] = []

    def entry(self, who: str) -> WiringEntry:
        return full_entry(self.names, who, self.first_port)

    def open(self, who: str) -> Transport:
        transport = ZenohTransport(self.entry(who), self.settings)
        self._open.append(transport)
        return transport

    def spawn(self, who: str) -> subprocess.Popen[bytes]:
        """Start a process that answers whatever it hears; see `peer`."""
        asked = json.dumps({"names": self.names, "who": who, "first_port": self.first_port})
        command = [sys.executable, "-m", "tests.live.transport.peer", asked]
        child = subprocess.Popen(command, cwd=ROOT)
        self._children.append(child)
        return child

    def inbox(self) -> Inbox:
        return Inbox(self._notify)

    def _notify(self) -> None:
        with self.changed:
            self.changed.notify_all()

    def until(self, condition: Callable[[], bool]) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, PATIENCE_S), "waited in vain"

    def joined(self, condition: Callable[[], bool], again: Callable[[], None]) -> None:
        for _ in range(int(PATIENCE_S / 0.02)):
            again()
            with self.changed:
                if self.changed.wait_for(condition, 0.02):
                    return
        raise AssertionError("waited in vain")

    def close(self) -> None:
        for child in self._children:
            child.kill()
            child.wait()
        for transport in self._open:
            transport.close()


def full_entry(names: Sequence[str], who: str, first_port: int) -> WiringEntry:
    """What a process opens that hears all others in every session."""

    def endpoint(name: str, session: int) -> Locator:
        return Locator("127.0.0.1", first_port + 3 * names.index(name) + session)

    node = who.partition("@")[2]
    earlier = names[: names.index(who)]
    listen = {name: endpoint(who, i) for i, name in enumerate(SESSIONS)}
    connect = {
        name: tuple(endpoint(other, i) for other in earlier) for i, name in enumerate(SESSIONS)
    }
    return WiringEntry(Role(who, node, "worker"), listen, connect if earlier else {})


def introduce(
    mesh: Mesh, sender: Transport, key: str, inboxes: Sequence[Inbox], *, lane: Lane = "control"
) -> None:
    """Put under a key until every inbox hears it each time, and empty them."""
    said: list[bytes] = []

    def greet() -> None:
        said.append(b"hello %d" % len(said))
        sender.put(key, said[-1], lane=lane)

    def known() -> bool:
        newest = said[-STEADY:]
        return len(newest) == STEADY and all(
            inbox.payloads[-STEADY:] == newest for inbox in inboxes
        )

    mesh.joined(known, greet)
    for inbox in inboxes:
        inbox.samples.clear()
