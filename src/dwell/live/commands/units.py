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
from dwell.live.log import say
from dwell.model import Problem

#: Files and connections that a process of a cell may have open: what only connects, and says
#: nothing, must not keep it from its work.
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
#: Settings of each service beside those that both have.
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
#: Where systemd puts the folder that StateDirectory= names.
STATE = "${STATE_DIRECTORY}"
#: Signs that end a word, or mean something in one.
SPECIAL = frozenset(" \t\"'\\;")
#: Signs that the name of a unit has as they are.
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
    """Return the units of a node by the names of their files.

    Parameters
    ----------
    cell : Path
        The cell file, as the services shall read it.
    user : str
        Name of the user that the services run as.
    program : sequence of str
        Command that is `dwell`.

    Raises
    ------
    ProblemError
        If the cell has no such node.
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

    state = f"{STATE}/{problem.name}/{node}"
    agent = ("agent", "--node", node, "--cell", str(cell), "--state", state)
    called = f"Dwell agent of node {node} of cell {problem.name}"
    name = f"dwell-agent@{escaped_name(problem.name)}-{escaped_name(node)}.service"
    units = {name: unit(called, agent, AGENT, beside=" time-sync.target")}
    if node == problem.controller_node:
        files = ("--out", f"{STATE}/runs", "--state", STATE)
        controller = ("controller", "--cell", str(cell), *files)
        called = f"Dwell controller of cell {problem.name}"
        name = f"dwell-controller@{escaped_name(problem.name)}.service"
        units[name] = unit(called, controller, CONTROLLER)
    return units


def escaped_name(name: str) -> str:
    """Return a name as part of the name of a unit, as systemd-escape(1) writes it."""
    return "".join(
        sign if PLAIN_SIGN.fullmatch(sign) and (sign, i) != (".", 0) else _hexadecimal(sign)
        for i, sign in enumerate(name)
    )


def _hexadecimal(sign: str) -> str:
    return "".join(f"\\x{byte:02x}" for byte in sign.encode())


def _escaped(text: str) -> str:
    """Return a text in which systemd expands no specifier."""
    return text.replace("%", "%%")


def _quoted(word: str, *, command: bool = False) -> str:
    """Return a word as a unit has it: one word, whatever signs it has (systemd.syntax(7))."""
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
    """Write the units of a node, and have systemd look at them where there is one.

    Raises
    ------
    ProblemError
        If the cell has no such node.
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
    """Return what systemd has to say against units; nothing where it is not installed."""
    program = shutil.which("systemd-analyze")
    if program is None:
        return []
    done = subprocess.run(  # noqa: S603 - found by its name
        [program, "verify", *map(str, files)], capture_output=True, text=True, check=False
    )
    return [line for line in done.stderr.splitlines() if any(file.name in line for file in files)]
