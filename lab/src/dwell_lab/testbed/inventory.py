"""Inventory: the real host of each node of a cell, and the command that reaches it.

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
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from os import PathLike, fspath
from typing import Any

from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import (
    Entry,
    MappingForm,
    WrittenForm,
    not_allowed,
    optional,
    required,
    shape_of,
)
from dwell.cellfile.structure import FileKind, read_structure
from dwell.cellfile.yaml_text import read_yaml
from dwell.model import Problem
from dwell.model.bounds import NOT_EMPTY, Bound, Pattern, require
from dwell.model.declaration import declared, key
from dwell.model.semantics import nearest

VERSION = 1
FORMAT = "dwell-inventory"
FOLDER = "/var/tmp/dwell"  # noqa: S108 - on the hosts; the testbed creates its own folder in it
#: stress-ng, or the same number of busy loops.
STRESS = (
    "if command -v stress-ng >/dev/null; then exec stress-ng --quiet --cpu {threads}; fi; "
    "i=0; while [ $i -lt {threads} ]; do while :; do :; done & i=$((i + 1)); done; wait"
)
CPUS = Pattern(r"(\d+(-\d+)?(,\d+(-\d+)?)*)?", "a list of CPUs, as 0,2-3")


@declared()
class RealHost:
    """A computer that runs a node."""

    run: tuple[str, ...] = key(
        "Command that runs a line of shell on the host, given as its last word: `ssh robot-1`."
    )
    address: str = key("Address of its processes for the other hosts.", NOT_EMPTY)
    port: int = key("First port.", Bound(1, 65_000, whole=True), default=7450)
    python: str = key(
        "The interpreter on the host, with this package and the cell's stages.", default="python3"
    )
    folder: str = key(
        "Folder for files on the host.", Pattern("/.*", "a path that begins with /"), default=FOLDER
    )
    cpus: str = key("CPUs that the cell may use, as `2-7`.", CPUS, default="", usual="any")
    stress: str = key(
        "Line of shell that loads `{threads}` threads until it is terminated.",
        Pattern(r"[\s\S]*{threads}[\s\S]*", "a line that contains {threads}"),
        default=STRESS,
        usual="stress-ng, or busy loops",
    )


@declared()
class LinkCommands:
    """Lines of shell, for the source host of a link."""

    begin: str = key(
        "Impairs the link, with `{mean_ms}`, `{std_ms}` of the extra delay, `{loss_percent}`, "
        "`{rate_mbps}`."
    )
    end: str = key("Ends the impairment.", NOT_EMPTY)

    def __post_init__(self) -> None:
        wrong = _wrong_places(self.begin)
        require(not wrong, "begin", self.begin, wrong)


def _wrong_places(line: str) -> str:
    """Return the requirement that an impairment line breaks; empty if it breaks none."""
    try:
        line.format(mean_ms=0, std_ms=0, loss_percent=0, rate_mbps=0)
    except (KeyError, IndexError, ValueError) as error:
        return f"a line with valid placeholders ({error!r})"
    return ""


def _impairing(value: Any) -> str:
    wrong = _wrong_places(value) if isinstance(value, str) and value else "a line for a shell"
    if wrong:
        raise ValueError(not_allowed(value, wrong))
    return str(value)


def _words(value: Any) -> tuple[str, ...]:
    if isinstance(value, list) and value and all(isinstance(word, str) for word in value):
        return tuple(value)
    remedy = "a command line, or a list of its words"
    try:
        words = tuple(shlex.split(value)) if isinstance(value, str) else ()
    except ValueError as error:
        remedy, words = f"{remedy} ({error})", ()
    if not words:
        raise ValueError(not_allowed(value, remedy))
    return words


HOST = shape_of(RealHost, {}, instead={"run": WrittenForm("text, list of texts", _words)})
LINK = shape_of(LinkCommands, {}, instead={"begin": WrittenForm("text", _impairing)})
INVENTORY = FileKind.of(
    "inventory",
    FORMAT,
    VERSION,
    "Inventory",
    "The hosts of a cell's nodes.",
    required("hosts", MappingForm(HOST, keeps=True), "The host of each node.", {}),
    optional("links", MappingForm(LINK, keeps=True), "Commands that impair a link.", "none"),
)


@dataclass(frozen=True, slots=True)
class Inventory:
    """The hosts of a cell by node, and the commands of its directed links (``R1->E``)."""

    hosts: Mapping[str, RealHost]
    links: Mapping[str, LinkCommands]

    @property
    def digest(self) -> str:
        """Identifier of these hosts in a campaign."""
        document = json.dumps(asdict(self), sort_keys=True)
        digest = hashlib.sha256(document.encode()).hexdigest()[:16]
        return f"hosts {digest}"


def load_inventory(path: str | PathLike[str], problem: Problem) -> Inventory:
    """Read an inventory for a cell; it must have a host for every node.

    Raises `ProblemError` with every fault.
    """
    faults = Faults(fspath(path))
    document = read_yaml(fspath(path), faults, INVENTORY.what, INVENTORY.begin)
    entry = read_structure(document, faults, INVENTORY)
    _judge("hosts", entry.hosts, problem.fabric.nodes, "node", faults)
    _judge("links", entry.links or {}, problem.fabric.links, "link", faults)
    for node in problem.fabric.nodes:
        if node not in entry.hosts:
            faults.add(f"hosts.{node}", "missing; add it: every node needs a host")
    hosts: Mapping[str, RealHost] = _made(entry.hosts, faults)
    links: Mapping[str, LinkCommands] = _made(entry.links or {}, faults)
    if faults:
        raise faults.error()
    return Inventory(hosts, links)


def _made(given: Mapping[str, Entry | None], faults: Faults) -> dict[str, Any]:
    return {
        name: faults.attempt(one.path, one.shape.kind, **one.values)
        for name, one in given.items()
        if one is not None
    }


def _judge(
    section: str,
    given: Mapping[str, object],
    known: Mapping[str, object],
    what: str,
    faults: Faults,
) -> None:
    for name in given:
        if name not in known:
            faults.add(f"{section}.{name}", f"unknown {what} {name!r}; {nearest(name, known)}")
