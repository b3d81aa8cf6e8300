"""A robot that follows a light with two rates: the stages of inner-loop.yaml, and its drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import msgspec
import numpy as np

from dwell.live.stage import Message

#: Shape of a picture; 900,000 bytes.
HEIGHT, WIDTH, COLOURS = 500, 600, 3


class Spot(msgspec.Struct):
    """Column of the light, pixels."""

    column: float


class Turn(msgspec.Struct):
    """Command of the drive: -1 is left, 1 is right."""

    rate: float


def camera(inputs: Mapping[str, Message]) -> Message:
    """Return a picture with one bright column; this source runs in every tenth cycle."""
    picture = np.zeros((HEIGHT, WIDTH, COLOURS), np.uint8)
    picture[:, inputs["stamper"].cycle % WIDTH] = 255
    return Message(picture)


def imu(inputs: Mapping[str, Message]) -> Message:
    """Return the rate of turn, which this source measures in each cycle."""
    return Message(Turn(0.0))


def detect(inputs: Mapping[str, Message]) -> Message:
    """Find the light in a picture."""
    brightness = inputs["camera"].payload.sum(axis=(0, 2))
    return Message(Spot(float(brightness.argmax())))


class Control:
    """The sink task: waits for the IMU, and takes the newest spot."""

    inputs: ClassVar = {"imu": Turn, "detect": Spot}

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the command; the first jobs have no spot yet."""
        spot = inputs.get("detect")
        wanted = 0.0 if spot is None else 2.0 * spot.payload.column / WIDTH - 1.0
        return Message(Turn(wanted - inputs["imu"].payload.rate))


class Drive:
    """The actuator."""

    def apply(self, command: Message) -> None:
        """Turn; the motor's driver would be called here."""

    def hold(self) -> None:
        """Keep the last command."""

    def zero(self) -> None:
        """Stand still."""
