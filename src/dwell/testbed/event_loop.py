"""One thread that watches descriptors, and takes each action at its instant.

It waits with `select`, whose timeouts are exact to microseconds; those of `epoll` are rounded to
milliseconds, so that `epoll` is only asked which of many descriptors are ready.
"""

from __future__ import annotations

import heapq
import select
import time
from collections.abc import Callable
from itertools import count
from typing import Protocol, TypeAlias

from dwell.testbed.child import PARENT_CHECK_S

Action: TypeAlias = Callable[[int], None]


class Watched(Protocol):
    """What a descriptor belongs to."""

    served_ns: int

    def ready(self, events: int) -> None:
        """Serve it."""
        ...


class Loop:
    """Descriptors to watch, and actions to take at their instants."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._watched: dict[int, Watched] = {}
        self._masks: dict[int, int] = {}
        self._actions: list[tuple[int, int, Action]] = []
        self._order = count()

    def at(self, instant_ns: int, action: Action) -> None:
        """Have something done at an instant; of one instant, in the order of asking."""
        heapq.heappush(self._actions, (instant_ns, next(self._order), action))

    def watch(self, descriptor: int, mask: int, owner: Watched) -> None:
        """Watch for the events of a mask; one that is 0 watches for nothing, errors included."""
        before = self._masks.get(descriptor, 0)
        if mask == before:
            return
        if mask == 0:
            self._epoll.unregister(descriptor)
            del self._masks[descriptor], self._watched[descriptor]
            return
        if before == 0:
            self._epoll.register(descriptor, mask)
        else:
            self._epoll.modify(descriptor, mask)
        self._masks[descriptor] = mask
        self._watched[descriptor] = owner

    def turn(self) -> None:
        """Do what is due, wait for the next event or instant, and serve what is ready.

        Who was served longest ago goes first, so that nobody starves at a full queue.
        """
        actions = self._actions
        while actions and actions[0][0] <= time.monotonic_ns():
            instant_ns, _, action = heapq.heappop(actions)
            action(instant_ns)
        wait_s = PARENT_CHECK_S
        if actions:
            wait_s = min(wait_s, max(0, actions[0][0] - time.monotonic_ns()) / 1e9)
        select.select([self._epoll], [], [], wait_s)
        events = self._epoll.poll(0)
        if len(events) > 1:
            events.sort(key=lambda event: self._watched[event[0]].served_ns)
        for descriptor, mask in events:
            owner = self._watched.get(descriptor)
            if owner is not None:  # not closed by one before it
                owner.ready(mask)
