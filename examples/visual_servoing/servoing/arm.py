"""The arm: takes velocity commands, and moves in the world by them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import msgspec

from dwell.errors import LiveError
from dwell.live.stage import Message

from .messages import Command
from .scene import Axes, axes
from .world import Motion, World


class Arm:
    """Applies commands; each is followed until the next one, within the limits of the drives.

    Parameters
    ----------
    world : Path, optional
        Where the motion is written; see `World.open`.
    drives_s : float
        How long the drives go on without a word: then they stop by themselves.
    clock : callable
        The machine's monotonic clock, ns.
    """

    inputs: ClassVar[Mapping[str, type[msgspec.Struct]]] = {"control": Command}

    def __init__(
        self,
        world: Path | None = None,
        *,
        drives_s: float = 1.0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.world = World.open(world, clock())
        self._drives_ns = round(drives_s * 1e9)
        self._clock = clock

    def apply(self, command: Message) -> None:
        """Follow a command, and record the error at this instant.

        Raises
        ------
        LiveError
            If it is no command, or no velocity; the arm goes on as before.
        """
        try:
            wanted = msgspec.convert(command.payload, Command)
        except msgspec.ValidationError as error:
            raise LiveError(f"no command for the arm: {error}") from None
        if not all(math.isfinite(value) for value in wanted.velocity):
            raise LiveError(f"no velocity for the arm: {wanted.velocity}")
        self._follow(wanted.velocity, wanted.taken_ns)

    def hold(self) -> None:
        """Go on as the last command says, for want of another."""
        self._follow(None, None)

    def zero(self) -> None:
        """Stop, as fast as the drives can."""
        self._follow((0.0, 0.0, 0.0, 0.0), None)

    def _follow(self, command: Axes | None, taken_ns: int | None) -> None:
        now_ns, limits = self._clock(), self.world.scene.limits
        _, motion, worth = self.world.newest()
        position, velocity = motion.state(now_ns, limits)
        wanted = motion.command if command is None else command
        limited = tuple(
            min(max(value, -most), most)
            for value, most in zip(wanted, limits.velocity, strict=True)
        )
        if taken_ns is not None:
            worth = worth.then(taken_ns, *self.world.scene.errors(position, now_ns))
        moved = Motion(
            now_ns, axes(position), axes(velocity), axes(limited), now_ns + self._drives_ns
        )
        self.world.write(moved, worth)
