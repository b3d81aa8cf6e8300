"""Stages with set execution times, and an actuator that logs its calls.

The stages do not use the protocol: they pass on the cycle number and the release from the source.
The actuator logs every call, in order, with its instant.
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

#: Environment variable with the settings of the processes: ``observed`` (log of the actuator),
#: ``exec_ms`` (by task and node), ``actuators`` (by task; the witness calls them), ``failing``
#: (file with the processes whose stages or actuators must raise; if absent, none).
TOLD = "DWELL_CHAOS"

#: Cycle and release that the source read; nodes of perception and planning (indices of `NODES`).
SAID = struct.Struct("<qqBB")
#: Call, nodes of perception and planning, process id; the runtime's cycle, the command's cycle,
#: its release, and the instant of the call.
RECORD = struct.Struct("<BBBxIqqqq")
APPLY, HOLD, ZERO, START = range(1, 5)
FRAME_BYTES = 60_000
NODES = ("R1", "E", "R2")


def _where() -> str:
    """Return this process's name from its command line: ``planning@E.1``, ``sink.control@R2``."""
    return sys.argv[sys.argv.index("--who") + 1]


def _fail_where_told(told: Path) -> None:
    """Raise a RuntimeError if the file `told` names this process."""
    with suppress(FileNotFoundError):
        if _where() in told.read_text(encoding="utf-8").split():
            raise RuntimeError("told to fail")


class _Timed(ABC):
    """A stage that sleeps until its time from ``exec_ms`` is over, without using the CPU."""

    def __init__(self) -> None:
        task, _, rest = _where().partition("@")
        node = rest.partition(".")[0]
        self.node = NODES.index(node)
        told = json.loads(os.environ[TOLD])
        self.seconds = told["exec_ms"][task][node] / 1e3
        self._failing = Path(told["failing"])

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the output after the stage's time; raise if this process must fail."""
        (message,) = inputs.values()
        _fail_where_told(self._failing)
        begin = time.monotonic()
        output = self.turn(message)
        time.sleep(max(self.seconds - (time.monotonic() - begin), 0.0))
        return Message(output)

    @abstractmethod
    def turn(self, message: Message) -> bytes:
        """Return the output's payload."""


class Sensing(_Timed):
    """The source: sends the cycle number and the release in a message as large as an image."""

    def turn(self, message: Message) -> bytes:
        """Return the image."""
        head = SAID.pack(message.cycle, message.released_ns, 0, 0)
        return head.ljust(FRAME_BYTES, b"\0")


class Perception(_Timed):
    """Adds its node."""

    def turn(self, message: Message) -> bytes:
        """Return the cycle number, the release and this node."""
        cycle, released_ns, _, _ = SAID.unpack_from(message.payload)
        return SAID.pack(cycle, released_ns, self.node, 0)


class Planning(_Timed):
    """Adds its node."""

    def turn(self, message: Message) -> bytes:
        """Return the message of perception with this node added."""
        cycle, released_ns, perception, _ = SAID.unpack(message.payload)
        return SAID.pack(cycle, released_ns, perception, self.node)


class Control(_Timed):
    """Passes its input on."""

    def turn(self, message: Message) -> bytes:
        """Return the input's payload."""
        return bytes(message.payload)


class Witness(CellActuator):
    """Actuator that appends one record per call, in one write: a kill cannot split it.

    Parameters
    ----------
    behind : CellActuator, optional
        Actuator to call after the record has been written.
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
        """Log the command, and apply it; raise after the log if this process must fail."""
        if self._behind is None:
            cycle, released_ns, perception, planning = SAID.unpack(command.payload)
            self._write(APPLY, perception, planning, command.cycle, cycle, released_ns)
            _fail_where_told(self._failing)
            return
        self._write(APPLY, 0, 0, command.cycle, command.cycle, command.released_ns)
        _fail_where_told(self._failing)
        self._behind.apply(command)

    def hold(self) -> None:
        """Log the call, and hold."""
        self._write(HOLD)
        if self._behind is not None:
            self._behind.hold()

    def zero(self) -> None:
        """Log the call, and command zero."""
        self._write(ZERO)
        if self._behind is not None:
            self._behind.zero()

    def stop(self) -> None:
        """Stop the actuator behind the witness, if any."""
        if self._behind is not None:
            self._behind.stop()

    def _write(self, what: int, *about: int) -> None:
        perception, planning, cycle, said, released_ns = about or (0, 0, 0, 0, 0)
        at_ns = time.monotonic_ns()
        numbers = cycle, said, released_ns, at_ns
        os.write(self._file, RECORD.pack(what, perception, planning, os.getpid(), *numbers))


class Witnessed(Witness):
    """A witness in front of the actuator from the cell file."""

    def __init__(self) -> None:
        _, _, rest = sys.argv[sys.argv.index("--who") + 1].partition(".")
        name = json.loads(os.environ[TOLD])["actuators"][rest.partition("@")[0]]
        super().__init__(load_actuator(name, "live.actuators"))
