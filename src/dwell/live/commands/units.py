"""`dwell live units`: the systemd units of a node."""

from __future__ import annotations

import getpass
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from dwell.cli.output import write_file
from dwell.live.host.node_processes import agent_words, controller_words
from dwell.live.host.stage_modules import ros_topics
from dwell.live.log import say
from dwell.model import Problem

#: Most open files and connections of a process; large, as silent connections must not stop its
#: work.
MOST_FILES = 65_536

UNIT = """\
[Unit]
Description={description}
# It is started again for ever.
StartLimitIntervalSec=0
Wants=network-online.target{beside}
After=network-online.target{beside}

[Service]
Type=notify
User={user}
StateDirectory=dwell
{environment}ExecStart={command}
# Takes an edited cell file over.
ExecReload=/bin/kill -HUP $MAINPID
Restart=always
RestartSec=1
{settings}
[Install]
WantedBy=multi-user.target
"""
#: Additional settings of each service.
AGENT = f"""\
# An agent that hangs is replaced; its processes go on.
WatchdogSec=30
# The agent ends its processes itself. Should it die alone, they work on, and the next agent takes
# them over: systemd must not end them.
KillMode=process
TimeoutStopSec=15
LimitNOFILE={MOST_FILES}
# Shared memory for images is locked; without, they are copied through sockets.
LimitMEMLOCK=infinity
# For --realtime.
LimitRTPRIO=50
# The agent starts again what is killed for want of memory, and says so; by default systemd would
# end it, too.
OOMPolicy=continue
# An end for stages that leak, and CPUs of the whole node (--cpus-of pins single processes):
# MemoryMax=4G
# CPUAffinity=2-5
"""
CONTROLLER = f"""\
WatchdogSec=60
TimeoutStopSec=60
LimitNOFILE={MOST_FILES}
"""
#: Variable with the path of the folder that StateDirectory= names.
STATE = "${STATE_DIRECTORY}"
#: Characters that end a word, or have a special meaning in it.
SPECIAL = frozenset(" \t\"'\\;")
#: Characters that need no escape in the name of a unit.
PLAIN_SIGN = re.compile("[A-Za-z0-9:_.]")


def unit_texts(
    problem: Problem,
    node: str,
    cell: Path,
    *,
    user: str,
    keys: Path | None = None,
    insecure: bool = False,
    program: Sequence[str] = (sys.executable, "-m", "dwell"),
) -> dict[str, str]:
    """Return the units of a node by file name; raises a ProblemError if the node is unknown.

    The services run as `user`, read the file `cell`, and run `dwell` with the command `program`.
    """
    problem.require_node(node)
    variables = {} if keys is None else {"DWELL_KEYS": str(keys)}
    variables |= {"DWELL_INSECURE": "1"} if insecure else {}
    environment = "".join(
        f"Environment={_quoted(f'{name}={value}')}\n" for name, value in variables.items()
    )

    def unit(description: str, words: Sequence[str], settings: str, *, beside: str = "") -> str:
        return UNIT.format(
            description=_escaped(description),
            beside=beside,
            user=user,
            environment=environment,
            command=" ".join(_quoted(word, command=True) for word in (*program, *words)),
            settings=settings,
        )

    agent = agent_words(node, cell, f"{STATE}/{problem.name}/{node}")
    called = f"Dwell agent of node {node} of cell {problem.name}"
    name = f"dwell-agent@{escaped_name(problem.name)}-{escaped_name(node)}.service"
    units = {name: unit(called, agent, AGENT, beside=" time-sync.target")}
    if node == problem.controller_node:
        controller = controller_words(cell, f"{STATE}/runs", STATE)
        called = f"Dwell controller of cell {problem.name}"
        name = f"dwell-controller@{escaped_name(problem.name)}.service"
        units[name] = unit(called, controller, CONTROLLER)
        if ros_topics(problem, problem.fabric.nodes):
            called = f"ROS 2 diagnostics of cell {problem.name}"
            text = unit(called, ("ros2", "diagnostics", str(cell)), "")
            name = f"dwell-diagnostics@{escaped_name(problem.name)}.service"
            units[name] = text.replace("Type=notify", "Type=exec")
    return units


def escaped_name(name: str) -> str:
    """Return a name with the escapes of systemd-escape(1), for the name of a unit."""
    return "".join(
        sign if PLAIN_SIGN.fullmatch(sign) and (sign, i) != (".", 0) else _hexadecimal(sign)
        for i, sign in enumerate(name)
    )


def _hexadecimal(sign: str) -> str:
    return "".join(f"\\x{byte:02x}" for byte in sign.encode())


def _escaped(text: str) -> str:
    """Return a text with escaped specifiers of systemd."""
    return text.replace("%", "%%")


def _quoted(word: str, *, command: bool = False) -> str:
    """Return a word with the quotes and escapes of a unit (systemd.syntax(7))."""
    text = _escaped(word)
    if command:
        text = text.replace("$", "$$").replace(f"${STATE}", STATE)
    if text and SPECIAL.isdisjoint(text):
        return text
    text = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'


def write_units(
    problem: Problem,
    node: str,
    cell: Path,
    out: Path,
    *,
    user: str | None,
    keys: Path | None,
    insecure: bool,
) -> list[Path]:
    """Write the units of a node, and verify them with systemd if it is installed.

    Raises a ProblemError if the node is unknown.
    """
    texts = unit_texts(
        problem,
        node,
        cell.resolve(),
        user=user or getpass.getuser(),
        keys=None if keys is None else keys.resolve(),
        insecure=insecure,
    )
    files = []
    for name, text in texts.items():
        write_file(out / name, text)
        files.append(out / name)
    for line in verify(files):
        say(f"warning: systemd-analyze verify: {line}")
    return files


def verify(files: Sequence[Path]) -> list[str]:
    """Return systemd's complaints about units; empty if systemd is not installed."""
    program = shutil.which("systemd-analyze")
    if program is None:
        return []
    done = subprocess.run(  # noqa: S603 - found by its name
        [program, "verify", *map(str, files)], capture_output=True, text=True, check=False
    )
    return [line for line in done.stderr.splitlines() if any(file.name in line for file in files)]
