"""Messages of the processes of a live cell, and how they are written.

Everything but a stage's payload is a MessagePack array of one of the types below. Decoding checks
length, types and bounds, allocates no more than the message is long, and names what is wrong; it
never imports or executes anything.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias, TypeVar, cast

import msgspec

from dwell.errors import LiveError
from dwell.model.instants import NEVER_NS

#: Longer headers and control messages are refused before anything of them is read.
MAX_HEADER_BYTES = 16_384
MAX_CONTROL_BYTES = 262_144
#: Outcomes of a command that the gate lets through: the actuator took it, or raised.
ACTUATED, NOT_APPLIED = HANDED_OVER = "actuated", "not_applied"
#: Outcome of one that it keeps back, because it may be older than `max_age_ms`.
STALE = "stale"
#: Begins the refusal of an order while another controller is in charge.
OTHER = "another controller"
#: Signatures stand before what they are of (Ed25519).
SIGNATURE_BYTES = 64

Name: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=120)]
Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=NEVER_NS)]
#: Number of an order that is believed to have been carried out: a quarter of the range is left for
#: those that follow, whatever one message says.
Passed: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=3 << 60)]
#: Name of a candidate, or nothing.
MaybeName: TypeAlias = Annotated[str, msgspec.Meta(max_length=120)]
Hops: TypeAlias = "Annotated[tuple[Hop, ...], msgspec.Meta(max_length=64)]"
#: CPU time; -1 where it is not known.
Spent: TypeAlias = Annotated[int, msgspec.Meta(ge=-1, lt=NEVER_NS)]
Instant: TypeAlias = Annotated[int, msgspec.Meta(ge=-NEVER_NS, lt=NEVER_NS)]
Forks: TypeAlias = Annotated[tuple[tuple[Name, Name], ...], msgspec.Meta(max_length=16)]
Words: TypeAlias = Annotated[str, msgspec.Meta(max_length=2_000)]


class _Array(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A MessagePack array."""


class Stamp(_Array, frozen=True):
    """Placement of a cycle, by the stamper; every process downstream routes by it.

    Parameters
    ----------
    run : int
        Run id; later runs have larger ones.
    term : int
        Grows at every change of placement.
    released_ns : int
        Release on the stamper's clock.
    shadow : str
        Candidate that the cycle is also sent through; empty for none.
    forks : tuple of (str, str)
        Tasks and nodes that get their inputs as well, because their state is on the way there.
    """

    run: Count
    cycle: Count
    term: Count
    placement: Name
    released_ns: Instant
    shadow: MaybeName = ""
    forks: Forks = ()

    @property
    def key(self) -> tuple[int, int]:
        """Run and cycle: what later cycles have more of."""
        return self.run, self.cycle


class Stamped(Stamp, frozen=True):
    """A stamp as the controller gets it.

    Parameters
    ----------
    intervals : tuple of (int, int)
        Earlier cycles of the run, and how long they took by the stamper's clock alone, ns (see
        `dwell.live.roles.latencies`), each once.
    group_ns : int
        CPU time that the control group of the stamper's node had taken at the release; -1 where
        that is not known.
    """

    intervals: Annotated[tuple[tuple[Count, Count], ...], msgspec.Meta(max_length=64)] = ()
    group_ns: Spent = -1


class Hop(_Array, frozen=True):
    """One job of a cycle, on the clock of the node it ran on.

    Parameters
    ----------
    arrived_ns : int
        When the last of its inputs was there.
    inputs : tuple of (str, int)
        For every flow into the task: its source, and when its message was handed over here.
    state_age : int
        Cycles that the restored state behind it lacked, where it was the first after a failover;
        -1 otherwise.
    cpu_ns : int
        CPU time that the job took from its start on (see `Worker.run`); -1 where the stage was not
        called.
    others_ns, outside_ns : int
        CPU time that other processes of the node's control group took meanwhile, and on its CPUs
        those of no such group; -1 where that is not known.
    group_ns : tuple of int
        CPU time that the group had taken when the job started, and when the stage returned.
    warmup : bool
        Whether its worker had not completed its `warmup_jobs` yet.
    """

    task: Name
    node: Name
    arrived_ns: Instant
    started_ns: Instant
    ended_ns: Instant
    inputs: Annotated[tuple[tuple[Name, Instant], ...], msgspec.Meta(max_length=64)] = ()
    state_age: Annotated[int, msgspec.Meta(ge=-1, lt=NEVER_NS)] = -1
    cpu_ns: Spent = -1
    others_ns: Spent = -1
    outside_ns: Spent = -1
    group_ns: tuple[Spent, Spent] = (-1, -1)
    warmup: bool = False


class Header(_Array, frozen=True):
    """Travels beside the payload of every message between stages.

    Parameters
    ----------
    source : str
        Task that sent it.
    node : str
        Where that task ran.
    kind : str
        How the payload is written; see `dwell.live.wire.payloads`.
    hops : tuple of Hop
        All jobs behind it, each once.
    shadow : bool
        Whether this is the shadow of the cycle and not the cycle itself.
    seal : bytes
        Signature of the stamp by its maker; empty without keys.
    """

    stamp: Stamp
    source: Name
    node: Name
    kind: Annotated[str, msgspec.Meta(max_length=200)]
    hops: Hops = ()
    shadow: bool = False
    seal: Annotated[bytes, msgspec.Meta(max_length=64)] = b""


class Completion(_Array, frozen=True):
    """End of a cycle: at a sink, or at a task where it ended before.

    Parameters
    ----------
    done_ns : int
        When the command was handed to the actuator, on the sink's clock.
    outcome : str
        ``actuated``, ``not_applied`` (the actuator raised), ``behind`` (a later cycle had been
        actuated), ``stale`` (older than `max_age_ms`); ``shadow`` where a shadow ended;
        ``replaced`` where a later cycle took its place.
    node : str
        Node of the sink, or where a shadow stopped.
    group_ns : int
        CPU time that the control group of the sink's node had taken by `done_ns`; -1 where that is
        not known.
    rested : bool
        Whether the actuator was at rest when the command came: the sink had called `hold` or
        `zero` since the last command that was applied.
    """

    stamp: Stamp
    sink: Name
    done_ns: Instant
    outcome: Annotated[str, msgspec.Meta(max_length=20)]
    hops: Hops
    node: Name
    group_ns: Spent = -1
    rested: bool = False


class Heard(_Array, frozen=True):
    """Last beat of another process that the sender of a beat has heard.

    Parameters
    ----------
    beat_ns : int
        When that beat was sent, on its sender's clock.
    at_ns : int
        When it was heard, on the listener's clock.
    """

    who: Name
    node: Name
    beat_ns: Instant
    at_ns: Instant


class Beat(_Array, frozen=True):
    """Heartbeat: its process is there, and last heard these others; so clocks can be compared.

    Parameters
    ----------
    life : int
        Grows with every start of the process.
    ready : bool
        Whether it can do its work: its stage has started and does not hang.
    term : int
        The stamper's current term; 0 from anybody else.
    placement : str
        The stamper's current placement; empty from anybody else.
    cell : str
        Digest of the cell file, so that different files are noticed.
    note : str
        Why it is not ready, or the last failure.
    run : int
        Run of the last command that a sink let through; 0 from other processes.
    moving : bool
        Whether a worker writes or reads a state that an order asked for.
    generation, roster : int
        Generation of the certificate that the process uses, and number of its roster; 0 without
        keys.
    """

    who: Name
    node: Name
    life: Count
    sent_ns: Instant
    ready: bool
    heard: Annotated[tuple[Heard, ...], msgspec.Meta(max_length=256)] = ()
    term: Count = 0
    placement: MaybeName = ""
    cell: Annotated[str, msgspec.Meta(max_length=64)] = ""
    note: Words = ""
    version: Annotated[str, msgspec.Meta(max_length=64)] = ""
    run: Count = 0
    moving: bool = False
    generation: Count = 0
    roster: Count = 0


class Order(_Array, frozen=True):
    """Order of the controller to the stamper, answered by one `Accepted`.

    Parameters
    ----------
    number : int
        Grows with every order of this controller; a repeated one is the same order.
    run, term : int
        Run and term it was computed on; 0 and 0 only to ask how things are (`placement` empty).
    placement : str
        Candidate; empty to change nothing.
    shadow_fraction : float
        Share of the cycles sent through each alternative, under the placement that the order leads
        to.
    forks : tuple of (str, str)
        For `Stamp.forks` from now on.
    want : str
        Candidate that the guard's fallback shall be left for, so that probes are sent through it.
    """

    number: Count
    controller: Name
    run: Count
    term: Count
    placement: MaybeName = ""
    shadow_fraction: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    forks: Forks = ()
    want: MaybeName = ""


class Carried(_Array, frozen=True):
    """Small messages that the detour carries on together.

    Parameters
    ----------
    messages : tuple of (str, bytes)
        Keys, and what was sent under them.
    """

    messages: Annotated[
        tuple[tuple[Annotated[str, msgspec.Meta(max_length=400)], bytes], ...],
        msgspec.Meta(max_length=1_000),
    ]


class Ask(_Array, frozen=True):
    """Question or wish of a person to a cell's controller.

    Parameters
    ----------
    number : str
        Chosen by the asker; the answer goes to the key of that name.
    what : str
        ``status``, ``pin``, ``unpin``, ``drain`` or ``undrain``.
    about : str
        Candidate to pin, node to drain.
    """

    number: Name
    what: Name
    about: MaybeName = ""


class Answer(_Array, frozen=True):
    """The controller's answer.

    Parameters
    ----------
    refused : str
        Why it was not done; empty if it was.
    status : dict
        State of the cell; see `dwell.live.roles.controlled_cell.ControlledCell.status`.
    """

    number: Name
    refused: Words
    status: dict[str, Any]


class InputCounts(_Array, frozen=True):
    """Inputs of a worker from one ``TASK@NODE``, by outcome."""

    source: Name
    taken: Count
    replaced: Count
    dropped: Count
    waiting: Count


class OutputCounts(_Array, frozen=True):
    """Outputs of a worker to one ``TASK@NODE``.

    Parameters
    ----------
    total_bytes : int
        Payloads of all blocks.
    """

    target: Name
    sent: Count
    payload_bytes: Count
    total_bytes: Count


class StageCounts(_Array, frozen=True):
    """Jobs and messages of a worker in one block of cycles (see `dwell.live.roles.stage_counts`).

    Parameters
    ----------
    median_ns, p95_ns : int
        Time of a job from start to end; 0 without jobs.
    replaced, dropped : int
        Cycles of which an input was replaced, or dropped.
    totals : tuple of int
        Inputs of all blocks that were taken, replaced and dropped.
    """

    who: Name
    run: Count
    block: Count
    jobs: Count
    median_ns: Count
    p95_ns: Count
    replaced: Count
    dropped: Count
    inputs: Annotated[tuple[InputCounts, ...], msgspec.Meta(max_length=256)]
    outputs: Annotated[tuple[OutputCounts, ...], msgspec.Meta(max_length=256)]
    totals: tuple[Count, Count, Count]


class Load(_Array, frozen=True):
    """Work of a node's CPU since its agent began to count.

    Parameters
    ----------
    life : int
        Life of the agent that counts; another life counts from another beginning.
    at_ns : int
        On the node's clock.
    busy_ns, own_ns, shadow_ns : int
        Core-nanoseconds of everything, of the cell's own processes, and of its shadow workers.
    accelerator : float
        Utilisation of the node's accelerators where a hook measures it; -1 otherwise.
    processes : tuple of (str, int)
        CPU time of each of the cell's processes there, the agent's included, since it was started.
    stages : tuple of StageCounts
        Once a second, the last two blocks of each worker; empty between.
    """

    node: Name
    life: Count
    at_ns: Instant
    busy_ns: Count
    own_ns: Count
    shadow_ns: Count
    accelerator: Annotated[float, msgspec.Meta(ge=-1.0, le=1e9)] = -1.0
    processes: Annotated[tuple[tuple[Name, Count], ...], msgspec.Meta(max_length=1_000)] = ()
    stages: Annotated[tuple[StageCounts, ...], msgspec.Meta(max_length=1_000)] = ()


class Snapshot(_Array, frozen=True):
    """Request to a task's worker to send its state to another node's, who is told of it, too.

    Parameters
    ----------
    number : int
        Comes back in `Restored`.
    task, node, to : str
        Task, where its state is, and where it shall go.
    run, cycle : int
        The first cycle whose inputs are forked: the state has to have all before it.
    """

    number: Count
    task: Name
    node: Name
    to: Name
    run: Count
    cycle: Count


class State(_Array, frozen=True):
    """Header of a task's state on its way; the payload is what the stage wrote.

    Parameters
    ----------
    run, cycle : int
        The last cycle that is in it.
    task, node : str
        Task, and where the state comes from.
    number : int
        Number of the `Snapshot` it answers; 0 for a checkpoint, which waits until it is needed.
    cost_ns : int
        Time that `snapshot` took.
    """

    run: Count
    cycle: Count
    task: Name
    node: Name
    number: Count = 0
    cost_ns: Count = 0

    @property
    def key(self) -> tuple[int, int]:
        """Run and cycle."""
        return self.run, self.cycle


class Restored(_Array, frozen=True):
    """Report that a state has arrived and the inputs since then are replayed.

    Parameters
    ----------
    run, cycle : int
        The last cycle that is in the state now.
    failed : str
        Failure; empty for none.
    """

    number: Count
    task: Name
    node: Name
    run: Count
    cycle: Count
    failed: Words = ""


class Accepted(_Array, frozen=True):
    """The stamper's answer to an order.

    Parameters
    ----------
    controller : str
        Sender of the order that it answers.
    refused : str
        Empty where it was accepted; else ``stale term``, ``stale run``, ``stale order``,
        ``infeasible``, ``not ready``, ``not proven`` (probes are missing), ``another controller``,
        with details.
    cycle : int
        The next one that will be stamped, with what was ordered.
    fallback : bool
        Whether the guard's placement holds.
    proven : str
        Candidate that enough probes have completed through; empty for none.
    newest : int
        Highest number of an order that was carried out.
    resting : bool
        Whether the guard rests after its own move.
    probed : str
        Candidate that probes are sent through, so that the guard's fallback can be left for it.
    probes, needed : int
        Probes that count by now, and how many have to: `needed` are enough.
    """

    number: Count
    controller: Name
    refused: Words
    run: Count
    term: Count
    placement: Name
    cycle: Count
    fallback: bool = False
    proven: MaybeName = ""
    newest: Passed = 0
    resting: bool = False
    probed: MaybeName = ""
    probes: Count = 0
    needed: Count = 0


T = TypeVar("T", bound=msgspec.Struct)

_ENCODER = msgspec.msgpack.Encoder()
# All made here, by one thread: msgspec crashes where a message is decoded in one thread while
# another makes a decoder of a type that is part of both.
_KINDS: tuple[type[msgspec.Struct], ...] = (*_Array.__subclasses__(), Stamped)
_DECODERS: dict[type[msgspec.Struct], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in _KINDS
}


def encode(message: msgspec.Struct) -> bytes:
    """Write a message."""
    return _ENCODER.encode(message)


def decode(data: bytes, kind: type[T], *, limit: int = MAX_CONTROL_BYTES) -> T:
    """Read a message.

    Raises
    ------
    LiveError
        If it is longer, or no such message.
    """
    if len(data) > limit:
        raise LiveError(f"a {kind.__name__} of {len(data)} bytes; at most {limit} are read")
    try:
        return cast("T", _DECODERS[kind].decode(data))
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise LiveError(f"no {kind.__name__}: {error}") from None
