"""The command `dwell`: arguments, progress, exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from dwell.errors import ExitCode

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit with its code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after ``dwell``; by default the words of this process.
    """
    # Pydantic would look for plugins in all that is installed; Dwell uses none.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        # Here, since the workers of a study import this module with the script that they are of.
        from dwell.cli.commands import app
        from dwell.cli.completion import LINE, learn_shells

        if LINE in os.environ:
            learn_shells()

        app(arguments, prog_name="dwell")
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)
    finally:
        # CPython records an interrupt inside `exec` of a text (a dataclass), and then ends
        # `python -m` by SIGINT even if it was handled. The next `exec` deletes the record.
        exec("")  # noqa: S102
