"""RolePlace, RoleLogic and Pulse: what all processes of a cell share, and their beats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, cast

import msgspec

from dwell.errors import LiveError, TrustError
from dwell.live.log import printable
from dwell.live.roles.failure_detector import FailureDetector
from dwell.live.roles.offsets import ClockOffset, Offsets
from dwell.live.wire import channels
from dwell.live.wire.channels import CHANNELS, RELAYED
from dwell.live.wire.keys import Channel, Keys
from dwell.live.wire.messages import (
    MAX_HEADER_BYTES,
    RATED,
    SIGNATURE_BYTES,
    Beat,
    Beats,
    Completion,
    Header,
    Heard,
    Load,
    Rates,
    Receipt,
    Stamp,
    decode,
    encode,
)
from dwell.live.wire.transport import Arrival, Transport
from dwell.live.wire.wiring import Kind, roles
from dwell.model import Problem
from dwell.model.bounds import require
from dwell.model.document import digests
from dwell.model.instants import NEVER_NS
from dwell.version import __version__

#: Error bound of clocks that PTP or chrony synchronises on one network.
SYSTEM_BOUND_NS = 1_000_000
#: Largest number of different complaints counted; a new complaint replaces the oldest.
MAX_COMPLAINTS = 100
#: Largest number of processes remembered with another version or cell file.
MAX_STRANGERS = 256
#: Time for which beats repeat a complaint, and a silent stranger stays in the status.
REPEATED_NS = 10_000_000_000
#: Number of beats from an earlier life that shows two running processes with one name.
RIVAL_BEATS = 5
#: Periods between two beats of the controller, and between two reports of beats to it.
CONTROLLER_BEAT = 5
#: Delay of an agent's beats after the beats of its node, as a part of the period.
AGENT_DELAY = 4

if TYPE_CHECKING:
    from dwell.live.trust.signing import Seals

T = TypeVar("T", bound=msgspec.Struct)


class BeatState(NamedTuple):
    """Fields of a beat that only some processes fill (see `Beat`)."""

    term: int = 0
    placement: str = ""
    run: int = 0
    moving: bool = False
    rates: Rates | None = None


class ReceivedBeat(NamedTuple):
    """A new beat, and whether it did not come over the detour.

    `at_ns` is its arrival, less the time that its agent had it.
    """

    beat: Beat
    at_ns: int
    direct: bool


class BeatSlots(Protocol):
    """Memory that the processes of a node share; each process has a slot."""

    def write(self, content: bytes) -> None:
        """Replace the content of this process's slot."""

    def read(self, who: str) -> bytes:
        """Return the content of a process's slot; empty if there is none."""


class RoleLogic(Protocol):
    """A process of a cell, without its threads, sockets and clock.

    The host calls one method at a time: `receive` for every message under its `subscriptions`,
    and `wake` at the instant that the last call returned.
    """

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        """Process a message; return the next instant for `wake` if it has changed, or None."""

    def wake(self, now_ns: int) -> int:
        """Do the work that is due; return the instant of the next call."""


@dataclass(slots=True)
class RolePlace:
    """Name, node and transport of a process; reads, writes, signs and checks its messages.

    `who` is unique in the cell; `life` grows with every start of the process. `complaints` counts
    unusable messages by reason. Without `seals` messages are not signed; without `slots` no agent
    sends this process's beats.
    """

    problem: Problem
    who: str
    node: str
    transport: Transport
    life: int = 0
    complaints: dict[str, int] = field(default_factory=dict)
    say: Callable[[str], None] | None = None
    seals: Seals | None = None
    slots: BeatSlots | None = None
    complained: int = 0
    last_complaint: str = ""
    #: Keys of its cell, and P.
    keys: Keys = field(init=False)
    period_ns: int = field(init=False)
    #: Whether jobs have origins, in a cell with sampled flows or chains.
    has_origins: bool = field(init=False)

    def __post_init__(self) -> None:
        phase_ms = self.problem.pipeline.first_release_ms
        require(phase_ms == 0, "phase_ms", phase_ms, "0 in a live cell, which begins when it is up")
        self.keys = Keys(self.problem.name)
        pipeline = self.problem.pipeline
        self.period_ns = pipeline.period_ns
        self.has_origins = bool(pipeline.chains) or any(flow.sampled for flow in pipeline.flows)

    @property
    def patience_ns(self) -> int:
        """Age beyond which a received message no longer counts: g periods."""
        return self.problem.controller.guard_cycles * self.period_ns

    @property
    def hang_ns(self) -> int:
        """Time after which a call of the user's code counts as hanging."""
        return max(10 * self.period_ns, 1_000_000_000)

    @property
    def stamper(self) -> tuple[str, str]:
        """Node and name of the stamper."""
        node = self.problem.stamper_node
        return node, f"stamper@{node}"

    @property
    def controller(self) -> tuple[str, str]:
        """Node and name of the controller."""
        node = self.problem.controller_node
        return node, f"controller@{node}"

    def offsets(self) -> Offsets:
        """Return new offsets of the nodes' clocks from the clock of the stamper's node."""
        system = self.problem.live.clock == "system"
        return Offsets(
            self.node,
            self.problem.stamper_node,
            system_bound_ns=SYSTEM_BOUND_NS if system else None,
        )

    def send(self, channel: Channel[T], message: T, *chunks: str) -> None:
        """Send a small message as its channel requires: signed if there are keys, and twice.

        Processes on the relay's own node send second copies, too: the detour reaches processes
        without a direct connection to the sender.
        """
        key, payload = self.keys.of(channel, *chunks), self.sealed(channel, message)
        self.transport.put(key, payload)
        if channel.twice:
            self.transport.put(self.keys.relay(key), payload)

    def sealed(self, channel: Channel[T], message: T) -> bytes:
        """Return an encoded message, signed if its channel requires it and there are keys."""
        data, signs = encode(message), channel.signer is not None
        return self.seals.seal(channel.word, data) if signs and self.seals is not None else data

    def read(self, channel: Channel[T], sample: Arrival) -> T:
        """Read a message of a channel.

        Raises a LiveError if it is of another kind, or not signed by the required signer.
        """
        message = self._decoded(channel, sample)
        self._require_signer(channel, sample, message)
        return message

    def _decoded(self, channel: Channel[T], sample: Arrival) -> T:
        """Decode a message without a check of its signature."""
        signed = self.seals is not None and channel.signer is not None
        payload = sample.payload[SIGNATURE_BYTES if signed else 0 :]
        return decode(payload, self.kind_of(channel.payload))

    def kind_of(self, kind: type[T]) -> type[T]:
        """Return the type of a message in this cell."""
        return cast("type[T]", RATED.get(kind, kind)) if self.has_origins else kind

    def _require_signer(self, channel: Channel[T], sample: Arrival, message: T) -> None:
        """Raise a LiveError unless the channel's signer has signed a message, if there are keys."""
        if self.seals is not None and channel.signer is not None:
            name = channel.signer(self.problem, message)
            try:
                self.seals.require(channel.word, name, sample.payload)
            except TrustError as error:
                raise LiveError(str(error)) from None

    def channel(self, sample: Arrival) -> Channel[Any] | None:
        """Return the channel of a message; None if there is no such channel."""
        return CHANNELS.get(self.keys.word(sample.key))

    def channels_to(self, kind: Kind) -> Iterable[str]:
        """Yield the key expressions of the channels whose receivers are of a kind."""
        channels = (channel for channel in CHANNELS.values() if kind in channel.receivers)
        yield from map(self.keys.all, channels)

    def stamped(self, stamp: Stamp) -> bytes:
        """Return this process's signature of a stamp; empty without keys."""
        if self.seals is None:
            return b""
        return self.seals.seal("stamp", encode(stamp))[:SIGNATURE_BYTES]

    def _require_stamped(self, seals: Seals, header: Header) -> None:
        """Raise a TrustError unless the stamper, or for a guess a source's node, signed a stamp."""
        names = {self.stamper[0]}
        if not header.stamp.term:
            pipeline = self.problem.pipeline
            sources = (task for name, task in pipeline.tasks.items() if not pipeline.waited(name))
            names = {node for task in sources for node in task.on} - names
        sealed = header.seal + encode(header.stamp)
        for name in names:
            with suppress(TrustError):
                seals.require("stamp", name, sealed)
                return
        raise TrustError(f"stamp: cycle {header.stamp.cycle} is not signed by who may stamp it")

    def completion(self, sample: Arrival) -> Completion:
        """Read the completion of a cycle, from a sink or from the task at which the cycle ended.

        Raises a LiveError if it is not a completion, or if its task cannot run on its node.
        """
        ends = self.channel(sample) is channels.ENDED
        done = self.read(channels.ENDED if ends else channels.DONE, sample)
        task = self.problem.pipeline.tasks.get(done.sink)
        named = ends or sample.key.endswith(f"/{done.sink}")
        if task is None or done.node not in task.on or not named:
            raise LiveError(f"{sample.key}: {done.sink} does not run on {done.node}")
        return done

    def load(self, sample: Arrival) -> Load:
        """Read an agent's report of the load of its node.

        Raises a LiveError if it is not a load, or if its node differs from the node in its key.
        """
        load = self.read(channels.LOAD, sample)
        if not sample.key.endswith(f"/{load.node}"):
            raise LiveError(f"{sample.key}: the load of {load.node}")
        return load

    def beats(self, sample: Arrival) -> tuple[Beat, ...]:
        """Read a beat, or the beats of a node.

        Raises a LiveError if it is neither, or if a beat is of a process for which the key's
        sender may not send. Access control has checked the certificate of the sender of direct
        beats. The signature is checked only for beats from the detour.
        """
        channel = CHANNELS[self.keys.word(sample.key)]
        message: Beat | Beats = self._decoded(channel, sample)
        if isinstance(message, Beats):
            beats, controller = message.beats, self.controller[1]
            node = sample.key.rpartition("/")[2]
            good = beats[0].who == f"agent@{node}"
            good &= all(beat.node == node and beat.who != controller for beat in beats)
        else:
            beats = (message,)
            good = sample.key.endswith(f"/{message.node}/{message.who}")
        if not good:
            names = ", ".join(f"{beat.who} on {beat.node}" for beat in beats[:3])
            raise LiveError(f"{sample.key}: a beat of {names}")
        if not self.keys.came_directly(sample.key):
            self._require_signer(channel, sample, message)
        return beats

    def around(self, sample: Arrival) -> list[Arrival]:
        """Return the messages that the relay has sent in one batch."""
        try:
            carried = self.read(channels.CARRIED, sample)
        except LiveError as error:
            self.complain(error)
            return []
        keys = self.keys
        arrivals = [Arrival(keys.detour(key), payload) for key, payload in carried.messages]
        fit = [arrival for arrival in arrivals if self.channel(arrival) in RELAYED]
        if len(fit) < len(arrivals):
            self.complain(LiveError(f"{sample.key}: has what never takes the detour"))
        return fit

    def complain(self, error: LiveError) -> None:
        """Count an unusable message; at most `MAX_COMPLAINTS` different reasons are kept."""
        what = printable(str(error))[:300]
        if what not in self.complaints and len(self.complaints) >= MAX_COMPLAINTS:
            del self.complaints[next(iter(self.complaints))]
        self.complaints[what] = self.complaints.get(what, 0) + 1
        self.complained += 1
        self.last_complaint = what
        if self.say is not None:
            self.say(what)

    def header(self, sample: Arrival) -> Header | None:
        """Read the header of a data message; complain and return None if it is invalid.

        A stamp needs a valid signature, because a false cycle with too high a number would block
        all later cycles at the actuator.
        """
        try:
            header = decode(sample.header, self.kind_of(Header), limit=MAX_HEADER_BYTES)
            if self.seals is not None:
                self._require_stamped(self.seals, header)
            return header
        except (LiveError, TrustError) as error:
            self.complain(LiveError(f"{sample.key}: {error}"))
            return None


class Pulse:
    """Beats that a process makes and receives.

    The process writes its beat into its slot, and the agent of the node sends it with the others.
    If the agent's receipt for the last beat is missing, the process sends the beat itself. Then the
    stamper and all others do the same: the node hears them, and they hear the node.

    `state` returns whether the process is ready, and the reason if not or its last problem; `holds`
    returns the optional fields of the beat. `hears` names the nodes and processes (or ``*``)
    whose own beats it receives, by default the stamper's only, and `nodes` the nodes (or ``*``)
    whose agents' beats. It makes one beat per `every` periods. Direct beats, and receipts, set
    `offsets`.
    """

    def __init__(
        self,
        place: RolePlace,
        state: Callable[[], tuple[bool, str]],
        holds: Callable[[], BeatState] = BeatState,
        *,
        hears: Iterable[tuple[str, str]] | None = None,
        nodes: Iterable[str] = (),
        every: int = 1,
        offsets: Offsets | None = None,
    ) -> None:
        self.place, self._offsets = place, offsets
        hears = (place.stamper,) if hears is None else hears
        keys = place.keys
        self._heard = (
            *(keys.of(channels.BEAT, *one) for one in hears),
            *(keys.of(channels.BEATS, node) for node in nodes),
        )
        self.detector = FailureDetector(place.who, place.patience_ns)
        self._state, self._holds = state, holds
        self._every_ns = every * place.period_ns
        self._digest = digests(place.problem)["wiring"]
        self._nodes = frozenset(place.problem.fabric.nodes)
        self._known = {role.who: role.node for role in roles(place.problem)}
        self._next_ns = -NEVER_NS
        #: Instant until which the process sends its beats itself, too.
        self.alone_until_ns = -NEVER_NS
        #: Rejected senders, by name: the reason, and the time of the last beat.
        self.strangers: dict[str, tuple[str, int]] = {}
        self._rivals: dict[str, int] = {}
        self._complained = 0
        self._repeat_until_ns = -NEVER_NS
        self._key = keys.of(channels.BEAT, place.node, place.who)
        self._returned = keys.detour(self._key)
        # Last direct beats by key: an equal copy from the detour is skipped without decoding.
        self._detoured: dict[str, bytes] = {}

    def subscriptions(self) -> tuple[str, ...]:
        """Key expressions of the beats to subscribe to."""
        return self._heard

    def receive(self, sample: Arrival, now_ns: int) -> list[ReceivedBeat]:
        """Process beats; return those that are valid and new."""
        if not self.hears(sample) or self._is_copy(sample):
            return []
        try:
            beats = self.place.beats(sample)
        except LiveError as error:
            who = sample.key.rpartition("/")[2]
            reason = f"{who}: {error}; does Dwell {__version__} run there, as here?"
            self.place.complain(LiveError(reason))
            return []
        keys, sent_ns, new = self.place.keys, beats[0].sent_ns, []
        direct = keys.came_directly(sample.key)
        alone = direct and self.place.channel(sample) is channels.BEAT
        for beat in beats:
            if differs := self._differs(beat):
                self._note_stranger(beat.who, differs, now_ns)
                continue
            self.strangers.pop(beat.who, None)
            if direct and beat is beats[0]:
                self._look_for_rival(beat)
            # The agent has had the beats of the other processes for a while.
            at_ns = now_ns - max(sent_ns - beat.sent_ns, 0)
            if self.detector.hear(beat, at_ns, direct=direct):
                new.append(ReceivedBeat(beat, at_ns, direct))
                if direct and self._offsets is not None:
                    self._offsets.hear(beat, at_ns)
                if alone and (beat.alone or beat.who == self.place.stamper[1]):
                    self.alone_until_ns = now_ns + self.place.patience_ns
        return new

    def _is_copy(self, sample: Arrival) -> bool:
        """Whether these are the sender's last direct beats again, or this process's own beat."""
        keys = self.place.keys
        if not keys.came_directly(sample.key):
            known = self._detoured.get(sample.key)
            return sample.key == self._returned or known == sample.payload
        name = keys.detour(sample.key)
        if name in self._detoured or len(self._detoured) < MAX_STRANGERS:
            self._detoured[name] = sample.payload
        return False

    def _differs(self, beat: Beat) -> str:
        """Return the reason to reject a beat; empty if there is none."""
        place = self.place
        same = beat.version in ("", __version__)
        if not same and _series(beat.version) != _series(__version__):
            return (
                f"{beat.who} runs Dwell {beat.version}, and {place.who} {__version__}; "
                "install one version on all nodes"
            )
        if beat.cell != self._digest:
            return (
                f"{beat.who} has another cell file ({beat.cell}) than {place.who} "
                f"({self._digest}); copy one file to all nodes"
            )
        strange = {heard.node for heard in beat.heard} - self._nodes
        if self._known.get(beat.who) != beat.node or strange:
            return f"{beat.who} on {beat.node} is no process of cell {place.problem.name!r}"
        return ""

    def _note_stranger(self, who: str, differs: str, now_ns: int) -> None:
        """Remember a rejected sender, and complain once per reason."""
        known = self.strangers.get(who)
        if known is None and len(self.strangers) >= MAX_STRANGERS:
            del self.strangers[next(iter(self.strangers))]
        self.strangers[who] = differs, now_ns
        if known is None or known[0] != differs:
            self.place.complain(LiveError(differs))

    def _look_for_rival(self, beat: Beat) -> None:
        """Complain if two processes have one name: beats of an earlier life keep arriving."""
        last = self.detector.last(beat.who)
        if last is None or beat.life >= last.life:
            return
        count = self._rivals.get(beat.who, 0) + 1
        if count >= RIVAL_BEATS:
            count = 0
            reason = f"two processes say that they are {beat.who}; end one: its agent runs twice?"
            self.place.complain(LiveError(reason))
        self._rivals[beat.who] = count

    def hears(self, sample: Arrival) -> bool:
        """Whether a message has beats."""
        return self.place.channel(sample) in (channels.BEAT, channels.BEATS)

    def wake(self, now_ns: int) -> int:
        """Make the beat if it is due; return the instant of the next one.

        All processes of a node make their beats at the same instants, just before their agent's.
        """
        # If the next beat is due later than one interval from now, the clock was set back.
        if now_ns >= self._next_ns or self._next_ns > now_ns + self._every_ns:
            self._next_ns = (now_ns // self._every_ns + 1) * self._every_ns
            alone = not self._is_sent(now_ns)
            beat = self.made(now_ns, alone=alone)
            self._put(beat, alone=alone or now_ns < self.alone_until_ns)
        return self._next_ns

    def send(self, now_ns: int) -> None:
        """Send a beat at once."""
        self._put(self.made(now_ns))

    def send_alone(self, now_ns: int, *, ready: bool, note: str) -> None:
        """Send a beat from another thread while the role is busy, without its state."""
        self._put(self._made(now_ns, ready, note, ()))

    def _is_sent(self, now_ns: int) -> bool:
        """Whether the agent sends this process's beats; adopts its comparison of the clocks."""
        place, slots = self.place, self.place.slots
        if slots is None:
            return True
        try:
            receipt = decode(slots.read(f"agent@{place.node}"), Receipt)
        except LiveError:
            return False
        late_ns = place.period_ns * 3 // 2
        if not 0 <= now_ns - receipt.sent_ns <= late_ns:
            return False
        if self._offsets is not None:
            self._offsets.adopt(ClockOffset(*receipt.clock), receipt.life)
        return now_ns - receipt.beats.get(place.who, -NEVER_NS) <= self._every_ns + late_ns

    def own(self, who: str, now_ns: int) -> None:
        """Read the beat of another process of this node from its slot."""
        slots = self.place.slots
        if slots is not None and (beat := beat_in(slots, who, now_ns)) is not None:
            self.detector.hear(beat, beat.sent_ns)

    def made(self, now_ns: int, *, alone: bool = False) -> Beat:
        """Return a new beat."""
        ready, note = self._state()
        note, heard = note or self._repeated(now_ns), self.detector.heard(now_ns)
        return self._made(now_ns, ready, note, heard, alone=alone)

    def _made(
        self, now_ns: int, ready: bool, note: str, heard: tuple[Heard, ...], *, alone: bool = False
    ) -> Beat:
        place = self.place
        term, placement, run, moving, rates = self._holds()
        keyring = None if place.seals is None else place.seals.keyring
        keys = (0, 0) if keyring is None else (keyring.own.generation, keyring.roster.number)
        return Beat(
            *(place.who, place.node, place.life, now_ns, ready, heard, term, placement),
            *(self._digest, printable(note)[:2000], __version__, run, moving, *keys, alone),
            rates=rates,
        )

    def _put(self, beat: Beat, *, alone: bool = True) -> None:
        slots = self.place.slots
        if slots is not None:
            slots.write(encode(beat))
        if alone or slots is None:
            self.place.send(channels.BEAT, beat, beat.node, beat.who)

    def _repeated(self, now_ns: int) -> str:
        """Return the last complaint if it is at most `REPEATED_NS` old; else an empty string."""
        place = self.place
        if place.complained != self._complained:
            self._complained = place.complained
            self._repeat_until_ns = now_ns + REPEATED_NS
        return place.last_complaint if now_ns < self._repeat_until_ns else ""


def _series(version: str) -> str:
    """Return major and minor version; they must be equal for processes to work together."""
    return ".".join(version.split(".")[:2])


def beat_in(slots: BeatSlots, who: str, now_ns: int) -> Beat | None:
    """Return the beat in a process's slot; None without a beat of this boot."""
    try:
        beat = decode(slots.read(who), Beat)
    except LiveError:
        return None
    return beat if beat.who == who and beat.sent_ns <= now_ns else None
