"""Signals that tell a process to end in good order, and those that end it at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType


def end_when_told(stopped: threading.Event, at_once: Callable[[], None]) -> None:
    """Have SIGTERM, SIGINT and SIGHUP set an event.

    The end of a terminal brings several SIGHUP, and none to a process that was started to outlive
    it (`nohup`).

    Parameters
    ----------
    at_once : callable
        Called when SIGTERM or SIGINT comes after another of these signals.
    """
    told = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal told
        if told and number != signal.SIGHUP:
            at_once()
        if not told:
            # In this thread the signal may have come inside `stopped.wait`, whose lock is held.
            threading.Thread(target=stopped.set, name="ending", daemon=True).start()
        told = True

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handle)
