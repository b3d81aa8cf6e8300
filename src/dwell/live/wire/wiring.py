"""Wiring of a live cell: its processes, their ports and their connections.

The wiring depends only on the cell file. Every process of a cell computes it and gets the same
result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Literal, TypeAlias

from dwell.errors import Fault, LiveError, ProblemError
from dwell.live.wire.local_addresses import running_elsewhere
from dwell.live.wire.messages import MAX_CONTROL_BYTES, MAX_HEADER_BYTES
from dwell.live.wire.transport import Lane
from dwell.model import FrozenDict, Problem
from dwell.model.placement import nodes_of

Kind: TypeAlias = Literal[
    "stamper", "sink", "agent", "worker", "shadow", "standby", "controller", "visitor"
]
#: `control` carries small messages, `images` large payloads to other nodes, `local` large payloads
#: within a node.
Session: TypeAlias = Literal["control", "images", "local"]

SESSIONS: tuple[Session, ...] = ("control", "images", "local")
#: Least declared size of a flow on the lane `images`.
IMAGE_BYTES = 16_384
#: Longest payload as a multiple of the size in the cell file.
SPARE = 4
#: Bytes of a message for its key, its signature and Zenoh's overhead.
ENVELOPE_BYTES = 4_096
#: A process has one port per session; the first port is for `control`.
PORTS_PER_ROLE = len(SESSIONS)

_LAST_PORT = 65_535


@dataclass(frozen=True, slots=True)
class Role:
    """One process of a cell.

    Parameters
    ----------
    who : str
        Unique name in the cell: ``perception@E``, ``perception@E.shadow``, ``control@R2.1``,
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
    """Address and port at which a session listens, or is reached."""

    address: str
    port: int
    protocol: str = "tcp"

    def __str__(self) -> str:
        """Return the locator in Zenoh's format."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"{self.protocol}/{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class Wire:
    """A connection between two processes, for messages in both directions.

    The process `source` connects, and the process `target` listens.
    """

    session: Session
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class WiringEntry:
    """Endpoints of a process, by session: its own in `listen`, others' in `connect`.

    `listen` lacks the sessions that no process connects to.
    """

    role: Role
    listen: Mapping[Session, Locator]
    connect: Mapping[Session, tuple[Locator, ...]]

    def __post_init__(self) -> None:
        object.__setattr__(self, "listen", FrozenDict(self.listen))
        object.__setattr__(self, "connect", FrozenDict(self.connect))

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Sessions that the process must open."""
        return tuple(name for name in SESSIONS if name in self.listen or name in self.connect)


@dataclass(frozen=True, slots=True)
class Wiring:
    """Ports and connections of all processes; `entries` is by name of the process."""

    cell: str
    entries: Mapping[str, WiringEntry]
    wires: tuple[Wire, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "entries", FrozenDict(self.entries))

    def entry(self, who: str) -> WiringEntry:
        """Return the endpoints of a process; raise a LiveError if the cell has no such process."""
        if who not in self.entries:
            known = ", ".join(self.entries)
            raise LiveError(f"cell {self.cell!r} has no process {who!r}; there are {known}")
        return self.entries[who]

    def on(self, node: str) -> tuple[Role, ...]:
        """Processes of a node."""
        return tuple(entry.role for entry in self.entries.values() if entry.role.node == node)

    def peers(self, who: str) -> int:
        """Return the number of connections of a process, in the session with the most."""
        counts = Counter(w.session for w in self.wires if who in (w.source, w.target))
        return max(counts.values(), default=0)

    def visitor(self, who: str, *to: str) -> WiringEntry:
        """Return the endpoints of an outside process that connects to processes of the cell."""
        hosts = [self.entry(one) for one in to]
        for host in hosts:
            if "control" not in host.listen:
                raise LiveError(f"{host.role.who} of cell {self.cell!r} does not listen to anybody")
        role = Role(who, hosts[0].role.node, "visitor")
        return WiringEntry(role, {}, {"control": tuple(host.listen["control"] for host in hosts)})


def roles(problem: Problem) -> tuple[Role, ...]:
    """Return every process of a cell, in the order of the ports.

    Later processes connect to earlier processes. Processes that rarely restart are first, then the
    workers along the flows, and last the controller, which may start and stop at any time. Raises a
    ProblemError if a search must still add candidates.
    """
    require_candidates(problem)
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
    """Compute the ports and connections of a cell.

    `protocol` is Zenoh's name of the protocol of all sessions. Raises a LiveError that lists all
    missing hosts, missing ports and conflicts, or the keys that live cells do not support.
    """
    _require_no_prices(problem)
    _require_states_in_step(problem)
    everybody = roles(problem)
    _require_hosts(problem, everybody)
    hosts = problem.live.hosts
    rank = {role.who: i for i, role in enumerate(everybody)}
    # Place of each process on its node, from 0.
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
    # Pairs of the endpoint seen from another node, and the endpoint on which the process listens.
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
        if role.kind == "controller":  # for requests of operators
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
    """Return the lane of a flow, or of a task's state, by its declared size."""
    return "images" if declared_bytes >= IMAGE_BYTES else "control"


def longest_bytes(declared_bytes: int) -> int:
    """Return the longest payload that processes send and accept, by its declared size.

    `declared_bytes` is the size of a flow or of a task's state; 0 for a command.
    """
    return max(SPARE * declared_bytes, MAX_CONTROL_BYTES)


def longest_message_bytes(problem: Problem, session: Session) -> int:
    """Return the longest message of a cell in a session, with its header and key."""
    pipeline = problem.pipeline
    declared = [flow.payload_bytes for flow in pipeline.flows]
    declared += [task.state_bytes for task in pipeline.tasks.values()]
    lane: Lane = "control" if session == "control" else "images"
    longest = max((longest_bytes(size) for size in declared if lane_of(size) == lane), default=0)
    return max(longest, MAX_CONTROL_BYTES) + MAX_HEADER_BYTES + ENVELOPE_BYTES


def session_of(entry: WiringEntry, lane: Lane, key: str) -> Session:
    """Return the session in which a process sends a message.

    On the lane `images` keys are ``dwell/CELL/in/TASK/NODE/...``, or have ``state`` or ``value``
    instead of ``in``; a message to the process's own node uses `local`. If the
    process has no such session, the result is `control`: the message is slower, but not lost.
    """
    if lane == "images":
        chunks = key.split("/")
        stays = len(chunks) > 4 and chunks[4] == entry.role.node
        session: Session = "local" if stays else "images"
        if session in entry.listen or session in entry.connect:
            return session
    return "control"


def _shadows(problem: Problem) -> frozenset[tuple[str, str]]:
    """Return tasks and nodes of shadow jobs, without sinks: shadows end before them."""
    if not problem.controller.shadow_workers:
        return frozenset()
    pipeline = problem.pipeline
    return frozenset(
        (task, other.first[task])
        for active, other in permutations(problem.candidates.values(), 2)
        if other.second is None
        for task in pipeline.diverging(active, other.first)
        if pipeline.outputs(task)
    )


def _wires(problem: Problem, everybody: Sequence[Role]) -> list[tuple[Session, frozenset[str]]]:
    """Return every pair of processes that must connect, by session, once and in a fixed order."""
    pairs: dict[tuple[Session, frozenset[str]], None] = {}
    for one, other in combinations(everybody, 2):
        # Connections for small messages, except for messages between stages.
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
        moved = [flow.payload_bytes for flow in problem.pipeline.inputs(task.name) if flow.sampled]
        lanes = [lane_of(size) for size in (task.state_bytes, *moved)]
        for one, other in combinations(_workers(everybody, task.name), 2):
            if one.node != other.node:
                pairs.update(((lane, frozenset((one.who, other.who))), None) for lane in lanes)
    return list(pairs)


def _workers(everybody: Iterable[Role], task: str) -> list[Role]:
    return [role for role in everybody if role.works and role.task == task]


def _calls(problem: Problem, one: Role, other: Role) -> bool:
    """Whether the first process must reach the second, by their kinds."""
    same_node = one.node == other.node
    match one.kind:
        case "stamper":  # sends stamps, and receives all beats
            return True
        case "agent":  # supervises its own node; the relay's agent forwards for all others
            return other.kind == "agent" or same_node or one.node == problem.relay_node
        case "sink":  # receives its task's commands; reports ends of cycles with two copies
            copied = bool(problem.replicas) and other.kind != "shadow"
            is_served = other.works and (copied or other.task == one.task)
            return other.kind == "controller" or is_served
        case "standby":  # works only while its worker is silent
            return other.kind == "worker" and same_node and other.task == one.task
        case "controller":  # receives completions, loads, ended shadows, samples, states
            if not other.works:
                return other.kind == "agent"
            task = problem.pipeline.tasks[other.task]
            stops = not problem.pipeline.outputs(other.task)
            samples = any(flow.sampled for flow in problem.pipeline.inputs(other.task))
            return stops or (other.kind == "worker" and (samples or not task.anchored))
    return False


def require_candidates(problem: Problem) -> None:
    """Raise a ProblemError if a search must still add candidates."""
    if problem.is_searched:
        message = f"not supported in the live cell {problem.name}"
        remedy = "paste the block of `dwell candidates CELL --yaml`"
        raise ProblemError([Fault("candidates.all", f"{message}; {remedy}")])


def _require_no_prices(problem: Problem) -> None:
    """Raise a LiveError if J needs prices, which live windows do not have."""
    if problem.objective.weighs_price:
        raise LiveError(
            f"objective.weights.price: not supported in the live cell {problem.name}; only the "
            "simulator measures prices: remove it, or use dwell run"
        )


def lagging_states(problem: Problem) -> Iterator[Fault]:
    """Yield the second copies that start later and have states of their own."""
    tasks = problem.pipeline.tasks
    for name, one in problem.replicas.items():
        for task in one.doubled if one.after_ms > 0 else ():
            if tasks[task].state_bytes:
                yield Fault(
                    f"candidates.{name}.after_ms",
                    f"{one.after_ms:g} is not supported in live cells: {task} has a state on "
                    f"{' and '.join(nodes_of(one[task]))}, and the second one misses the cycles "
                    "that are done before; set it to 0",
                )


def _require_states_in_step(problem: Problem) -> None:
    """Raise a LiveError with `lagging_states`."""
    if faults := [*lagging_states(problem)]:
        raise LiveError("\n".join(map(str, faults)))


def _require_hosts(problem: Problem, everybody: Sequence[Role]) -> None:
    """Raise a LiveError unless every node has a host and enough ports."""
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
    """Raise a LiveError if two endpoints have the same address and port."""
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
