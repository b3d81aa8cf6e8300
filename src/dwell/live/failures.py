"""Failures: every exception in a callback or thread of the live runtime is reported.

If a callback fails, its caller reports the error and continues with the next message. If a thread
fails, its process ends with exit code 1, and its supervisor, an agent or an init system, starts it
again.
"""

from __future__ import annotations

import os
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

from dwell.errors import describe_raised

#: Exit code of a process that cannot continue.
FAILED = 1


def end_process(what: str, error: BaseException) -> NoReturn:
    """End this process at once after the failure of one of its parts, and report it on stderr.

    The process ends without cleanup, because a hanging thread must not keep it alive.
    """
    # Reporting may fail too, without memory or on a full disk.
    with suppress(BaseException):
        traceback.print_exception(error)
        print(
            f"{what} failed: {describe_raised(error)}; the process ends",
            file=sys.stderr,
            flush=True,
        )
    with suppress(BaseException):
        sys.stdout.flush()
    os._exit(FAILED)


def start_repeating(
    name: str, every_s: float, stopped: threading.Event, act: Callable[[], object]
) -> threading.Thread:
    """Start a thread that calls a function once per `every_s`, until `stopped` is set."""

    def repeat() -> None:
        while not stopped.wait(every_s):
            act()

    return start_thread(name, repeat)


def start_thread(name: str, run: Callable[..., object], *arguments: object) -> threading.Thread:
    """Start a daemon thread that ends the process if it fails."""

    def watched() -> None:
        try:
            run(*arguments)
        except BaseException as error:  # also SystemExit, which threads otherwise ignore
            end_process(f"thread {name!r}", error)

    thread = threading.Thread(target=watched, name=name, daemon=True)
    thread.start()
    return thread
