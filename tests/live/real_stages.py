"""Stages of `real_cell`, and its actuator; copied beside the cell file and imported there.

Nothing here knows the protocol: a stage passes on what the source has said of the cycle, and the
actuator is an observer: it writes down every call, in order, with the instant.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from collections.abc import Mapping

from dwell.live.stage import Message

#: Cycle and release as the source saw them; where perception and planning ran (index of node).
SAID = struct.Struct("<qqBB")
#: What was called, and the same; then the cycle that the runtime says, and the instant.
RECORD = struct.Struct("<BBBxIqqqq")
APPLY, HOLD, ZERO, START = range(1, 5)
FRAME_BYTES = 60_000
NODES = ("R1", "E", "R2")


def _where() -> str:
    """Task and node of this process, from its command line: the stages ask nobody."""
    return sys.argv[sys.argv.index("--who") + 1]


class _Timed:
    """A stage that takes as long as the cell file says, and leaves the CPU to others."""

    def __init__(self) -> None:
        task, _, rest = _where().partition("@")
        node = rest.partition(".")[0]
        self.node = NODES.index(node)
        self.seconds = json.loads(os.environ["REAL_CELL"])["exec_ms"][task][node] / 1e3

    def process(self, inputs: Mapping[str, Message]) -> Message:
        (message,) = inputs.values()
        begin = time.monotonic()
        output = self.turn(message)
        time.sleep(max(self.seconds - (time.monotonic() - begin), 0.0))
        return Message(output)

    def turn(self, message: Message) -> bytes:
        raise NotImplementedError


class Sensing(_Timed):
    def turn(self, message: Message) -> bytes:
        head = SAID.pack(message.cycle, message.released_ns, 0, 0)
        return head.ljust(FRAME_BYTES, b"\0")


class Perception(_Timed):
    def turn(self, message: Message) -> bytes:
        cycle, released_ns, _, _ = SAID.unpack_from(message.payload)
        return SAID.pack(cycle, released_ns, self.node, 0)


class Planning(_Timed):
    def turn(self, message: Message) -> bytes:
        cycle, released_ns, perception, _ = SAID.unpack(message.payload)
        return SAID.pack(cycle, released_ns, perception, self.node)


class Control(_Timed):
    def turn(self, message: Message) -> bytes:
        return bytes(message.payload)


class Observer:
    """The actuator: a record a call, appended in one write, so that no kill tears it."""

    def __init__(self) -> None:
        path = json.loads(os.environ["REAL_CELL"])["observed"]
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        self._write(START)

    def apply(self, command: Message) -> None:
        cycle, released_ns, perception, planning = SAID.unpack(command.payload)
        self._write(APPLY, perception, planning, command.cycle, cycle, released_ns)

    def hold(self) -> None:
        self._write(HOLD)

    def zero(self) -> None:
        self._write(ZERO)

    def _write(self, what: int, *about: int) -> None:
        perception, planning, cycle, said, released_ns = about or (0, 0, 0, 0, 0)
        at_ns = time.monotonic_ns()
        numbers = cycle, said, released_ns, at_ns
        os.write(self._file, RECORD.pack(what, perception, planning, os.getpid(), *numbers))
