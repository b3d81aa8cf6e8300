"""A robot that follows a light: the stages of cell.yaml, and the drive that they steer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import ClassVar

import msgspec
import numpy as np

from dwell.live.stage import Message

HEIGHT, WIDTH = 120, 160


class Spot(msgspec.Struct):
    """Where the light is, pixels."""

    row: float
    column: float


class Turn(msgspec.Struct):
    """What the drive shall do: -1 is left, 1 is right."""

    rate: float


class Camera:
    """The source: noise, and one bright pixel that wanders. It runs on R1 only."""

    def start(self) -> None:
        """Open the device; called once in the worker's process, before any cycle."""
        self.random = np.random.default_rng(1)

    def wait(self) -> None:
        """Return when there is a new frame; only called with `release: frames`."""
        time.sleep(0.05)

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the frame of a cycle; `inputs` has what the stamper says of it."""
        frame = self.random.integers(0, 200, (HEIGHT, WIDTH), np.uint8)
        frame[HEIGHT // 2, inputs["stamper"].cycle % WIDTH] = 255
        return Message(frame)


def perceive(inputs: Mapping[str, Message]) -> Message:
    """Find the light. A function is a stage, too."""
    frame = inputs["camera"].payload
    row, column = divmod(int(frame.argmax()), WIDTH)
    return Message(Spot(row, column))


class Plan:
    """Smooths what was seen. It has a state, which moves with it."""

    inputs: ClassVar = {"perception": Spot}

    def __init__(self) -> None:
        self.column = WIDTH / 2

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Steer towards where the light has been of late."""
        spot: Spot = inputs["perception"].payload
        self.column += 0.3 * (spot.column - self.column)
        return Message(Turn(2 * self.column / WIDTH - 1))

    def snapshot(self) -> bytes:
        """Write the state after the last cycle."""
        return msgspec.msgpack.encode(self.column)

    def restore(self, state: bytes) -> None:
        """Go on where another process was."""
        self.column = msgspec.msgpack.decode(state, type=float)


class Limit:
    """The sink task, on R2: the last word before the drive."""

    inputs: ClassVar = {"planning": Turn}

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Let no turn be too fast."""
        turn: Turn = inputs["planning"].payload
        return Message(Turn(min(max(turn.rate, -0.8), 0.8)))


class Drive:
    """The actuator: gets each command at most once, in order, and never one that is too old."""

    inputs: ClassVar = {"control": Turn}

    def apply(self, command: Message) -> None:
        """Turn."""
        if command.cycle % 20 == 0:
            print(f"cycle {command.cycle}: turn {command.payload.rate:+.2f}", flush=True)

    def hold(self) -> None:
        """Go on as before: no command has come for `max_age_ms` (`silence: hold`)."""
        print("hold", flush=True)

    def zero(self) -> None:
        """Stop, for the same reason (`silence: zero`)."""
        print("stop", flush=True)
