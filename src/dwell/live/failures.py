"""Failures: no exception in a callback or a thread of the live parts ends something in silence.

Whoever hands messages on tells of one that could not be handled, and goes on with the next. A
thread that has failed has no next: its process ends with exit code 1, and whoever keeps that
running, an agent or an init system, starts it again.
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

#: Exit code of a process that cannot go on.
FAILED = 1


def end_process(what: str, error: BaseException) -> NoReturn:
    """End this process at once because something cannot go on, and say on stderr what.

    Nothing is tidied up: a thread that hangs must not keep it alive.

    Parameters
    ----------
    what : str
        Part of the process that has failed.
    """
    # There may be no memory left to say it, and no room where it is said.
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


def start_thread(name: str, run: Callable[..., object], *arguments: object) -> threading.Thread:
    """Start a thread that ends its process where it fails, and with the process."""

    def watched() -> None:
        try:
            run(*arguments)
        except BaseException as error:  # also a SystemExit, which threads pass over in silence
            end_process(f"thread {name!r}", error)

    thread = threading.Thread(target=watched, name=name, daemon=True)
    thread.start()
    return thread
