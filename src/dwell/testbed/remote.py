"""A process that stands here for a command on another host, and ends that when it is ended.

A signal does not cross ssh. So the shell on the other side waits for the end of its standard input,
which is this process's to close: on SIGTERM, when the owner of the cell has ended, and by ending
itself, however it does. Then it tells its command to end, and this process ends with the same code
once that has.

Run as ``python -m dwell.testbed.remote SETTINGS``, JSON: ``run`` (words before a command line, as
``ssh host``), ``script`` (that line) and ``owner`` (id of the process that this one ends with).
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from types import FrameType

from dwell.live.parent_death import end_with_owner

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


def local_words(run: Sequence[str], script: str) -> list[str]:
    """Return the command that stands for it on this computer, and ends with this process."""
    settings = json.dumps({"run": list(run), "script": script, "owner": os.getpid()})
    return [sys.executable, "-P", "-m", "dwell.testbed.remote", settings]


def main() -> int:
    """Run the script on the other side; return its code."""
    settings = json.loads(sys.argv[1])
    command = [*settings["run"], settings["script"]]
    process = subprocess.Popen(command, stdin=subprocess.PIPE)  # noqa: S603 - the inventory's
    assert process.stdin is not None  # noqa: S101 - it was asked for
    handle = process.stdin.fileno()
    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ended.set()

    signal.signal(signal.SIGTERM, end)
    end_with_owner(ended, settings["owner"])

    def close() -> None:
        ended.wait()
        os.close(handle)

    threading.Thread(target=close, name="end", daemon=True).start()
    return process.wait()


if __name__ == "__main__":
    code = main()
    # The standard input may be closed already; nothing is to be flushed.
    os._exit(code if code >= 0 else 128 - code)
