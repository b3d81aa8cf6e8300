"""Inventory: which real host each node of a cell is, and how commands get there.

```yaml
dwell-inventory: 1
hosts:
  R1: {run: ssh -o BatchMode=yes robot-1, address: 10.0.0.11, python: /opt/dwell/bin/python}
  E: {run: ssh -o BatchMode=yes edge, address: 10.0.0.2, cpus: 2-7}
links:
  R1->E:
    begin: sudo impair on {mean_ms} {std_ms} {loss_percent}
    end: sudo impair off
```
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any

import yaml

from dwell.errors import Fault, ProblemError
from dwell.model import Problem

VERSION = 1
FORMAT = "dwell-inventory"
FOLDER = "/var/tmp/dwell"  # noqa: S108 - on the hosts; a folder of the testbed's own is made in it
#: stress-ng, or as many busy loops.
STRESS = (
    "if command -v stress-ng >/dev/null; then exec stress-ng --quiet --cpu {threads}; fi; "
    "i=0; while [ $i -lt {threads} ]; do while :; do :; done & i=$((i + 1)); done; wait"
)
CPUS = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*")


@dataclass(frozen=True, slots=True)
class RealHost:
    """A host.

    Parameters
    ----------
    run : tuple of str
        Words that, with a line for a shell behind them, have it done there: ``ssh robot-1``.
    address : str
        Where its processes are reached from the other hosts.
    port : int
        First one.
    python : str
        The interpreter there that has this package, with the cell's stages.
    folder : str
        Where files may be put there.
    cpus : str
        CPUs that the cell may use, as ``2-7``; any where empty.
    stress : str
        Line for a shell that loads ``{threads}`` threads until it is told to end.
    """

    run: tuple[str, ...]
    address: str
    port: int = 7450
    python: str = "python3"
    folder: str = FOLDER
    cpus: str = ""
    stress: str = STRESS


@dataclass(frozen=True, slots=True)
class LinkCommands:
    """Lines for a shell on the host that a link leaves from.

    Parameters
    ----------
    begin : str
        With ``{mean_ms}``, ``{std_ms}`` of the extra delay, ``{loss_percent}``, ``{rate_mbps}``.
    """

    begin: str
    end: str


@dataclass(frozen=True, slots=True)
class Inventory:
    """The hosts of a cell.

    Parameters
    ----------
    hosts : mapping of str to RealHost
        By node.
    links : mapping of str to LinkCommands
        By directed link, ``R1->E``.
    """

    hosts: Mapping[str, RealHost]
    links: Mapping[str, LinkCommands]

    @property
    def digest(self) -> str:
        """Name by which a campaign knows these hosts."""
        document = json.dumps(asdict(self), sort_keys=True)
        digest = hashlib.sha256(document.encode()).hexdigest()[:16]
        return f"hosts {digest}"


def load_inventory(path: str | PathLike[str], problem: Problem) -> Inventory:
    """Read an inventory for a cell, every node of which has to be in it.

    Raises
    ------
    ProblemError
        With every fault.
    """
    source = str(path)
    try:
        document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ProblemError(f"cannot be read ({error.strerror})", source) from None
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ProblemError(f"is not YAML ({error})".replace("\n", " "), source) from None
    faults: list[Fault] = []
    found = _inventory(document, problem, faults)
    if faults or found is None:
        raise ProblemError(faults, source)
    return found


def _inventory(document: Any, problem: Problem, faults: list[Fault]) -> Inventory | None:
    if not isinstance(document, dict) or document.get(FORMAT) != VERSION:
        faults.append(Fault(FORMAT, f"must be {VERSION}: this is no inventory of this version"))
        return None
    _keys("", document, (FORMAT, "hosts", "links"), (), faults)
    hosts, links = (_mapping(document.get(key), key, faults) for key in ("hosts", "links"))
    nodes = list(problem.fabric.nodes)
    _keys("hosts", hosts, nodes, nodes, faults)
    _keys("links", links, list(problem.fabric.links), (), faults)
    return Inventory(
        {str(name): _host(f"hosts.{name}", host, faults) for name, host in hosts.items()},
        {str(name): _link(f"links.{name}", link, faults) for name, link in links.items()},
    )


def _mapping(value: Any, path: str, faults: list[Fault]) -> Mapping[Any, Any]:
    if value is None:
        return {}
    if isinstance(value, dict):
        return value
    faults.append(Fault(path, f"is {value!r}; it must be a mapping"))
    return {}


def _keys(
    path: str,
    given: Mapping[Any, Any],
    known: Collection[str],
    needed: Collection[str],
    faults: list[Fault],
) -> None:
    """Note unknown keys, and needed keys that are missing."""
    before = f"{path}." if path else ""
    faults += [
        Fault(f"{before}{key}", f"is unknown here; there may be {', '.join(known)}")
        for key in given
        if key not in known
    ]
    faults += [Fault(f"{before}{key}", "is missing") for key in needed if not given.get(key)]


def _host(path: str, value: Any, faults: list[Fault]) -> RealHost:
    given = _mapping(value, path, faults)
    _keys(path, given, [item.name for item in fields(RealHost)], ("run", "address"), faults)
    usual = asdict(RealHost((), ""))
    run, port = given.get("run", ""), given.get("port", usual["port"])
    texts: dict[str, Any] = {
        name: str(given.get(name, value)) for name, value in usual.items() if isinstance(value, str)
    }
    host = RealHost((), **texts)
    try:
        words = tuple(map(str, run)) if isinstance(run, list) else tuple(shlex.split(str(run)))
        host = replace(host, run=words)
    except ValueError as error:
        faults.append(Fault(f"{path}.run", f"is {run!r}, which is no command line ({error})"))
    if type(port) is not int or not 1 <= port <= 65_000:
        faults.append(Fault(f"{path}.port", f"is {port!r}; it must be in [1, 65000]"))
    if not host.folder.startswith("/"):
        faults.append(Fault(f"{path}.folder", f"is {host.folder!r}; it must begin with /"))
    if host.cpus and not CPUS.fullmatch(host.cpus):
        faults.append(Fault(f"{path}.cpus", f"is {host.cpus!r}; write 0,2-3"))
    if "{threads}" not in host.stress:
        faults.append(Fault(f"{path}.stress", "must say where the number goes: {threads}"))
    return replace(host, port=port)


def _link(path: str, value: Any, faults: list[Fault]) -> LinkCommands:
    given, keys = _mapping(value, path, faults), [item.name for item in fields(LinkCommands)]
    _keys(path, given, keys, keys, faults)
    commands = LinkCommands(*(str(given.get(key, "")) for key in keys))
    try:
        commands.begin.format(mean_ms=0, std_ms=0, loss_percent=0, rate_mbps=0)
    except (KeyError, IndexError, ValueError) as error:
        faults.append(Fault(f"{path}.begin", f"cannot be filled in ({error!r})"))
    return commands
