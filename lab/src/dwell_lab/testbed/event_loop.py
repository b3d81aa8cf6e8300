"""A loop in one thread that watches descriptors and runs actions at given instants.

It waits with `select`, whose timeouts are exact to microseconds; timeouts of `epoll` are rounded to
milliseconds.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from itertools import count
from selectors import EVENT_READ, SelectSelector
from typing import Protocol, TypeAlias

from dwell.live.local.child import PARENT_CHECK_S

Action: TypeAlias = Callable[[int], None]


class Watched(Protocol):
    """Owner of a descriptor."""

    served_ns: int

    def ready(self) -> None:
        """Read the descriptor, which is readable or has failed."""


class Loop:
    """Descriptors to watch, and actions to run at their instants."""

    def __init__(self) -> None:
        self._selector = SelectSelector()
        self._actions: list[tuple[int, int, Action]] = []
        self._order = count()

    def at(self, instant_ns: int, action: Action) -> None:
        """Schedule an action at an instant; simultaneous actions run in call order."""
        heapq.heappush(self._actions, (instant_ns, next(self._order), action))

    def watch(self, descriptor: int, owner: Watched) -> None:
        """Call the owner whenever the descriptor is readable."""
        self._selector.register(descriptor, EVENT_READ, owner)

    def unwatch(self, descriptor: int) -> None:
        """Stop watching a descriptor, including for errors."""
        self._selector.unregister(descriptor)

    def turn(self) -> None:
        """Run due actions, wait for the next event or instant, and serve ready descriptors.

        The owner served longest ago is served first, so a full queue cannot starve other owners.
        """
        actions = self._actions
        while actions and actions[0][0] <= time.monotonic_ns():
            instant_ns, _, action = heapq.heappop(actions)
            action(instant_ns)
        wait_s = PARENT_CHECK_S
        if actions:
            wait_s = min(wait_s, max(0, actions[0][0] - time.monotonic_ns()) / 1e9)
        ready = [key for key, _ in self._selector.select(wait_s)]
        for key in sorted(ready, key=lambda key: key.data.served_ns):
            if key.fd in self._selector.get_map():  # an earlier call may have closed it
                key.data.ready()
