"""A process on another host, as if it ran here: it ends when it is told to, or its owner ends.

A signal does not cross ssh. So the shell on the other side waits for the end of its standard input,
which this process closes: when it tells the command to end, and by ending itself, however it does.
Then the shell tells its command to end, and ends with the same code once that has.
"""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

#: Word of a command that stands for the process id of the shell on the other side.
SHELL_ID = "$$"
#: 3 is the other side's standard input; a command in the background has none.
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
    """Return a script with which the shell of another host runs a command.

    Parameters
    ----------
    words : sequence of str
        The command; `SHELL_ID` among them becomes the shell's process id.
    folder : str
        Where it runs.
    environment : mapping of str to str
        Variables that it gets.
    whole : bool
        Whether those that it starts are told to end, too.
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
        Words that run a script over there, as ``ssh host``, and that of `script_of`.
    **options
        As of `Popen`.
    """

    def __init__(self, words: Sequence[str], **options: Any) -> None:
        super().__init__(words, **{**options, "stdin": subprocess.PIPE})

    def terminate(self) -> None:
        """Tell the command to end."""
        if self.stdin is not None:
            self.stdin.close()
