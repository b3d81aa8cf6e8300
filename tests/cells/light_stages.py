"""Stages that take next to nothing, and an actuator that does nothing; copied beside the cell."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.live.stage import Message


class Passing:
    """Passes on a few bytes."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        return Message(bytes(8))


class Actuator:
    """Does nothing."""

    def apply(self, command: Message) -> None:
        return

    def hold(self) -> None:
        return

    def zero(self) -> None:
        return
