"""Messages between the processes of a live cell, and their encoding.

All messages are MessagePack arrays of the types below; only the payload of a stage is not. Decoding
checks length, types and bounds, allocates no more memory than the message is long, and names the
error. It never imports or executes anything.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias, TypeVar, cast

import msgspec

from dwell.errors import LiveError
from dwell.model.instants import NEVER_NS

#: Longest header and control message; longer messages are rejected unread.
MAX_HEADER_BYTES = 16_384
MAX_CONTROL_BYTES = 262_144
#: Outcomes of a command that passes the gate: the actuator applied it, or raised.
ACTUATED, NOT_APPLIED = HANDED_OVER = "actuated", "not_applied"
#: Outcome of a command that the gate stops, because it may be older than `max_age_ms`.
STALE = "stale"
#: Outcome of a job whose output a task has sampled: the output has arrived there.
SAMPLED = "sampled"
#: Outcomes in a cycle with two copies: of a message that arrives after the other copy's, or after
#: the cycle is done, and of a job that does not run, or sends nothing, because the cycle is done.
#: A job that sends nothing because no message of its cycle is due has the second one, too.
LATE, CANCELLED = "late", "cancelled"
#: Outcome of a command that the gate stops, because it has passed a later cycle's command.
BEHIND = "behind"
#: Start of the refusal of an order while another controller is in charge.
OTHER = "another controller"
#: Length of a signature (Ed25519), which precedes the signed bytes.
SIGNATURE_BYTES = 64

Name: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=120)]
Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=NEVER_NS)]
#: Number of an accepted order: a quarter of the range remains for later orders, even if a message
#: has a false number.
Passed: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=3 << 60)]
#: Name of a candidate, or an empty string.
MaybeName: TypeAlias = Annotated[str, msgspec.Meta(max_length=120)]
Hops: TypeAlias = "Annotated[tuple[Hop, ...], msgspec.Meta(max_length=64)]"
#: CPU time, ns; -1 if unknown.
Spent: TypeAlias = Annotated[int, msgspec.Meta(ge=-1, lt=NEVER_NS)]
Instant: TypeAlias = Annotated[int, msgspec.Meta(ge=-NEVER_NS, lt=NEVER_NS)]
Forks: TypeAlias = Annotated[tuple[tuple[Name, Name], ...], msgspec.Meta(max_length=16)]
Words: TypeAlias = Annotated[str, msgspec.Meta(max_length=2_000)]
#: A finite number; NaN is outside of all bounds.
Finite: TypeAlias = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]


class _Array(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A MessagePack array."""


class Stamp(_Array, frozen=True):
    """Placement of a cycle, set by the stamper; every process downstream routes by it.

    Parameters
    ----------
    run : int
        Run id; it grows from run to run.
    term : int
        Grows at every change of placement; 0 for a guess of a source task.
    released_ns : int
        Release on the stamper's clock.
    shadow : str
        Candidate that the cycle is also sent through; empty for none.
    forks : tuple of (str, str)
        Tasks and nodes that also get the inputs, because their state will be sent there.
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
        """Run and cycle; they grow with every cycle."""
        return self.run, self.cycle


class Stamped(Stamp, frozen=True):
    """A stamp for the controller, with measurements.

    Parameters
    ----------
    intervals : tuple of (int, int, int)
        Earlier cycles of the run, their durations by the stamper's clock alone, ns (see
        `dwell.live.roles.latencies`), and the number of their commands that found the actuator at
        rest; each cycle is sent once.
    group_ns : int
        CPU time that the control group on the stamper's node had used at the release; -1 if
        unknown.
    """

    intervals: Annotated[tuple[tuple[Count, Count, Count], ...], msgspec.Meta(max_length=64)] = ()
    group_ns: Spent = -1


class Hop(_Array, frozen=True):
    """One job of a cycle, with instants on the clock of its node.

    Parameters
    ----------
    arrived_ns : int
        Arrival of its last input.
    inputs : tuple of (str, int)
        Source and arrival of every input.
    state_age : int
        Age in cycles of the checkpoint restored before it, for the first job after a failover; -1
        otherwise.
    cpu_ns : int
        CPU time from its start on (see `Worker.run`); -1 if the stage was not called.
    others_ns : int
        CPU time during the call of other processes in the worker's control group; -1 if unknown.
    group_ns : tuple of int
        CPU time that the group had used at the start of the job and when the stage returned.
    warmup : bool
        Whether it is one of its worker's first `warmup_jobs`.
    stamp_ns : int, optional
        Stamp of the frame of a source, on any clock; no time is computed from it.
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
    group_ns: tuple[Spent, Spent] = (-1, -1)
    warmup: bool = False
    stamp_ns: Instant | None = None


class Origin(_Array, frozen=True):
    """The oldest cycle from which a job descends, its release, and the newest such cycle.

    `task` is a task that begins at a release, or the first task of a chain. The release is on the
    stamper's clock.
    """

    task: Name
    cycle: Count
    released_ns: Instant
    newest: Count


class RatedHop(Hop, frozen=True):
    """A hop in a cell with sampled flows or chains.

    Parameters
    ----------
    origins : tuple of Origin
        Cycles from which the job descends, one entry per task.
    """

    origins: Annotated[tuple[Origin, ...], msgspec.Meta(max_length=64)] = ()


RatedHops: TypeAlias = Annotated[tuple[RatedHop, ...], msgspec.Meta(max_length=64)]


class Header(_Array, frozen=True):
    """Sent with the payload of every message between stages.

    Parameters
    ----------
    source : str
        Task that sent it.
    node : str
        Node of that task.
    kind : str
        Encoding of the payload; see `dwell.live.wire.payloads`.
    hops : tuple of Hop
        All jobs upstream in the cycle, each once.
    shadow : bool
        Whether the message belongs to the shadow of the cycle.
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


class RatedHeader(Header, frozen=True):
    """A header in a cell with sampled flows or chains."""

    hops: RatedHops = ()


class Completion(_Array, frozen=True):
    """End of a cycle at a sink, or of one of its jobs before a sink.

    Parameters
    ----------
    done_ns : int
        Arrival of the command at the gate, on the sink's clock.
    outcome : str
        ``actuated``, ``not_applied`` (the actuator raised), ``behind`` (a later cycle had been
        actuated), ``stale`` (older than `max_age_ms`); ``shadow`` at the end of a shadow;
        ``replaced`` if a later cycle replaced the job; ``sampled`` if its output has arrived at a
        task that does not wait for it; ``late`` and ``cancelled`` of the slower copy.
    node : str
        Node of the sink or of the job.
    group_ns : int
        CPU time that the control group on the sink's node had used at `done_ns`; -1 if unknown.
    rested : bool
        Whether the actuator was at rest when the command arrived: the sink had called `hold` or
        `zero` since the last applied command.
    """

    stamp: Stamp
    sink: Name
    done_ns: Instant
    outcome: Annotated[str, msgspec.Meta(max_length=20)]
    hops: Hops
    node: Name
    group_ns: Spent = -1
    rested: bool = False


class RatedCompletion(Completion, frozen=True):
    """A completion in a cell with sampled flows or chains."""

    hops: RatedHops


class Heard(_Array, frozen=True):
    """Last beat that the sender of a beat has received from another process.

    Parameters
    ----------
    beat_ns : int
        Time at which that beat was sent, on its sender's clock.
    at_ns : int
        Its arrival, on the receiver's clock.
    """

    who: Name
    node: Name
    beat_ns: Instant
    at_ns: Instant


class Rates(_Array, frozen=True):
    """Messages of a topic outside of the cell; see `dwell.live.stage.TopicRates`."""

    topic: Annotated[str, msgspec.Meta(max_length=300)]
    rate_hz: Finite
    jitter_ms: Finite
    lost: Count
    age_ms: Finite | None
    stamp_ms: Finite | None


class Beat(_Array, frozen=True):
    """Heartbeat of a process, with the last beats that it received, to compare clocks.

    Parameters
    ----------
    life : int
        Grows with every start of the process.
    ready : bool
        Whether it can do its work: its stage has started and does not hang.
    term : int
        The stamper's current term; 0 from other processes.
    placement : str
        The stamper's current placement; empty from other processes.
    cell : str
        Digest of the cell file, to detect different files.
    note : str
        Reason that it is not ready, or the last failure.
    run : int
        Run of the last command that passed a sink's gate; 0 from other processes.
    moving : bool
        Whether a worker is saving or restoring a state for a migration.
    generation, roster : int
        Generation of the process's certificate, and number of its roster; 0 without keys.
    alone : bool
        Whether the agent of its node does not send its beats, so that it sends them itself.
    rates : Rates, optional
        The topic that a source reads, if it reads one.
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
    alone: bool = False
    rates: Rates | None = None


class Beats(_Array, frozen=True):
    """Beats of all processes of a node, from its agent; the agent's own beat is the first.

    The agent sends it when it makes its own beat, so the difference between the times of the first
    and of another beat is the age of the other.
    """

    beats: Annotated[tuple[Beat, ...], msgspec.Meta(min_length=1, max_length=1_000)]


class Receipt(_Array, frozen=True):
    """An agent's receipt for the beats of its node; it stays on the node.

    Parameters
    ----------
    life, sent_ns : int
        Life of the agent, and the time at which it sent the beats.
    beats : dict of str to int
        Times of the beats of the processes.
    clock : tuple of int
        Offset of the node's clock (see `dwell.live.roles.offsets.ClockOffset`).
    """

    life: int
    sent_ns: int
    beats: dict[str, int]
    clock: tuple[int, int, int]


class Order(_Array, frozen=True):
    """Order of the controller to the stamper, answered by one `Accepted`.

    Parameters
    ----------
    number : int
        Grows with every order of this controller; a copy of an order keeps its number.
    run, term : int
        Run and term it was computed on; both 0 in a request for the state, with an empty
        `placement`.
    placement : str
        Candidate; empty to change nothing.
    shadow_fraction : float
        Share of the cycles sent through each alternative, under the placement of the order.
    forks : tuple of (str, str)
        Value of `Stamp.forks` from now on.
    want : str
        Candidate that shall replace the guard's fallback, to be proven by probes.
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
    """Batch of small messages on the detour.

    Parameters
    ----------
    messages : tuple of (str, bytes)
        Keys and payloads.
    """

    messages: Annotated[
        tuple[tuple[Annotated[str, msgspec.Meta(max_length=400)], bytes], ...],
        msgspec.Meta(max_length=1_000),
    ]


class Ask(_Array, frozen=True):
    """Request of an operator to a cell's controller.

    Parameters
    ----------
    number : str
        Chosen by the sender; the key of the answer ends with it.
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
        Reason that the request was refused; empty if it was not.
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
        Sum of the payloads of all blocks.
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
        Number of cycles with a replaced or a dropped input.
    totals : tuple of int
        Number of taken, replaced and dropped inputs in all blocks.
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
    """Work of a node's CPU since the start of its agent's count.

    Parameters
    ----------
    life : int
        Life of the agent; the counts of different lives have different starts.
    at_ns : int
        Time of the report on the node's clock.
    busy_ns, own_ns, shadow_ns : int
        Core-nanoseconds of all processes, of the cell's own processes, and of its shadow workers.
    accelerator : float
        Utilisation of the node's accelerators if a hook measures it; -1 otherwise.
    processes : tuple of (str, int)
        CPU time of each of the cell's processes on the node, including the agent, since its start.
    stages : tuple of StageCounts
        The last two blocks of each worker, once per second; empty in other reports.
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
    """Request to a task's worker to send its state to another node; the worker there gets a copy.

    Parameters
    ----------
    number : int
        Returned in `Restored`.
    task, node, to : str
        Task, node of its state, and new node of its state.
    run, cycle : int
        The first cycle whose inputs are forked; the state must contain all earlier cycles.
    """

    number: Count
    task: Name
    node: Name
    to: Name
    run: Count
    cycle: Count


class State(_Array, frozen=True):
    """Header of a message with a task's state; the payload is the result of `snapshot`.

    Parameters
    ----------
    run, cycle : int
        The last cycle in the state.
    task, node : str
        Task, and node of the sender.
    number : int
        Number of the `Snapshot` it answers; 0 for a checkpoint, which is kept for a failover.
    cost_ns : int
        Duration of the last call of `snapshot`.
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
    """Report that a state is restored and the later inputs are replayed, or that this failed.

    Parameters
    ----------
    run, cycle : int
        The last cycle in the restored state.
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
        Empty if accepted; else ``stale term``, ``stale run``, ``stale order``, ``infeasible``,
        ``not ready``, ``not proven`` (probes are missing) or ``another controller``, with details.
    cycle : int
        The next cycle to be stamped, with the ordered placement and forks.
    fallback : bool
        Whether the current placement is a fallback of the guard.
    proven : str
        Candidate with enough completed probes; empty for none.
    newest : int
        Highest number of an accepted order.
    resting : bool
        Whether the guard rests after its own move.
    probed : str
        Candidate of the probes, which may replace the guard's fallback.
    probes, needed : int
        Number of probes that count now, and number needed.
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
# Create all decoders here, in one thread: msgspec crashes if one thread decodes a message while
# another thread creates a decoder for a type that both use.
_MORE: tuple[type[msgspec.Struct], ...] = (Stamped, RatedHop, RatedHeader, RatedCompletion)
_KINDS: tuple[type[msgspec.Struct], ...] = (*_Array.__subclasses__(), *_MORE)
#: Types of messages in a cell with sampled flows or chains, in place of other types.
RATED: dict[type[msgspec.Struct], type[msgspec.Struct]] = {
    Header: RatedHeader,
    Completion: RatedCompletion,
}
_DECODERS: dict[type[msgspec.Struct], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in _KINDS
}


def encode(message: msgspec.Struct) -> bytes:
    """Encode a message."""
    return _ENCODER.encode(message)


def decode(data: bytes, kind: type[T], *, limit: int = MAX_CONTROL_BYTES) -> T:
    """Decode a message; raise a LiveError if it exceeds `limit` bytes or is not of this kind."""
    if len(data) > limit:
        raise LiveError(f"a {kind.__name__} of {len(data)} bytes; at most {limit} are read")
    try:
        return cast("T", _DECODERS[kind].decode(data))
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise LiveError(f"no {kind.__name__}: {error}") from None
