"""The lowest class of the scheduler: of one thread and those that it starts, or a sentence."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

import pytest

from dwell.live.host.lowest_class import take_lowest_class

needs_idle = pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="needs SCHED_IDLE")


def in_a_thread(do: Callable[[], None]) -> None:
    """Leave the scheduling of the test's own thread as it is."""
    thread = threading.Thread(target=do)
    thread.start()
    thread.join()


@needs_idle
def test_a_thread_and_those_that_it_starts_take_it() -> None:
    classes: list[int] = []
    before, said = os.sched_getscheduler(0), list[str]()

    def note() -> None:
        classes.append(os.sched_getscheduler(0))

    def run() -> None:
        take_lowest_class("B@E.shadow", said.append)
        note()
        in_a_thread(note)

    in_a_thread(run)
    assert classes == [os.SCHED_IDLE] * 2
    assert os.sched_getscheduler(0) == before
    assert said == []


@needs_idle
def test_a_system_that_forbids_it_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", forbidden)
    said: list[str] = []
    in_a_thread(lambda: take_lowest_class("B@E.shadow", said.append))
    assert len(said) == 1
    assert "B@E.shadow" in said[0]


def test_without_such_a_class_it_is_the_largest_niceness(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "SCHED_IDLE", raising=False)
    given: list[int] = []
    monkeypatch.setattr(os, "nice", given.append)
    take_lowest_class("B@E.shadow", lambda _: None)
    assert given == [19]


def test_a_system_without_both_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "SCHED_IDLE", raising=False)
    monkeypatch.delattr(os, "nice")
    said: list[str] = []
    take_lowest_class("B@E.shadow", said.append)
    assert len(said) == 1


@needs_idle
def test_a_real_time_priority_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    changed: list[object] = []
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: os.SCHED_FIFO)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: changed.append(of))
    take_lowest_class("B@E.shadow", lambda _: None)
    assert changed == []
