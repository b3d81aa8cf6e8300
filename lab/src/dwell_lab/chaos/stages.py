"""Stages that take as long as they are told, and an actuator that writes down what it is called.

Nothing here knows the protocol: a stage passes on what the source has said of the cycle, and the
actuator is an observer: it writes down every call, in order, with the instant.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from dwell.live.stage import CellActuator, Message, load_actuator

#: Variable with what the processes are told: ``observed`` (file), ``exec_ms`` (by task and node),
#: ``actuators`` (by task, those that are called behind the witness), ``failing`` (file with the
#: processes whose stages or actuators raise, while it is there).
TOLD = "DWELL_CHAOS"

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


def _fail_where_told(told: Path) -> None:
    """Raise a RuntimeError where a file names this process."""
    with suppress(FileNotFoundError):
        if _where() in told.read_text(encoding="utf-8").split():
            raise RuntimeError("told to fail")


class _Timed(ABC):
    """A stage that takes as long as the cell file says, and leaves the CPU to others."""

    def __init__(self) -> None:
        task, _, rest = _where().partition("@")
        node = rest.partition(".")[0]
        self.node = NODES.index(node)
        told = json.loads(os.environ[TOLD])
        self.seconds = told["exec_ms"][task][node] / 1e3
        self._failing = Path(told["failing"])

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Take the time that it takes; raise where it is told to."""
        (message,) = inputs.values()
        _fail_where_told(self._failing)
        begin = time.monotonic()
        output = self.turn(message)
        time.sleep(max(self.seconds - (time.monotonic() - begin), 0.0))
        return Message(output)

    @abstractmethod
    def turn(self, message: Message) -> bytes:
        """Return the output."""


class Sensing(_Timed):
    """Says of the cycle what all others pass on, in a message as large as an image."""

    def turn(self, message: Message) -> bytes:
        """Return the image."""
        head = SAID.pack(message.cycle, message.released_ns, 0, 0)
        return head.ljust(FRAME_BYTES, b"\0")


class Perception(_Timed):
    """Adds where it ran."""

    def turn(self, message: Message) -> bytes:
        """Return what was said, and the node."""
        cycle, released_ns, _, _ = SAID.unpack_from(message.payload)
        return SAID.pack(cycle, released_ns, self.node, 0)


class Planning(_Timed):
    """Adds where it ran."""

    def turn(self, message: Message) -> bytes:
        """Return what was said, and the node."""
        cycle, released_ns, perception, _ = SAID.unpack(message.payload)
        return SAID.pack(cycle, released_ns, perception, self.node)


class Control(_Timed):
    """Passes it on."""

    def turn(self, message: Message) -> bytes:
        """Return what was said."""
        return bytes(message.payload)


class Witness(CellActuator):
    """The actuator: a record a call, appended in one write, so that no kill tears it.

    Parameters
    ----------
    behind : CellActuator, optional
        Called after the record has been written.
    """

    def __init__(self, behind: CellActuator | None = None) -> None:
        told = json.loads(os.environ[TOLD])
        self._file = os.open(told["observed"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        self._failing = Path(told["failing"])
        self._behind = behind
        if behind is not None:
            self.inputs = behind.inputs
        self._write(START)

    def apply(self, command: Message) -> None:
        """Write down the command, and apply it; raise instead where it is told to."""
        if self._behind is None:
            cycle, released_ns, perception, planning = SAID.unpack(command.payload)
            self._write(APPLY, perception, planning, command.cycle, cycle, released_ns)
            _fail_where_told(self._failing)
            return
        self._write(APPLY, 0, 0, command.cycle, command.cycle, command.released_ns)
        _fail_where_told(self._failing)
        self._behind.apply(command)

    def hold(self) -> None:
        """Write it down, and hold."""
        self._write(HOLD)
        if self._behind is not None:
            self._behind.hold()

    def zero(self) -> None:
        """Write it down, and stop."""
        self._write(ZERO)
        if self._behind is not None:
            self._behind.zero()

    def stop(self) -> None:
        """Have what is behind it stop, where it can."""
        if self._behind is not None:
            self._behind.stop()

    def _write(self, what: int, *about: int) -> None:
        perception, planning, cycle, said, released_ns = about or (0, 0, 0, 0, 0)
        at_ns = time.monotonic_ns()
        numbers = cycle, said, released_ns, at_ns
        os.write(self._file, RECORD.pack(what, perception, planning, os.getpid(), *numbers))


class Witnessed(Witness):
    """The same before the actuator that the cell file has named."""

    def __init__(self) -> None:
        _, _, rest = sys.argv[sys.argv.index("--who") + 1].partition(".")
        name = json.loads(os.environ[TOLD])["actuators"][rest.partition("@")[0]]
        super().__init__(load_actuator(name, "live.actuators"))
