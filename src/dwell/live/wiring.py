"""Who is there in a live cell, where each listens, and who connects to whom.

Everything here follows from the cell file alone, so that every process of a cell works it out for
itself and all come to the same answer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Literal, TypeAlias

from dwell.errors import LiveError
from dwell.live.transport.protocol import Lane
from dwell.model import Flow, FrozenDict, Problem

__all__ = [
    "IMAGE_BYTES",
    "PORTS_PER_ROLE",
    "SESSIONS",
    "Detour",
    "Endpoint",
    "Entry",
    "Host",
    "Kind",
    "Role",
    "Session",
    "Wire",
    "Wiring",
    "roles",
    "session_of",
    "wire",
]

Kind: TypeAlias = Literal[
    "stamper", "sink", "agent", "worker", "shadow", "standby", "controller", "visitor"
]
#: `control` carries what is small, `images` payloads to other nodes, `local` those that stay.
Session: TypeAlias = Literal["control", "images", "local"]

SESSIONS: tuple[Session, ...] = ("control", "images", "local")
#: Flows with at least this much declared go over the lane `images`.
IMAGE_BYTES = 16_384
#: A process listens on its first port for `control`, and on the next ones for the other sessions.
PORTS_PER_ROLE = len(SESSIONS)

_LAST_PORT = 65_535
_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Host:
    """Where the processes of a node listen.

    Parameters
    ----------
    address : str
        Name or IP address under which the other nodes reach it.
    port : int
        First of three ports for each of its processes.
    """

    address: str
    port: int


@dataclass(frozen=True, slots=True)
class Role:
    """One process of a cell.

    Parameters
    ----------
    who : str
        Its name, unique in the cell: ``perception@E``, ``perception@E.shadow``, ``control@R2.1``,
        ``sink.control@R2``, ``stamper@R1``, ``agent@E``, ``controller@E``.
    node : str
    kind : str
    task : str
        Of a worker or sink; empty for the others.
    index : int
        Of a standby, from 1; 0 for everybody else.
    """

    who: str
    node: str
    kind: Kind
    task: str = ""
    index: int = 0

    @property
    def works(self) -> bool:
        """Whether it executes jobs."""
        return self.kind in ("worker", "shadow", "standby")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a session listens, or is reached."""

    address: str
    port: int
    protocol: str = "tcp"

    def __str__(self) -> str:
        """Return the locator that Zenoh takes."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"{self.protocol}/{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class Wire:
    """A connection between two processes; messages travel it both ways.

    Parameters
    ----------
    session : str
    source, target : str
        Who connects, and who listens.
    """

    session: Session
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class Detour:
    """A port that something between two nodes has to listen on and pass on to another.

    Parameters
    ----------
    source, target : str
        Nodes: of who connects, and of who listens.
    session : str
    listen, to : Endpoint
    """

    source: str
    target: str
    session: Session
    listen: Endpoint
    to: Endpoint


@dataclass(frozen=True, slots=True)
class Entry:
    """What one process opens.

    Parameters
    ----------
    role : Role
    listen : mapping of str to Endpoint
        By session; those that nobody connects to are missing.
    connect : mapping of str to tuple of Endpoint
        By session.
    """

    role: Role
    listen: Mapping[Session, Endpoint]
    connect: Mapping[Session, tuple[Endpoint, ...]]

    def __post_init__(self) -> None:
        object.__setattr__(self, "listen", FrozenDict(self.listen))
        object.__setattr__(self, "connect", FrozenDict(self.connect))

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Those it has to open."""
        return tuple(name for name in SESSIONS if name in self.listen or name in self.connect)


@dataclass(frozen=True, slots=True)
class Wiring:
    """Everybody's ports and connections.

    Parameters
    ----------
    cell : str
    entries : mapping of str to Entry
        By who.
    wires : tuple of Wire
    detours : tuple of Detour
        What `via` asks something else to provide.
    """

    cell: str
    entries: Mapping[str, Entry]
    wires: tuple[Wire, ...]
    detours: tuple[Detour, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "entries", FrozenDict(self.entries))

    def entry(self, who: str) -> Entry:
        """Return what a process opens.

        Raises
        ------
        LiveError
            If the cell has no such process.
        """
        if who not in self.entries:
            known = ", ".join(self.entries)
            raise LiveError(f"cell {self.cell!r} has no process {who!r}; there are {known}")
        return self.entries[who]

    def on(self, node: str) -> tuple[Role, ...]:
        """Processes of a node."""
        return tuple(entry.role for entry in self.entries.values() if entry.role.node == node)

    def connected(self, one: str, other: str) -> frozenset[Session]:
        """Sessions in which two processes hear each other."""
        pairs = (one, other), (other, one)
        return frozenset(wire.session for wire in self.wires if (wire.source, wire.target) in pairs)

    def hears(self, source: str, target: str, lane: Lane, key: str) -> bool:
        """Whether what one process puts can reach another at all."""
        entry = self.entry(source)
        return session_of(entry, lane, key) in self.connected(source, target)

    def visitor(self, who: str, to: str) -> Entry:
        """Return what a process that is no part of the cell opens to talk to one that is."""
        host = self.entry(to)
        if "control" not in host.listen:
            raise LiveError(f"{to} of cell {self.cell!r} does not listen to anybody")
        role = Role(who, host.role.node, "visitor")
        return Entry(role, {}, {"control": (host.listen["control"],)})


def roles(problem: Problem) -> tuple[Role, ...]:
    """Every process of a cell, in the order in which ports are given out.

    Later ones connect to earlier ones: first those that hardly ever start anew, then workers along
    the flows, last the controller, which may come and go.

    Parameters
    ----------
    problem : Problem
    """
    pipeline = problem.pipeline
    order = pipeline.topological()
    source = next(task for task in order if not pipeline.inputs(task))
    stamper = next(iter(pipeline.tasks[source].on))
    found = [Role(f"stamper@{stamper}", stamper, "stamper")]
    found += [
        Role(f"sink.{task}@{node}", node, "sink", task)
        for task in order
        if not pipeline.outputs(task)
        for node in pipeline.tasks[task].on
    ]
    found += [Role(f"agent@{node}", node, "agent") for node in problem.fabric.nodes]
    shadows = _shadows(problem)
    for task in order:
        for node, execution in pipeline.tasks[task].on.items():
            found.append(Role(f"{task}@{node}", node, "worker", task))
            if (task, node) in shadows:
                found.append(Role(f"{task}@{node}.shadow", node, "shadow", task))
            standby: int = getattr(execution, "standby", 0)
            found += [
                Role(f"{task}@{node}.{index}", node, "standby", task, index)
                for index in range(1, standby + 1)
            ]
    node = problem.controller_node
    found.append(Role(f"controller@{node}", node, "controller"))
    return tuple(found)


def wire(
    problem: Problem,
    hosts: Mapping[str, Host],
    *,
    via: Mapping[tuple[str, str], int] | None = None,
    relay: str | None = None,
    protocol: str = "tcp",
) -> Wiring:
    """Work out the ports and connections of a cell.

    Parameters
    ----------
    problem : Problem
    hosts : mapping of str to Host
        By node.
    via : mapping of (str, str) to int, optional
        Pairs of nodes, in either order, whose connections go to 127.0.0.1 and that much above the
        port, where something passes them on.
    relay : str, optional
        Node whose agent takes the second path; the controller's where None.
    protocol : str
        Zenoh's name of what carries the sessions.

    Raises
    ------
    LiveError
        With everything that is missing or clashes.
    """
    offsets = {frozenset(pair): offset for pair, offset in (via or {}).items()}
    relay = problem.controller_node if relay is None else relay
    everybody = roles(problem)
    _require_hosts(problem, everybody, hosts, offsets, relay)
    by_who = {role.who: role for role in everybody}
    rank = {role.who: i for i, role in enumerate(everybody)}
    ports = _ports(everybody, hosts)

    wires = _wires(problem, everybody, relay)
    listen: dict[str, dict[Session, Endpoint]] = {who: {} for who in by_who}
    connect: dict[str, dict[Session, list[Endpoint]]] = {who: {} for who in by_who}
    detours: dict[Endpoint, Detour] = {}
    laid = []
    for session, pair in wires:
        target, source = sorted(pair, key=rank.__getitem__)
        laid.append(Wire(session, source, target))
        there, here = by_who[target].node, by_who[source].node
        port = ports[target] + SESSIONS.index(session)
        end = Endpoint(hosts[there].address, port, protocol)
        listen[target][session] = end
        offset = offsets.get(frozenset((here, there)))
        if offset is not None and here != there:
            between = Endpoint(_LOOPBACK, port + offset, protocol)
            detours[between] = Detour(here, there, session, between, end)
            end = between
        connect[source].setdefault(session, []).append(end)
    entries = {
        who: Entry(role, listen[who], {name: tuple(ends) for name, ends in connect[who].items()})
        for who, role in by_who.items()
    }
    wiring = Wiring(problem.name, entries, tuple(laid), tuple(detours.values()))
    _require_apart(wiring)
    return wiring


def session_of(entry: Entry, lane: Lane, key: str) -> Session:
    """Session that a process sends a message in.

    Parameters
    ----------
    entry : Entry
    lane : str
    key : str
        ``dwell/CELL/in/TASK/NODE/...`` or ``dwell/CELL/state/TASK/NODE`` where the lane is
        `images`: what stays on the node goes through `local`.

    Returns
    -------
    str
        `control` where the process has no other: it is slower than the lane should be, not lost.
    """
    if lane == "images":
        chunks = key.split("/")
        stays = len(chunks) > 4 and chunks[4] == entry.role.node
        session: Session = "local" if stays else "images"
        if session in entry.listen or session in entry.connect:
            return session
    return "control"


def _shadows(problem: Problem) -> frozenset[tuple[str, str]]:
    """Where shadow jobs may run: tasks on nodes, sinks left out, as a shadow stops before them."""
    settings = problem.controller
    if settings.estimator == "profile" and not settings.fallbacks:
        return frozenset()
    pipeline = problem.pipeline
    return frozenset(
        (task, other[task])
        for active, other in permutations(problem.candidates.values(), 2)
        for task in pipeline.diverging(active, other)
        if pipeline.outputs(task)
    )


def _wires(
    problem: Problem, everybody: Sequence[Role], relay: str
) -> list[tuple[Session, frozenset[str]]]:
    """Every pair that has to hear each other, by session; each once, in a fixed order."""
    found: dict[tuple[Session, frozenset[str]], None] = {}
    for one, other in combinations(everybody, 2):
        if _meet(problem, one, other, relay):
            found["control", frozenset((one.who, other.who))] = None
    for flow in problem.pipeline.flows:
        for one in _workers(everybody, flow.source):
            for other in _workers(everybody, flow.target):
                session = _session(flow, one, other)
                found[session, frozenset((one.who, other.who))] = None
    for task in problem.pipeline.tasks.values():
        large = task.state_bytes >= IMAGE_BYTES
        for one, other in combinations(_workers(everybody, task.name), 2):
            if one.node != other.node:
                found["images" if large else "control", frozenset((one.who, other.who))] = None
    return list(found)


def _workers(everybody: Iterable[Role], task: str) -> list[Role]:
    return [role for role in everybody if role.works and role.task == task]


def _session(flow: Flow, one: Role, other: Role) -> Session:
    if flow.payload_bytes < IMAGE_BYTES:
        return "control"
    return "local" if one.node == other.node else "images"


def _meet(problem: Problem, one: Role, other: Role, relay: str) -> bool:
    """Whether two processes have small things to say to each other, stages' messages aside."""
    return any(_calls(problem, *pair, relay) for pair in ((one, other), (other, one)))


def _calls(problem: Problem, one: Role, other: Role, relay: str) -> bool:
    """Whether the first is of a kind that has to reach the second."""
    same_node = one.node == other.node
    match one.kind:
        case "stamper":  # it stamps, and hears from everybody whether they are there
            return True
        case "agent":  # supervises its own node, and is the detour of all others
            return other.kind == "agent" or same_node or one.node == relay
        case "sink":  # takes the commands of its task's workers
            return other.kind == "controller" or (other.works and other.task == one.task)
        case "controller":  # is told of completions, of loads, and of shadows where they end
            if other.kind in ("agent", "shadow"):
                return True
            return other.works and not problem.pipeline.outputs(other.task)
    return False


def _ports(everybody: Iterable[Role], hosts: Mapping[str, Host]) -> dict[str, int]:
    """First port of everybody, by order on the node."""
    free = {node: host.port for node, host in hosts.items()}
    ports = {}
    for role in everybody:
        ports[role.who] = free[role.node]
        free[role.node] += PORTS_PER_ROLE
    return ports


def _require_hosts(
    problem: Problem,
    everybody: Sequence[Role],
    hosts: Mapping[str, Host],
    offsets: Mapping[frozenset[str], int],
    relay: str,
) -> None:
    nodes = problem.fabric.nodes
    known = ", ".join(nodes)
    faults = [f"live.hosts.{node}: missing; give its address and first port" for node in nodes]
    faults = [fault for fault, node in zip(faults, nodes, strict=True) if node not in hosts]
    faults += [f"live.hosts.{n}: no such node; there are {known}" for n in hosts if n not in nodes]
    for node, host in hosts.items():
        count = PORTS_PER_ROLE * sum(role.node == node for role in everybody)
        last = _LAST_PORT + 1 - count
        if not 1 <= host.port <= last:
            faults.append(
                f"live.hosts.{node}.port: {host.port} is not from 1 to {last}; "
                f"{count} ports are needed"
            )
    for pair in offsets:
        text = "-".join(sorted(pair))
        if len(pair) != 2 or not pair <= set(nodes):
            faults.append(f"live.via.{text}: not two of the nodes {known}")
    if relay not in nodes:
        faults.append(f"live.relay: no node {relay!r}; there are {known}")
    if faults:
        raise LiveError("\n".join(faults))


def _require_apart(wiring: Wiring) -> None:
    """Raise a LiveError where two would listen on one port of one address."""
    taken: dict[tuple[str, int], str] = {}
    faults = []
    for who, entry in wiring.entries.items():
        for session, end in entry.listen.items():
            text = f"{who} ({session})"
            other = taken.setdefault((end.address, end.port), text)
            if other != text:
                faults.append(f"{other} and {text} would both listen on {end}")
    for detour in wiring.detours:
        end, text = detour.listen, f"the link between {detour.source} and {detour.target}"
        other = taken.setdefault((end.address, end.port), f"{text} to {detour.to}")
        if other != f"{text} to {detour.to}":
            faults.append(f"{other} and {text} would both listen on {end}")
        if end.port > _LAST_PORT:
            faults.append(f"{text} would listen on port {end.port}; the last is {_LAST_PORT}")
    if faults:
        lines = "\n".join(faults)
        raise LiveError(f"{lines}\nchange live.hosts or live.via: 3 ports a process, apart")
