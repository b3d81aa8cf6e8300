"""Exit codes of commands."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes, the same for every command."""

    #: All that was asked for is there.
    DONE = 0
    #: The work failed, or what was examined is not as it has to be.
    FAILED = 1
    #: The input is wrong: arguments, files, names.
    WRONG = 2
    #: By Ctrl-C.
    INTERRUPTED = 130
