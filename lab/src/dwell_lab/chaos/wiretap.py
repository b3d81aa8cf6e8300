"""Wiretap: records a cell's messages from the wire, in a process outside the cell.

The process uses separate sessions, and only receives and stores. A record contains the instant on
the true clock, the key, the message and its header. For messages to stages the record omits the
payload.
"""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.live.local.child import Child, Parent, Started
from dwell.live.local.testbed import LocalTestbed
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import SESSIONS, Role, Session, Wiring, WiringEntry
from dwell_lab.chaos.invariants import JUDGED, Judge

_HEAD = struct.Struct("<QIII")
#: Longest time until each kind of message has been received once, seconds.
HEARD_S = 20.0


def entry_for(wiring: Wiring, nodes: Sequence[str]) -> WiringEntry:
    """Return the endpoints for a wiretap of all processes on some nodes."""
    connect: dict[Session, list[Any]] = {}
    for entry in wiring.entries.values():
        if entry.role.node in nodes:
            for session, end in entry.listen.items():
                connect.setdefault(session, []).append(end)
    role = Role(f"tap.{os.getpid()}", nodes[0], "visitor")
    ends = {name: tuple(connect[name]) for name in SESSIONS if name in connect}
    return WiringEntry(role, {}, ends)


class Wiretap(Child):
    """Context manager that runs a wiretap as a child process.

    Parameters
    ----------
    nodes : sequence of str
        Nodes whose processes are recorded.
    prefix : sequence of str
        Command prefix that runs the process on a host that reaches these nodes.
    """

    def __init__(
        self, cell: Path, nodes: Sequence[str], out: Path, prefix: Sequence[str] = ()
    ) -> None:
        name = f"tap at {','.join(nodes)}"
        settings = cell, nodes, out
        super().__init__("dwell_lab.chaos.wiretap", name, settings, prefix=prefix)


class Records:
    """Reader of the records of a wiretap."""

    def __init__(self, path: Path) -> None:
        self._path, self._read = path, 0

    def news(self) -> Iterator[tuple[int, str, bytes, bytes]]:
        """Yield the new records: instant, key, message and header."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            data = file.read()
        at = 0
        while at + _HEAD.size <= len(data):
            at_ns, key, payload, header = _HEAD.unpack_from(data, at)
            end = at + _HEAD.size + key + payload + header
            if end > len(data):
                break
            at += _HEAD.size
            name = data[at : at + key].decode()
            message = data[at + key : at + key + payload]
            yield at_ns, name, message, data[at + key + payload : end]
            at = end
        self._read += at


class ActuatorObserver(Started):
    """Context manager that runs wiretaps on all nodes of a cell, and judges the messages."""

    def __init__(self, testbed: LocalTestbed, cell: Path) -> None:
        super().__init__()
        self.judge = Judge(testbed.problem)
        self._taps: list[Wiretap] = []
        self._records: list[Records] = []
        for nodes, prefix in testbed.taps().items():
            out = testbed.folder / f"heard-{'-'.join(nodes)}"
            self._taps.append(Wiretap(cell, nodes, out, prefix))
            self._records.append(Records(out))

    def _start(self) -> None:
        """Start the wiretaps, and wait until each of three kinds of message has been received."""
        for tap in self._taps:
            self._stack.enter_context(tap)
        until = time.monotonic() + HEARD_S
        while not {"stamped", "done", "in"} <= self.judge.counts.keys():
            if time.monotonic() > until:
                raise LiveError(f"of the cell only {sorted(self.judge.counts)} is heard")
            time.sleep(0.05)
            self.look()

    def look(self) -> list[str]:
        """Return the violations in the messages since the last call."""
        news = [one for records in self._records for one in records.news()]
        news.sort(key=lambda one: one[0])
        violations = [wrong for one in news for wrong in self.judge.hear(*one)]
        return violations + self.judge.migrations()


def main() -> None:
    """Record until the parent ends, or requests the end."""
    from dwell.cellfile import load
    from dwell.live.host.security import INSECURE
    from dwell.live.local.linked_transport import without_source
    from dwell.live.transport.zenoh import ZenohTransport
    from dwell.live.wire.wiring import wire

    with ExitStack() as stack:

        def begin(settings: tuple[Path, Sequence[str], Path]) -> Callable[[None], None]:
            cell, nodes, out = settings
            os.environ[INSECURE] = "1"
            problem = load(cell)
            file = stack.enter_context(out.open("ab", buffering=0))
            transport = ZenohTransport(entry_for(wire(problem), nodes))
            stack.callback(transport.close)
            lock = threading.Lock()
            keys = Keys(problem.name)
            inputs = f"{keys.of(channels.INPUT)}/"

            def write(sample: Arrival) -> None:
                at_ns = time.monotonic_ns()
                payload = b"" if sample.key.startswith(inputs) else sample.payload
                key = sample.key.encode()
                _, header = without_source(sample.header)
                lengths = len(key), len(payload), len(header)
                with lock:
                    file.write(_HEAD.pack(at_ns, *lengths) + key + payload + header)

            for channel in JUDGED:
                transport.subscribe(keys.all(channel), write)
            return lambda _: None

        Parent().serve(begin)


if __name__ == "__main__":
    main()
