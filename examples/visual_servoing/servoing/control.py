"""Control: of the plan, the velocity for now."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import ClassVar

import msgspec
import numpy as np

from dwell.live.stage import Message

from .messages import Command, Plan
from .scene import Array, axes


def velocities(plan: Plan, since_ns: Array) -> Array:
    """Return a plan's velocities.

    Parameters
    ----------
    plan : Plan
    since_ns : array, shape (n,)
        Since its picture was taken. Before the plan's start the first velocity holds; after its
        end, nothing moves.

    Returns
    -------
    float array, shape (n, 4)
    """
    steps = ((since_ns - plan.start_ns) // plan.step_ns).astype(np.int64)
    planned: Array = np.array(plan.velocities)[np.clip(steps, 0, len(plan.velocities) - 1)]
    planned[steps >= len(plan.velocities)] = 0.0
    return planned


class Control:
    """Commands the mean of the planned velocity until the next command is due.

    Parameters
    ----------
    hold_s : float
        Until then: a period.
    clock : callable
        This node's monotonic clock, ns.
    """

    inputs: ClassVar[Mapping[str, type[msgspec.Struct]]] = {"planning": Plan}

    def __init__(
        self, *, hold_s: float = 0.04, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._samples_ns = 1e9 * hold_s * (np.arange(8) + 0.5) / 8
        self._clock = clock

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the command for now."""
        (message,) = inputs.values()
        plan: Plan = message.payload
        since_ns = self._clock() - message.released_ns - plan.waited_ns
        mean = velocities(plan, since_ns + self._samples_ns).mean(axis=0)
        return Message(Command(plan.taken_ns, axes(mean)))
