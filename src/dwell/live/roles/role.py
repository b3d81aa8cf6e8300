"""RolePlace, RoleLogic and Pulse: every process of a cell hears, wakes and beats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import msgspec

from dwell.errors import LiveError, TrustError
from dwell.live.log import printable
from dwell.live.roles.failure_detector import FailureDetector
from dwell.live.roles.offsets import Offsets
from dwell.live.wire.keys import CONTROLLER, TWICE, Keys
from dwell.live.wire.messages import (
    MAX_HEADER_BYTES,
    SIGNATURE_BYTES,
    Beat,
    Carried,
    Completion,
    Header,
    Heard,
    Load,
    Stamp,
    decode,
    encode,
)
from dwell.live.wire.transport import Arrival, Transport
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from dwell.model.bounds import require
from dwell.model.document import digests
from dwell.model.instants import NEVER_NS
from dwell.version import __version__

#: What PTP and chrony on one network keep to.
SYSTEM_BOUND_NS = 1_000_000
#: Different complaints that are counted; a new one takes the place of the oldest.
MAX_COMPLAINTS = 100
#: Processes that are remembered for not belonging to the cell as this one knows it.
MAX_STRANGERS = 256
#: How long a beat repeats a complaint, and a stranger who has fallen silent is remembered.
REPEATED_NS = 10_000_000_000
#: Beats of an earlier life, one after another, that no late message explains.
RIVAL_BEATS = 5
#: Periods between two beats of an agent, and between two reports of another process's beats.
AGENT_BEAT = 5

if TYPE_CHECKING:
    from dwell.live.trust.signing import Seals

T = TypeVar("T", bound=msgspec.Struct)


class BeatState(NamedTuple):
    """Fields of a beat that only some processes fill (see `Beat`)."""

    term: int = 0
    placement: str = ""
    run: int = 0
    moving: bool = False


class RoleLogic(Protocol):
    """A process of a cell, without its threads, sockets and clock.

    Its host calls one method at a time: `receive` for every message under its
    `subscriptions`, `wake` when the instant has come that the last call returned.
    """

    def subscriptions(self) -> Iterable[str]:
        """Key expressions that it wants to hear."""

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        """Take a message in; returns an instant at which something is due since, if that is so."""

    def wake(self, now_ns: int) -> int:
        """Do what is due; returns the next instant at which something is."""


@dataclass(slots=True)
class RolePlace:
    """Where a role runs.

    Parameters
    ----------
    who, node : str
        Name of the process, unique in the cell, and its node.
    life : int
        Grows with every start of the process.
    complaints : dict of str to int
        How often something arrived that could not be used, by what was wrong with it.
    seals : Seals, optional
        Signs what it says and checks what it hears; without, nothing is signed.
    """

    problem: Problem
    who: str
    node: str
    transport: Transport
    life: int = 0
    complaints: dict[str, int] = field(default_factory=dict)
    say: Callable[[str], None] | None = None
    seals: Seals | None = None
    complained: int = 0
    last_complaint: str = ""
    #: Keys of its cell, and P.
    keys: Keys = field(init=False)
    period_ns: int = field(init=False)

    def __post_init__(self) -> None:
        phase_ms = self.problem.pipeline.first_release_ms
        require(phase_ms == 0, "phase_ms", phase_ms, "0 in a live cell, which begins when it is up")
        self.keys = Keys(self.problem.name)
        self.period_ns = self.problem.pipeline.period_ns

    @property
    def patience_ns(self) -> int:
        """Age beyond which what was heard counts no more: g periods."""
        return self.problem.controller.guard_cycles * self.period_ns

    @property
    def hang_ns(self) -> int:
        """Time from which on a call of a user's code hangs."""
        return max(10 * self.period_ns, 1_000_000_000)

    @property
    def stamper(self) -> tuple[str, str]:
        """Node and name of the stamper."""
        node = self.problem.stamper_node
        return node, f"stamper@{node}"

    def offsets(self) -> Offsets:
        """Make what compares clocks with that of the stamper's node."""
        system = self.problem.live.clock == "system"
        return Offsets(
            self.node,
            self.problem.stamper_node,
            system_bound_ns=SYSTEM_BOUND_NS if system else None,
        )

    def put(self, key: str, message: msgspec.Struct) -> None:
        """Send a small message, signed where there are keys."""
        self.transport.put(key, self._sealed(key, message))

    def _sealed(self, key: str, message: msgspec.Struct) -> bytes:
        data = encode(message)
        return data if self.seals is None else self.seals.seal(self.keys.word(key), data)

    def read(self, sample: Arrival, kind: type[T], by: Callable[[T], str]) -> T:
        """Read a message that `put` or `put_twice` has sent.

        Parameters
        ----------
        by : callable
            Returns the subject who has to have signed it: a node, or the controller.

        Raises
        ------
        LiveError
            If it is anything else, or signed by anybody else.
        """
        if self.seals is None:
            return decode(sample.payload, kind)
        message = decode(sample.payload[SIGNATURE_BYTES:], kind)
        self._require(sample, by(message))
        return message

    def _require(self, sample: Arrival, name: str) -> None:
        """Raise a LiveError unless a message was signed by a subject."""
        if self.seals is not None:
            try:
                self.seals.require(self.keys.word(sample.key), name, sample.payload)
            except TrustError as error:
                raise LiveError(str(error)) from None

    def stamped(self, stamp: Stamp) -> bytes:
        """Return the signature of a stamp that this process has made; nothing without keys."""
        if self.seals is None:
            return b""
        return self.seals.seal("stamp", encode(stamp))[:SIGNATURE_BYTES]

    def _require_stamped(self, seals: Seals, header: Header) -> None:
        """Raise a TrustError unless the stamper has stamped a cycle, or its source guessed it."""
        names = {self.stamper[0]}
        if not header.stamp.term:
            pipeline = self.problem.pipeline
            sources = (task for name, task in pipeline.tasks.items() if not pipeline.inputs(name))
            names = {node for task in sources for node in task.on} - names
        sealed = header.seal + encode(header.stamp)
        for name in names:
            with suppress(TrustError):
                seals.require("stamp", name, sealed)
                return
        raise TrustError(f"stamp: cycle {header.stamp.cycle} is not signed by who may stamp it")

    def completion(self, sample: Arrival) -> Completion:
        """Read what a sink, or a task where a cycle ended, says of a cycle.

        Raises
        ------
        LiveError
            If it is none, or about a task that does not run where it says.
        """
        done = self.read(sample, Completion, lambda done: done.node)
        task = self.problem.pipeline.tasks.get(done.sink)
        named = self.keys.word(sample.key) == "ended" or sample.key.endswith(f"/{done.sink}")
        if task is None or done.node not in task.on or not named:
            raise LiveError(f"{sample.key}: {done.sink} does not run on {done.node}")
        return done

    def load(self, sample: Arrival) -> Load:
        """Read what an agent says of its node.

        Raises
        ------
        LiveError
            If it is none, or about another node than its key says.
        """
        load = self.read(sample, Load, lambda load: load.node)
        if not sample.key.endswith(f"/{load.node}"):
            raise LiveError(f"{sample.key}: the load of {load.node}")
        return load

    def beat(self, sample: Arrival) -> Beat:
        """Read a beat.

        A beat that came directly was let through for its sender's certificate; a beat that was
        carried here is believed for its signature.

        Raises
        ------
        LiveError
            If it is none, or another's than its key says.
        """
        signed = 0 if self.seals is None else SIGNATURE_BYTES
        beat = decode(sample.payload[signed:], Beat)
        if not sample.key.endswith(f"/{beat.node}/{beat.who}"):
            raise LiveError(f"{sample.key}: a beat of {beat.who} on {beat.node}")
        if not self.keys.came_directly(sample.key):
            controls = beat.who == f"controller@{self.problem.controller_node}"
            self._require(sample, CONTROLLER if controls else beat.node)
        return beat

    def put_twice(self, key: str, message: msgspec.Struct) -> None:
        """Send a small message directly, and over the detour; signed where there are keys.

        Processes on the relay's own node do so, too: the detour reaches processes that have no
        connection of their own to the sender.
        """
        payload = self._sealed(key, message)
        self.transport.put(key, payload)
        self.transport.put(self.keys.relay(key), payload)

    def around(self, sample: Arrival) -> list[Arrival]:
        """Return the messages that came over the detour together."""
        try:
            carried = decode(sample.payload, Carried)
        except LiveError as error:
            self.complain(error)
            return []
        keys = self.keys
        arrivals = [Arrival(keys.detour(key), payload) for key, payload in carried.messages]
        fit = [arrival for arrival in arrivals if keys.word(arrival.key) in TWICE]
        if len(fit) < len(arrivals):
            self.complain(LiveError(f"{sample.key}: has what never takes the detour"))
        return fit

    def complain(self, error: LiveError) -> None:
        """Count a message that could not be used; a flood of them takes no memory."""
        what = printable(str(error))[:300]
        if what not in self.complaints and len(self.complaints) >= MAX_COMPLAINTS:
            del self.complaints[next(iter(self.complaints))]
        self.complaints[what] = self.complaints.get(what, 0) + 1
        self.complained += 1
        self.last_complaint = what
        if self.say is not None:
            self.say(what)

    def header(self, sample: Arrival) -> Header | None:
        """Read the header of a data message; None, and a complaint, where it is none.

        So it is where nobody has stamped the cycle who may: a cycle with too high a number would
        keep all others from the actuator.
        """
        try:
            header = decode(sample.header, Header, limit=MAX_HEADER_BYTES)
            if self.seals is not None:
                self._require_stamped(self.seals, header)
            return header
        except (LiveError, TrustError) as error:
            self.complain(LiveError(f"{sample.key}: {error}"))
            return None


class Pulse:
    """Beats of a process: its own, and those that it hears.

    Parameters
    ----------
    state : callable
        Returns whether the process is ready, and what keeps it from that or went wrong last.
    holds : callable, optional
        Returns the rest of the beat.
    hears : iterable of (str, str), optional
        Nodes and processes, or ``*``, whose beats it wants; by default the stamper's only.
    every : int
        Periods between two of its beats.
    """

    def __init__(
        self,
        place: RolePlace,
        state: Callable[[], tuple[bool, str]],
        holds: Callable[[], BeatState] = BeatState,
        *,
        hears: Iterable[tuple[str, str]] | None = None,
        every: int = 1,
    ) -> None:
        self.place = place
        self._hears = (place.stamper,) if hears is None else tuple(hears)
        self.detector = FailureDetector(place.who, place.patience_ns)
        self._state, self._holds = state, holds
        self._every_ns = every * place.period_ns
        self._digest = digests(place.problem)["wiring"]
        self._nodes = frozenset(place.problem.fabric.nodes)
        self._known = {role.who: role.node for role in roles(place.problem)}
        self._next_ns = self._sent_ns = -NEVER_NS
        #: Who is not heard because of its cell file or version: why, and when it beat last.
        self.strangers: dict[str, tuple[str, int]] = {}
        self._rivals: dict[str, int] = {}
        self._complained = 0
        self._repeat_until_ns = -NEVER_NS
        keys = place.keys
        self._key = keys.beat(place.node, place.who)
        self._returned = keys.detour(self._key)
        direct = keys.beat("", "").removesuffix("/")
        self._prefix = direct, keys.detour(direct)
        # Beats as they came directly: their copies say nothing new, and need not be read.
        self._detoured: dict[str, bytes] = {}

    def subscriptions(self) -> tuple[str, ...]:
        """Key expressions of beats."""
        keys = self.place.keys
        return tuple(keys.beat(node, who) for node, who in self._hears)

    def receive(self, sample: Arrival, now_ns: int) -> Beat | None:
        """Take a beat in; None where it is none, or no news."""
        if not sample.key.startswith(self._prefix):
            return None
        if self._is_copy(sample):
            return None
        try:
            beat = self.place.beat(sample)
        except LiveError as error:
            who = sample.key.rpartition("/")[2]
            reason = f"{who}: {error}; does Dwell {__version__} run there, as here?"
            self.place.complain(LiveError(reason))
            return None
        if differs := self._differs(beat):
            self._note_stranger(beat.who, differs, now_ns)
            return None
        self.strangers.pop(beat.who, None)
        direct = sample.key.startswith(self._prefix[0])
        if direct:
            self._look_for_rival(beat)
        return beat if self.detector.hear(beat, now_ns, direct=direct) else None

    def _is_copy(self, sample: Arrival) -> bool:
        """Whether a beat is the copy of the last that came directly, or of one of its own."""
        direct, detour = self._prefix
        if sample.key == self._returned:
            return True
        if sample.key.startswith(detour):
            return self._detoured.get(sample.key[len(detour) :]) == sample.payload
        name = sample.key[len(direct) :]
        if name in self._detoured or len(self._detoured) < MAX_STRANGERS:
            self._detoured[name] = sample.payload
        return False

    def _differs(self, beat: Beat) -> str:
        """Return why a beat is not heard, or nothing."""
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
        """Remember who is not heard, and say it once."""
        known = self.strangers.get(who)
        if known is None and len(self.strangers) >= MAX_STRANGERS:
            del self.strangers[next(iter(self.strangers))]
        self.strangers[who] = differs, now_ns
        if known is None or known[0] != differs:
            self.place.complain(LiveError(differs))

    def _look_for_rival(self, beat: Beat) -> None:
        """Notice two processes of one name: the earlier one of two lives goes on beating."""
        last = self.detector.last(beat.who)
        if last is None or beat.life >= last.life:
            return
        count = self._rivals.get(beat.who, 0) + 1
        if count >= RIVAL_BEATS:
            count = 0
            reason = f"two processes say that they are {beat.who}; end one: its agent runs twice?"
            self.place.complain(LiveError(reason))
        self._rivals[beat.who] = count

    def compare_clocks(self, sample: Arrival, now_ns: int, offsets: Offsets) -> None:
        """Take a beat in, and what it tells of the clocks if it came directly."""
        beat = self.receive(sample, now_ns)
        if beat is not None and self.place.keys.came_directly(sample.key):
            offsets.hear(beat, now_ns)

    def hears(self, sample: Arrival) -> bool:
        """Whether a message is a beat."""
        return sample.key.startswith(self._prefix)

    def wake(self, now_ns: int) -> int:
        """Send the beat that is due; returns when the next is."""
        # Due later than after a whole interval: the clock has been set back.
        back = self._next_ns > now_ns + self._every_ns
        if back or now_ns >= self._next_ns:
            self.send(now_ns)
            late = now_ns >= self._next_ns + self._every_ns
            self._next_ns = (now_ns if late or back else self._next_ns) + self._every_ns
        return self._next_ns

    def put_off(self, due_ns: int) -> None:
        """Send the next beat at an instant instead, but half an interval late at most."""
        self._next_ns = min(due_ns, self._sent_ns + self._every_ns * 3 // 2)

    def send(self, now_ns: int) -> None:
        """Send a beat."""
        self._sent_ns = now_ns
        ready, note = self._state()
        self._put(now_ns, ready, note or self._repeated(now_ns), self.detector.heard())

    def send_alone(self, now_ns: int, *, ready: bool, note: str) -> None:
        """Send a beat without a look at the role: from another thread, while the role is busy."""
        self._put(now_ns, ready, note, ())

    def _put(self, now_ns: int, ready: bool, note: str, heard: tuple[Heard, ...]) -> None:
        place = self.place
        term, placement, run, moving = self._holds()
        keyring = None if place.seals is None else place.seals.keyring
        keys = (0, 0) if keyring is None else (keyring.own.generation, keyring.roster.number)
        beat = Beat(
            *(place.who, place.node, place.life, now_ns, ready, heard, term, placement),
            *(self._digest, printable(note)[:2000], __version__, run, moving, *keys),
        )
        place.put_twice(self._key, beat)

    def _repeated(self, now_ns: int) -> str:
        """Return the last complaint, for a while after it was made."""
        place = self.place
        if place.complained != self._complained:
            self._complained = place.complained
            self._repeat_until_ns = now_ns + REPEATED_NS
        return place.last_complaint if now_ns < self._repeat_until_ns else ""


def _series(version: str) -> str:
    """Return what two versions that understand each other have in common: major and minor."""
    return ".".join(version.split(".")[:2])
