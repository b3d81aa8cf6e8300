"""Signals that tell a process to end in good order, and those that end it at once."""

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
    """Have SIGTERM, SIGINT and SIGHUP set an event.

    The end of a terminal brings several SIGHUP, and none to a process that was started to outlive
    it (`nohup`).

    Parameters
    ----------
    at_once : callable
        Called when SIGTERM or SIGINT comes after another of these signals.
    again : callable, optional
        Called in a thread at SIGHUP instead, if the process leads a session: a service, or what
        `dwell live up` has started, has no terminal.
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
            # In this thread the signal may have come inside `stopped.wait`, whose lock is held.
            threading.Thread(target=stopped.set, name="ending", daemon=True).start()
        told = True

    usual: dict[int, Handler] = {number: signal.signal(number, handle) for number in ending}
    _restore_in_children(handle, usual)


def _restore_in_children(handle: Handler, usual: Mapping[int, Handler]) -> None:
    """Restore the usual handlers in children that this process forks.

    A child of a stage has to end when it is terminated, also right after its start: the signals
    are blocked until the child has its handlers.
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
