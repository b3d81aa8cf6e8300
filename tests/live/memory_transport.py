"""A network in memory: deterministic, on a clock that only the test moves.

Every link between two processes can delay, lose, double and reorder messages, be cut, or stall;
processes can freeze, die and come back. Whole cells run in it: whoever attaches a participant is
called with what arrives and at the instants it asked for, in order of time and, at one instant, in
the order in which things were put.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import count
from math import inf
from random import Random
from typing import Protocol, TypeAlias

import zenoh

from dwell.errors import LiveError
from dwell.live.host.hosting import LONGEST_SLEEP_S
from dwell.live.wire.transport import Arrival, Lane, Receive, require_expression, require_key
from dwell.live.wire.wiring import Session, Wiring, session_of

#: Says who may hear whom: names of sender and receiver, lane, key.
Reach: TypeAlias = Callable[[str, str, Lane, str], bool]

#: How many messages wait for a link that stalls, or a process that is frozen.
STALLED_MESSAGES = 64
LONGEST_SLEEP_NS = round(LONGEST_SLEEP_S * 1e9)


def matcher(expression: str) -> Callable[[str], bool]:
    """Return what tells whether a key is under an expression, as Zenoh says."""
    require_expression(expression)
    known = zenoh.KeyExpr(expression)
    return lru_cache(lambda key: known.includes(zenoh.KeyExpr(key)))


class Participant(Protocol):
    """A process without its input and output: what `Network.attach` drives."""

    def subscriptions(self) -> Iterable[str]:
        """Key expressions that it wants to hear."""
        ...

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        """Take a message; returns an instant at which something is due since, if that is so."""
        ...

    def wake(self, now_ns: int) -> int | None:
        """Do what is due, and say when to be called next; None for not before a message."""
        ...


@dataclass(frozen=True, slots=True)
class Clock:
    """A node's clock, as a function of the network's.

    Parameters
    ----------
    offset_ns : int
        What it shows beyond the network's at 0.
    drift_ppm : float
        What it gains, microseconds a second.
    """

    offset_ns: int = 0
    drift_ppm: float = 0.0

    def shown(self, at_ns: int) -> int:
        """What it shows at an instant of the network."""
        if not self.drift_ppm:
            return at_ns + self.offset_ns
        return at_ns + self.offset_ns + round(at_ns * self.drift_ppm * 1e-6)

    def instant(self, shown_ns: int) -> int:
        """First instant of the network at which it shows at least that."""
        if not self.drift_ppm:
            return shown_ns - self.offset_ns
        guess = round((shown_ns - self.offset_ns) / (1.0 + self.drift_ppm * 1e-6))
        while self.shown(guess) < shown_ns:
            guess += 1
        while self.shown(guess - 1) >= shown_ns:
            guess -= 1
        return guess


@dataclass(frozen=True, slots=True)
class NetworkConditions:
    """What happens to messages on their way.

    Parameters
    ----------
    delay_ns : int, or function of Random to int
        Added to what other conditions add.
    loss, duplication, reordering : float
        Probabilities: that a message is lost, that it arrives twice, that it is held back by
        `reorder_ns` and others may overtake it.
    rate_mbps : float
        Of each path of a lane: a message begins its transmission when the one before has ended.
    stalled : bool
        Whether messages wait until this is lifted; the oldest beyond `waiting` are dropped.
    """

    delay_ns: int | Callable[[Random], int] = 0
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    reorder_ns: int = 1_000_000
    rate_mbps: float = inf
    stalled: bool = False
    waiting: int = STALLED_MESSAGES


@dataclass(eq=False, slots=True)
class _Rule:
    source: str
    target: str
    applies: Callable[[str], bool]
    conditions: NetworkConditions

    def holds(self, source: MemoryTransport, target: MemoryTransport, key: str) -> bool:
        return (
            self.source in ("*", source.who, source.node)
            and self.target in ("*", target.who, target.node)
            and self.applies(key)
        )


@dataclass(eq=False, slots=True)
class _Message:
    source: MemoryTransport
    target: MemoryTransport
    lane: Lane
    sample: Arrival


@dataclass(eq=False, slots=True)
class _Path:
    """What is remembered of one sender, receiver and lane."""

    random: Random
    last_ns: int = 0
    #: When the last transmission at a limited rate ends.
    free_ns: int = 0
    held: deque[_Message] = field(default_factory=deque)


class MemoryTransport:
    """One process's end of a `Network`; see `Transport`."""

    def __init__(self, network: Network, who: str, node: str, clock: Clock) -> None:
        self.who = who
        self.node = node
        self.clock = clock
        self.closed = False
        self.frozen = False
        self.network = network
        self._subscriptions: list[tuple[Callable[[str], bool], Receive]] = []
        #: By key: who is called with a message under it.
        self._receivers: dict[str, tuple[Receive, ...]] = {}
        #: Messages, and then wakes, that are put off until it thaws.
        self.inbox: deque[_Message] = deque(maxlen=STALLED_MESSAGES)
        self.wakes: list[Callable[[], None]] = []

    @property
    def now_ns(self) -> int:
        """What the clock of its node shows."""
        return self.clock.shown(self.network.now_ns)

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message; returns at once, whatever the receivers do."""
        if not self.closed:
            self.network.send(self, Arrival(key, bytes(payload), bytes(header)), lane)

    def subscribe(self, key: str, receive: Receive) -> None:
        """Have `receive` called with every message under a key expression (``*``, ``**``)."""
        matches = matcher(key)
        if not self.closed:
            self._subscriptions.append((matches, receive))
            self._receivers.clear()
            self.network.rewire()

    def receivers(self, key: str) -> tuple[Receive, ...]:
        """Return what was subscribed with key expressions that a key is under, in order."""
        found = self._receivers.get(key)
        if found is None:
            found = tuple(receive for matches, receive in self._subscriptions if matches(key))
            self._receivers[key] = found
        return found

    def close(self) -> None:
        """Send and deliver nothing more; safe to call twice."""
        if not self.closed:
            self.closed = True
            self._subscriptions.clear()
            self._receivers.clear()
            self.inbox.clear()
            self.wakes.clear()
            self.network.forget(self)


class Network:
    """Carries messages between `MemoryTransport`s.

    Parameters
    ----------
    seed : int
        Every pair of processes draws from a stream of its own, so that one more participant
        changes nothing for the others.
    start_ns : int
        Where the clock begins.
    delay_ns : int
        What every message takes at least.
    reach : function, optional
        Who may hear whom; everybody hears everybody where None.
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        start_ns: int = 0,
        delay_ns: int = 0,
        reach: Reach | None = None,
    ) -> None:
        self.now_ns = start_ns
        self.seed = seed
        self.delay_ns = delay_ns
        #: Called with every message that is put, at its instant.
        self.taps: list[Receive] = []
        self.lost = 0
        self._reach = reach
        #: By sender, lane and key: who hears it, and the path there.
        self._audiences: dict[tuple[str, Lane, str], list[tuple[MemoryTransport, _Path]]] = {}
        self._transports: dict[str, MemoryTransport] = {}
        self._rules: list[_Rule] = []
        self._paths: dict[tuple[str, str, Lane], _Path] = {}
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._sequence = count()

    # ------------------------------------------------------------------ who is there

    def transport(
        self, who: str, node: str | None = None, *, clock: Clock | None = None
    ) -> MemoryTransport:
        """Return the end of a process; one of the name that was closed may come back.

        Parameters
        ----------
        node : str, optional
            What follows the ``@`` in its name where None, without what follows a dot there.
        clock : Clock, optional
            The node's clock; the network's where None.

        Raises
        ------
        LiveError
            If somebody of that name is there.
        """
        if who in self._transports:
            raise LiveError(f"{who} is in the network already; close it first")
        if node is None:
            node = who.partition("@")[2].partition(".")[0] or who
        end = MemoryTransport(self, who, node, clock or Clock())
        self._transports[who] = end
        return end

    @property
    def reach(self) -> Reach | None:
        """Says who may hear whom; None where everybody hears everybody."""
        return self._reach

    @reach.setter
    def reach(self, reach: Reach | None) -> None:
        self._reach = reach
        self.rewire()

    def attach(self, end: MemoryTransport, participant: Participant) -> None:
        """Drive a participant: hand it what it subscribes to, and wake it when it wants.

        It is woken once at the present instant, then when it has asked for it, as by a real host.
        """
        drive = _Drive(self, end, participant)
        for key in participant.subscriptions():
            end.subscribe(key, drive.receive)
        self.call_at(self.now_ns, lambda: drive.wake(None))

    def call_at(self, at_ns: int, call: Callable[[], None]) -> None:
        """Have something done at an instant, or at once if that has passed."""
        heapq.heappush(self._events, (max(at_ns, self.now_ns), next(self._sequence), call))

    # ------------------------------------------------------------- what goes wrong

    def impair(
        self,
        conditions: NetworkConditions,
        source: str = "*",
        target: str = "*",
        *,
        key: str = "**",
    ) -> object:
        """Put conditions on messages from one process or node to another; several add up.

        Parameters
        ----------
        source, target : str
            Name of a process or of a node, or ``*``; the other direction is not touched.
        key : str
            Expression that only some messages are under.

        Returns
        -------
        object
            What `heal` takes.
        """
        rule = _Rule(source, target, matcher(key), conditions)
        self._rules.append(rule)
        return rule

    def cut(self, source: str = "*", target: str = "*", *, key: str = "**") -> object:
        """Lose everything from one process or node to another until that is healed."""
        return self.impair(NetworkConditions(loss=1.0), source, target, key=key)

    def stall(
        self,
        source: str = "*",
        target: str = "*",
        *,
        key: str = "**",
        waiting: int = STALLED_MESSAGES,
    ) -> object:
        """Hold everything back until that is healed, as a link that hangs does."""
        return self.impair(
            NetworkConditions(stalled=True, waiting=waiting), source, target, key=key
        )

    def heal(self, rule: object) -> None:
        """Lift what `impair`, `cut` or `stall` put on; what waited for it goes on its way."""
        self._rules = [other for other in self._rules if other is not rule]
        for path in self._paths.values():
            held, path.held = path.held, deque()
            for message in held:
                self._forward(path, message)

    def set_clock(self, node: str, clock: Clock) -> None:
        """Have a node's processes read another clock from now on."""
        for end in self._transports.values():
            if end.node == node:
                end.clock = clock

    def freeze(self, who: str, *, waiting: int = STALLED_MESSAGES) -> None:
        """Stop a process as SIGSTOP does: it is not called, and its newest messages wait."""
        end = self._transports[who]
        end.frozen = True
        end.inbox = deque(end.inbox, maxlen=waiting)

    def thaw(self, who: str) -> None:
        """Let a frozen process go on: all that waited happens now, in order."""
        end = self._transports[who]
        end.frozen = False
        while end.inbox and not end.frozen:
            self._arrive(end.inbox.popleft())
        wakes, end.wakes = end.wakes, []
        for wake in wakes:
            wake()

    def end(self, who: str) -> MemoryTransport | None:
        """Return the end of a process; None where it is dead."""
        return self._transports.get(who)

    def kill(self, who: str) -> None:
        """End a process; what is on the way to it is lost, what it sent is not."""
        self._transports[who].close()

    # ----------------------------------------------------------------------- time

    def advance(self, until_ns: int) -> None:
        """Let everything happen that is due by an instant, which then is the present one."""
        events = self._events
        while events and events[0][0] <= until_ns:
            self.now_ns, _, call = heapq.heappop(events)
            call()
        self.now_ns = max(self.now_ns, until_ns)

    def step(self) -> bool:
        """Let the next thing happen; return whether there was one."""
        if not self._events:
            return False
        self.now_ns, _, call = heapq.heappop(self._events)
        call()
        return True

    @property
    def next_ns(self) -> float:
        """Instant of the next thing to happen; infinite if nothing will."""
        return self._events[0][0] if self._events else inf

    # ----------------------------------------------------------- for the transports

    def send(self, source: MemoryTransport, sample: Arrival, lane: Lane) -> None:
        """Send a message to everybody who subscribed to it, the sender left out."""
        key = source.who, lane, sample.key
        audience = self._audiences.get(key)
        if audience is None:
            require_key(sample.key)
            audience = self._audiences[key] = list(self._audience(*key))
        for tap in self.taps:
            tap(sample)
        for target, path in audience:
            self._forward(path, _Message(source, target, lane, sample))

    def _audience(
        self, source: str, lane: Lane, key: str
    ) -> Iterator[tuple[MemoryTransport, _Path]]:
        for target in self._transports.values():
            if target.who == source or not target.receivers(key):
                continue
            if self.reach is None or self.reach(source, target.who, lane, key):
                yield target, self._path(source, target.who, lane)

    def rewire(self) -> None:
        """Look anew who hears what: somebody has come, gone, or subscribed."""
        self._audiences.clear()

    def forget(self, end: MemoryTransport) -> None:
        """Take a closed transport out."""
        del self._transports[end.who]
        self.rewire()
        for path in self._paths.values():
            path.held = deque(message for message in path.held if message.target is not end)

    def _path(self, source: str, target: str, lane: Lane) -> _Path:
        key = (source, target, lane)
        if key not in self._paths:
            seed = f"{self.seed}/{source}/{target}/{lane}"
            self._paths[key] = _Path(Random(seed))
        return self._paths[key]

    def _forward(self, path: _Path, message: _Message) -> None:
        """Apply every condition to a message and put what is left of it on the agenda."""
        if not self._rules:
            path.last_ns = max(self.now_ns + self.delay_ns, path.last_ns)
            self.call_at(path.last_ns, partial(self._arrive, message))
            return
        random, copies, delay_ns, overtaken_ns = path.random, 1, self.delay_ns, 0
        for rule in self._rules:
            if not rule.holds(message.source, message.target, message.sample.key):
                continue
            conditions = rule.conditions
            if conditions.stalled:
                self._hold(path, message, conditions.waiting)
                return
            # Every draw is made whatever came before, so that one more loss shifts no later draw.
            lost, twice, later = random.random(), random.random(), random.random()
            extra = conditions.delay_ns
            delay_ns += extra if isinstance(extra, int) else extra(random)
            if conditions.rate_mbps < inf:
                took_ns = round(8e3 * len(message.sample.payload) / conditions.rate_mbps)
                path.free_ns = max(path.free_ns, self.now_ns) + took_ns
                delay_ns += path.free_ns - self.now_ns
            if lost < conditions.loss:
                copies = 0
            elif twice < conditions.duplication:
                copies *= 2
            if later < conditions.reordering:
                overtaken_ns += conditions.reorder_ns
        if copies == 0:
            self.lost += 1
            return
        at_ns = max(self.now_ns + delay_ns, path.last_ns)
        if overtaken_ns:
            at_ns += overtaken_ns
        else:
            path.last_ns = at_ns
        for _ in range(copies):
            self.call_at(at_ns, partial(self._arrive, message))

    def _hold(self, path: _Path, message: _Message, waiting: int) -> None:
        path.held.append(message)
        while len(path.held) > waiting:
            path.held.popleft()
            self.lost += 1

    def _arrive(self, message: _Message) -> None:
        target = message.target
        if target.closed:
            self.lost += 1
        elif target.frozen:
            self.lost += len(target.inbox) == target.inbox.maxlen
            target.inbox.append(message)
        else:
            sample = message.sample
            for receive in target.receivers(sample.key):
                if not target.closed:
                    receive(sample)


class _Drive:
    """Calls a participant at the instants it asks for, on the clock of its node."""

    def __init__(self, network: Network, end: MemoryTransport, participant: Participant) -> None:
        self.network = network
        self.end = end
        self.participant = participant
        #: Instant of the network for which the last wake was arranged; older ones are void.
        self.due_ns: int | None = None

    def receive(self, sample: Arrival) -> None:
        """Hand over a message, and see whether that makes something due sooner."""
        wanted_ns = self.participant.receive(sample, self.end.clock.shown(self.network.now_ns))
        if wanted_ns is not None:
            due_ns = self._instant(wanted_ns)
            if self.due_ns is None or due_ns < self.due_ns:
                self._arrange(due_ns)

    def wake(self, due_ns: int | None) -> None:
        """Wake the participant unless it has asked for another instant since."""
        if self.end.closed or due_ns != self.due_ns:
            return
        if self.end.frozen:
            self.end.wakes.append(lambda: self.wake(due_ns))
            return
        self.due_ns = None
        wanted_ns = self.participant.wake(self.end.clock.shown(self.network.now_ns))
        if wanted_ns is not None:
            self._arrange(self._instant(wanted_ns))

    def _instant(self, wanted_ns: int) -> int:
        """Return the network's instant for one of the node's clock; a host never sleeps long."""
        now_ns = self.network.now_ns
        latest_ns = now_ns + LONGEST_SLEEP_NS
        # A wake at the present instant would be followed by itself for ever.
        return min(max(self.end.clock.instant(wanted_ns), now_ns + 1), latest_ns)

    def _arrange(self, due_ns: int) -> None:
        if not self.end.closed:
            self.due_ns = due_ns
            self.network.call_at(due_ns, partial(self.wake, due_ns))


def connected(wiring: Wiring, one: str, other: str) -> frozenset[Session]:
    """Return the sessions in which two processes hear each other."""
    pairs = (one, other), (other, one)
    return frozenset(wire.session for wire in wiring.wires if (wire.source, wire.target) in pairs)


def hears(wiring: Wiring, source: str, target: str, lane: Lane, key: str) -> bool:
    """Whether a message of one process can reach another."""
    return session_of(wiring.entry(source), lane, key) in connected(wiring, source, target)
