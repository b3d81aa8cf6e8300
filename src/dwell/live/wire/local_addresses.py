"""Addresses and ports of this computer, and the processes that listen on them."""

from __future__ import annotations

import errno
import os
import socket
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from dwell.cellfile import load_without_traces
from dwell.errors import DwellError
from dwell.model import Problem

#: State of a socket that listens, in /proc/net/tcp.
LISTENS = "0A"


def is_here(address: str) -> bool:
    """Return whether an address or host name belongs to this computer."""
    try:
        _bind(address, 0)
    except OSError:
        return False
    return True


def why_not_listen(address: str, port: int) -> str:
    """Return the reason that a process cannot listen at an address, and a fix; empty if it can.

    `address` is an IP address or a host name, as in `live.hosts`.
    """
    try:
        _bind(address, port)
    except socket.gaierror as error:
        why = (error.strerror or str(error)).lower()
        return (
            f"{address!r} cannot be resolved to an address ({why}); correct it in live.hosts, or "
            "have this computer's /etc/hosts or DNS know it"
        )
    except OSError as error:
        return {
            errno.EADDRINUSE: (
                f"port {port} of {address} is taken, by an older process, another agent of the "
                "node or another cell; end it, or give the node another port in live.hosts"
            ),
            errno.EADDRNOTAVAIL: (
                f"{address} is no address of this computer; is this another node's, or has the "
                "address changed?"
            ),
        }.get(error.errno or 0, f"port {port} of {address} cannot be had ({error.strerror})")
    return ""


def _bind(address: str, port: int) -> None:
    kind, *_, place = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(kind) as probe:
        # Old connections of an ended process do not block its port.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(place)


def listening_ports() -> dict[int, str]:
    """Return the ports in use by listeners, with the inodes of their sockets (proc_net(5))."""
    inodes = {}
    for file in ("/proc/net/tcp", "/proc/net/tcp6"):
        with suppress(OSError):
            for line in Path(file).read_text(encoding="utf-8").splitlines()[1:]:
                words = line.split()
                if words[3] == LISTENS:
                    inodes[int(words[1].rpartition(":")[2], 16)] = words[9]
    return inodes


def owners_of(inodes: Iterable[str]) -> dict[str, str]:
    """Return the process of each socket, by inode; other users' processes may be hidden."""
    wanted, owners = set(inodes), {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
            for file in (process / "fd").iterdir():
                with suppress(OSError):
                    inode = os.readlink(file).removeprefix("socket:[").removesuffix("]")
                    if inode in wanted:
                        line = " ".join([Path(words[0]).name, *words[1:]]).strip()
                        owners[inode] = f"{textwrap.shorten(line, 60)} (process {process.name})"
    return owners


def running_elsewhere(problem: Problem) -> str:
    """Return a sentence with the cell file of a cell that runs here with other addresses, or "".

    `dwell live run CELL` gives a cell different ports from those in its file.
    """
    for file in _controlled_cells():
        with suppress(DwellError, OSError):
            other = load_without_traces(file)
            if other.name == problem.name and other.live.hosts != problem.live.hosts:
                return f"It runs here with other ports: name {file}."
    return ""


def _controlled_cells() -> Iterator[Path]:
    """Yield the cell files of the controllers that run in this network namespace."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError):
            words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
            if "controller" in words and (process / "ns/net").samefile("/proc/self/ns/net"):
                yield Path(os.readlink(process / "cwd"), words[words.index("--cell") + 1])


def taken_ports(wanted: Iterable[int]) -> str:
    """Return the ports in use and their processes: ``7450, 7451 by NAME (process 7)``."""
    wanted = set(wanted)
    taken = {port: inode for port, inode in listening_ports().items() if port in wanted}
    owners = owners_of(taken.values())
    ports: dict[str, list[str]] = {}
    for port, inode in sorted(taken.items()):
        ports.setdefault(owners.get(inode, "another user's process"), []).append(str(port))
    return "; ".join(f"{', '.join(some)} by {owner}" for owner, some in ports.items())
