"""Who is there in a live cell, where each listens, and who connects to whom.

Everything here follows from the cell file alone, so that every process of a cell works it out for
itself and all come to the same answer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Literal, TypeAlias

from dwell.errors import LiveError
from dwell.live.wire.local_addresses import running_elsewhere
from dwell.live.wire.messages import MAX_CONTROL_BYTES, MAX_HEADER_BYTES
from dwell.live.wire.transport import Lane
from dwell.model import FrozenDict, Problem

Kind: TypeAlias = Literal[
    "stamper", "sink", "agent", "worker", "shadow", "standby", "controller", "visitor"
]
#: `control` carries what is small, `images` payloads to other nodes, `local` those that stay.
Session: TypeAlias = Literal["control", "images", "local"]

SESSIONS: tuple[Session, ...] = ("control", "images", "local")
#: Flows with at least this much declared go over the lane `images`.
IMAGE_BYTES = 16_384
#: How much longer a payload may be than the cell file says.
SPARE = 4
#: Of a message: its key, its signature, and what Zenoh writes with it.
ENVELOPE_BYTES = 4_096
#: A process listens on its first port for `control`, and on the next ones for the other sessions.
PORTS_PER_ROLE = len(SESSIONS)

_LAST_PORT = 65_535


@dataclass(frozen=True, slots=True)
class Role:
    """One process of a cell.

    Parameters
    ----------
    who : str
        Its name, unique in the cell: ``perception@E``, ``perception@E.shadow``, ``control@R2.1``,
        ``sink.control@R2``, ``stamper@R1``, ``agent@E``, ``controller@E``.
    task : str
        Task of a worker or sink; empty for the other kinds.
    index : int
        Number of a standby, from 1; 0 for the other kinds.
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
class Locator:
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
    source, target : str
        Process that connects, and process that listens.
    """

    session: Session
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class WiringEntry:
    """Endpoints that a process opens.

    Parameters
    ----------
    listen : mapping of str to Locator
        Endpoint by session; sessions that no process connects to are missing.
    connect : mapping of str to tuple of Locator
        Endpoints of others, by session.
    """

    role: Role
    listen: Mapping[Session, Locator]
    connect: Mapping[Session, tuple[Locator, ...]]

    def __post_init__(self) -> None:
        object.__setattr__(self, "listen", FrozenDict(self.listen))
        object.__setattr__(self, "connect", FrozenDict(self.connect))

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Sessions that the process has to open."""
        return tuple(name for name in SESSIONS if name in self.listen or name in self.connect)


@dataclass(frozen=True, slots=True)
class Wiring:
    """Ports and connections of all processes.

    Parameters
    ----------
    entries : mapping of str to WiringEntry
        By name of the process.
    """

    cell: str
    entries: Mapping[str, WiringEntry]
    wires: tuple[Wire, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "entries", FrozenDict(self.entries))

    def entry(self, who: str) -> WiringEntry:
        """Return the endpoints of a process.

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

    def peers(self, who: str) -> int:
        """Return how many processes a process is connected to, in the session with most of them."""
        counts = Counter(w.session for w in self.wires if who in (w.source, w.target))
        return max(counts.values(), default=0)

    def visitor(self, who: str, *to: str) -> WiringEntry:
        """Return the endpoints of a process outside the cell that talks to processes of it."""
        hosts = [self.entry(one) for one in to]
        for host in hosts:
            if "control" not in host.listen:
                raise LiveError(f"{host.role.who} of cell {self.cell!r} does not listen to anybody")
        role = Role(who, hosts[0].role.node, "visitor")
        return WiringEntry(role, {}, {"control": tuple(host.listen["control"] for host in hosts)})


def roles(problem: Problem) -> tuple[Role, ...]:
    """Every process of a cell, in the order in which ports are given out.

    Later ones connect to earlier ones: first those that hardly ever start anew, then workers along
    the flows, last the controller, which may come and go.
    """
    pipeline = problem.pipeline
    order = pipeline.topological()
    stamper = problem.stamper_node
    everybody = [Role(f"stamper@{stamper}", stamper, "stamper")]
    everybody += [
        Role(f"sink.{task}@{node}", node, "sink", task)
        for task in order
        if not pipeline.outputs(task)
        for node in pipeline.tasks[task].on
    ]
    everybody += [Role(f"agent@{node}", node, "agent") for node in problem.fabric.nodes]
    shadows = _shadows(problem)
    for task in order:
        for node, execution in pipeline.tasks[task].on.items():
            everybody.append(Role(f"{task}@{node}", node, "worker", task))
            if (task, node) in shadows:
                everybody.append(Role(f"{task}@{node}.shadow", node, "shadow", task))
            everybody += [
                Role(f"{task}@{node}.{index}", node, "standby", task, index)
                for index in range(1, execution.standby + 1)
            ]
    node = problem.controller_node
    everybody.append(Role(f"controller@{node}", node, "controller"))
    return tuple(everybody)


def wire(problem: Problem, *, protocol: str = "tcp") -> Wiring:
    """Work out the ports and connections of a cell.

    Parameters
    ----------
    problem : Problem
        With every node among `live.hosts`.
    protocol : str
        Zenoh's name of what carries the sessions.

    Raises
    ------
    LiveError
        With everything that is missing or clashes.
    """
    everybody = roles(problem)
    _require_hosts(problem, everybody)
    hosts = problem.live.hosts
    rank = {role.who: i for i, role in enumerate(everybody)}
    # Place of everybody on its node, from 0.
    counts, places = Counter[str](), dict[str, int]()
    for role in everybody:
        places[role.who] = counts[role.node]
        counts[role.node] += 1

    def locator(who: str, session: Session, seen_from: str | None = None) -> Locator:
        host = hosts[everybody[rank[who]].node]
        base = host if seen_from is None else host.endpoint(seen_from)
        port = base.port + PORTS_PER_ROLE * places[who] + SESSIONS.index(session)
        return Locator(base.address, port, protocol)

    listen: dict[str, dict[Session, Locator]] = {who: {} for who in rank}
    connect: dict[str, dict[Session, list[Locator]]] = {who: {} for who in rank}
    wires = []
    # Where what listens is seen from a node that does not reach it where it does.
    elsewhere: list[tuple[Locator, Locator]] = []
    for session, pair in _wires(problem, everybody):
        target, source = sorted(pair, key=rank.__getitem__)
        wires.append(Wire(session, source, target))
        here, there = everybody[rank[source]].node, everybody[rank[target]].node
        end = locator(target, session)
        seen = end if here == there else locator(target, session, here)
        if seen != end:
            elsewhere.append((seen, end))
        listen[target][session] = end
        connect[source].setdefault(session, []).append(seen)
    for role in everybody:
        if role.kind == "controller":  # somebody may want to ask it something
            listen[role.who]["control"] = locator(role.who, "control")
    entries = {
        role.who: WiringEntry(
            role,
            listen[role.who],
            {session: tuple(ends) for session, ends in connect[role.who].items()},
        )
        for role in everybody
    }
    _require_apart(entries, elsewhere)
    return Wiring(problem.name, entries, tuple(wires))


def lane_of(declared_bytes: int) -> Lane:
    """Lane of what a cell file declares that many bytes for: a flow, or a task's state."""
    return "images" if declared_bytes >= IMAGE_BYTES else "control"


def longest_bytes(declared_bytes: int) -> int:
    """Longest payload that is sent, and taken, where a cell file declares that many bytes.

    Parameters
    ----------
    declared_bytes : int
        Declared size of a flow, or of a task's state; 0 for a command, which declares none.
    """
    return max(SPARE * declared_bytes, MAX_CONTROL_BYTES)


def longest_message_bytes(problem: Problem, session: Session) -> int:
    """Longest message that anybody in a cell sends in a session: headers and key are in it."""
    pipeline = problem.pipeline
    declared = [flow.payload_bytes for flow in pipeline.flows]
    declared += [task.state_bytes for task in pipeline.tasks.values()]
    lane: Lane = "control" if session == "control" else "images"
    longest = max((longest_bytes(size) for size in declared if lane_of(size) == lane), default=0)
    return max(longest, MAX_CONTROL_BYTES) + MAX_HEADER_BYTES + ENVELOPE_BYTES


def session_of(entry: WiringEntry, lane: Lane, key: str) -> Session:
    """Session that a process sends a message in.

    Parameters
    ----------
    key : str
        ``dwell/CELL/in/TASK/NODE/...`` or ``dwell/CELL/state/TASK/NODE/...`` where the lane
        is `images`: what stays on the node goes through `local`.

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
    if not problem.controller.shadow_workers:
        return frozenset()
    pipeline = problem.pipeline
    return frozenset(
        (task, other[task])
        for active, other in permutations(problem.candidates.values(), 2)
        for task in pipeline.diverging(active, other)
        if pipeline.outputs(task)
    )


def _wires(problem: Problem, everybody: Sequence[Role]) -> list[tuple[Session, frozenset[str]]]:
    """Every pair that has to hear each other, by session; each once, in a fixed order."""
    pairs: dict[tuple[Session, frozenset[str]], None] = {}
    for one, other in combinations(everybody, 2):
        # Small things to say to each other, stages' messages aside.
        if _calls(problem, one, other) or _calls(problem, other, one):
            pairs["control", frozenset((one.who, other.who))] = None
    for flow in problem.pipeline.flows:
        for one in _workers(everybody, flow.source):
            for other in _workers(everybody, flow.target):
                session: Session = lane_of(flow.payload_bytes)
                if session == "images" and one.node == other.node:
                    session = "local"
                pairs[session, frozenset((one.who, other.who))] = None
    for task in problem.pipeline.tasks.values():
        state = lane_of(task.state_bytes)
        for one, other in combinations(_workers(everybody, task.name), 2):
            if one.node != other.node:
                pairs[state, frozenset((one.who, other.who))] = None
    return list(pairs)


def _workers(everybody: Iterable[Role], task: str) -> list[Role]:
    return [role for role in everybody if role.works and role.task == task]


def _calls(problem: Problem, one: Role, other: Role) -> bool:
    """Whether the first is of a kind that has to reach the second."""
    same_node = one.node == other.node
    match one.kind:
        case "stamper":  # it stamps, and hears from everybody whether they are there
            return True
        case "agent":  # supervises its own node, and is the passage of all others
            return other.kind == "agent" or same_node or one.node == problem.relay_node
        case "sink":  # takes the commands of its task's workers
            return other.kind == "controller" or (other.works and other.task == one.task)
        case "standby":  # works only while that one is silent
            return other.kind == "worker" and same_node and other.task == one.task
        case "controller":  # of completions, loads, shadows that stopped, states that moved
            if not other.works:
                return other.kind == "agent"
            task = problem.pipeline.tasks[other.task]
            stops = not problem.pipeline.outputs(other.task)
            return stops or (other.kind == "worker" and not task.anchored)
    return False


def _require_hosts(problem: Problem, everybody: Sequence[Role]) -> None:
    """Raise a LiveError unless every node has a host, and ports enough."""
    faults = []
    for node in problem.fabric.nodes:
        host = problem.live.hosts.get(node)
        if host is None:
            faults.append(f"live.hosts.{node}: missing; give its address and first port")
            continue
        count = PORTS_PER_ROLE * sum(role.node == node for role in everybody)
        last = _LAST_PORT + 1 - count
        seen = {f".seen_from.{other}": end.port for other, end in host.seen_from.items()}
        faults += [
            f"live.hosts.{node}{path}.port: {port} is above {last}; {count} ports are needed"
            for path, port in {"": host.port, **seen}.items()
            if port > last
        ]
    if faults:
        faults += filter(None, [running_elsewhere(problem)])
        raise LiveError("\n".join(faults))


def _require_apart(
    entries: Mapping[str, WiringEntry], elsewhere: Iterable[tuple[Locator, Locator]]
) -> None:
    """Raise a LiveError where one port of one address would stand for two things."""
    taken: dict[Locator, str] = {}
    faults = []

    def take(end: Locator, what: str) -> None:
        other = taken.setdefault(end, what)
        if other != what:
            faults.append(f"{other} and {what} are both at {end}")

    for who, entry in entries.items():
        for session, end in entry.listen.items():
            take(end, f"{who} ({session})")
    for seen, end in elsewhere:
        take(seen, f"the way to {end}")
    if faults:
        lines = "\n".join(faults)
        raise LiveError(
            f"{lines}\ngive live.hosts ports further apart: each process takes {PORTS_PER_ROLE}"
        )
