"""Handlers of the signals that end a process: cleanly at the first, at once at the second."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Mapping
from functools import partial
from types import FrameType
from typing import TypeAlias

Handler: TypeAlias = "Callable[[int, FrameType | None], object] | int | None"


def end_when_told(
    stopped: threading.Event,
    at_once: Callable[[], None],
    again: Callable[[], object] | None = None,
) -> None:
    """Set an event at SIGTERM, SIGINT or SIGHUP; call `at_once` at a later SIGTERM or SIGINT.

    A closing terminal sends several SIGHUP, so a repeated SIGHUP has no effect. A process that
    ignores SIGHUP (`nohup`) keeps ignoring it. A process that leads a session has no terminal (a
    service, or started by `dwell live up`): SIGHUP then calls `again` in a thread, if given.
    """
    told = False
    ending = [signal.SIGTERM, signal.SIGINT]
    if again is not None and os.getsid(0) == os.getpid():
        start_again = partial(threading.Thread, target=again, name="again", daemon=True)
        signal.signal(signal.SIGHUP, lambda *_: start_again().start())
    elif signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        ending.append(signal.SIGHUP)

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal told
        if told and number != signal.SIGHUP:
            at_once()
        if not told:
            # The signal may interrupt `stopped.wait`, which holds the lock in this thread.
            threading.Thread(target=stopped.set, name="ending", daemon=True).start()
        told = True

    usual: dict[int, Handler] = {number: signal.signal(number, handle) for number in ending}
    _restore_in_children(handle, usual)


def _restore_in_children(handle: Handler, usual: Mapping[int, Handler]) -> None:
    """Restore the previous handlers in children that this process forks.

    SIGTERM must end a child of a stage, even right after the fork. So the signals are blocked
    during the fork, until the child has its handlers.
    """
    masks = threading.local()

    def block() -> None:
        masks.before = signal.pthread_sigmask(signal.SIG_BLOCK, usual)

    def unblock() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, masks.before)

    def restore() -> None:
        for number, handler in usual.items():
            if signal.getsignal(number) is handle:
                signal.signal(number, handler)
        unblock()

    os.register_at_fork(before=block, after_in_parent=unblock, after_in_child=restore)
