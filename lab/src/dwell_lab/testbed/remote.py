"""Processes on other hosts, which end on `terminate` or when this process ends.

A signal does not cross ssh. Therefore the remote shell waits for the end of its standard input.
This process closes that input in `terminate`, and also by ending in any way. The shell then sends
SIGTERM to its command, waits for it, and returns its exit code.
"""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

#: Placeholder in a command for the process id of the remote shell.
SHELL_ID = "$$"
#: Descriptor 3 is the remote shell's standard input; a command in the background has none.
SCRIPT = """exec 3<&0
cd {folder} || exit 1
{environment}
{command} </dev/null 3<&- &
command=$!
{{ cat <&3; kill -TERM {whole}$command; }} >/dev/null 2>&1 &
waiting=$!
wait $command
code=$?
kill $waiting 2>/dev/null
exit $code"""


def script_of(
    words: Sequence[str], folder: str, environment: Mapping[str, str], *, whole: bool = False
) -> str:
    """Return a shell script that runs a command on another host.

    Parameters
    ----------
    words : sequence of str
        The command; the shell's process id replaces `SHELL_ID`.
    folder : str
        Working directory.
    environment : mapping of str to str
        Environment variables.
    whole : bool
        Whether SIGTERM is also sent to the command's children.
    """
    pairs = [f"{name}={shlex.quote(value)}" for name, value in environment.items()]
    given = ["setsid", *words] if whole else words
    command = " ".join(word if word == SHELL_ID else shlex.quote(word) for word in given)
    return SCRIPT.format(
        folder=shlex.quote(folder),
        environment=" ".join(["export", *pairs]) if pairs else ":",
        command=command,
        whole="-" if whole else "",
    )


class RemoteProcess(subprocess.Popen[bytes]):
    """A command on another host, which ends with this process.

    Parameters
    ----------
    words : sequence of str
        Command that runs a script on the host, such as ``ssh host``, then the script of
        `script_of`.
    **options
        Options of `Popen`.
    """

    def __init__(self, words: Sequence[str], **options: Any) -> None:
        super().__init__(words, **{**options, "stdin": subprocess.PIPE})

    def terminate(self) -> None:
        """Close the standard input, which ends the command."""
        if self.stdin is not None:
            self.stdin.close()
