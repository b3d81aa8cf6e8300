"""The loop of a link's process: what is due comes in order, and nobody starves."""

from __future__ import annotations

import os
import time

from dwell_lab.testbed.event_loop import Loop


class Reader:
    """Reads a byte of its pipe at a time, and says when."""

    def __init__(self, loop: Loop, name: str, served: list[str]) -> None:
        self.served_ns = 0
        self.name, self.served = name, served
        self.source, self.target = os.pipe()
        loop.watch(self.source, self)

    def ready(self) -> None:
        os.read(self.source, 1)
        self.served_ns = time.monotonic_ns()
        self.served.append(self.name)


def test_actions_come_at_their_instants_and_in_the_order_of_asking() -> None:
    loop, done = Loop(), list[tuple[str, int]]()
    now_ns = time.monotonic_ns()
    for name, at_ns in (("b", now_ns + 2), ("a", now_ns + 1), ("c", now_ns + 2)):
        loop.at(at_ns, lambda due_ns, name=name: done.append((name, due_ns)))  # type: ignore[misc]
    later_ns = now_ns + 20_000_000
    loop.at(later_ns, lambda due_ns: done.append((f"at {time.monotonic_ns() >= due_ns}", due_ns)))
    while len(done) < 4:
        loop.turn()
    expected = [("a", now_ns + 1), ("b", now_ns + 2), ("c", now_ns + 2), ("at True", later_ns)]
    assert done == expected


def test_who_was_served_longest_ago_goes_first() -> None:
    loop, served = Loop(), list[str]()
    readers = [Reader(loop, name, served) for name in "ab"]
    for reader in readers:
        os.write(reader.target, b"12345")
    for _ in range(5):
        loop.turn()
    assert len(served) == 10
    assert all({*served[at : at + 2]} == {"a", "b"} for at in range(0, 10, 2))


def test_what_is_watched_no_more_is_not_served() -> None:
    loop, served = Loop(), list[str]()
    one, other = (Reader(loop, name, served) for name in "ab")
    for reader in (one, other):
        os.write(reader.target, b"1")
    loop.unwatch(one.source)
    loop.turn()
    assert served == ["b"]
    loop.watch(one.source, one)
    loop.turn()
    assert served == ["b", "a"]
