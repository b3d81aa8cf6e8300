"""Observer of a live cell, from outside.

It subscribes to two channels of the protocol, like a controller: the stamps of the stamper, and the
messages that the relay's agent gathers (beats, completions, answers, loads). It also requests the
status of the controller, like `dwell live status`. With keys it signs as an operator or observer
and accepts only signed messages; it uses newer keys as a controller does
(`dwell.live.host.key_renewal`).

Instants are converted to the stamper's clock, as in the controller (`dwell.live.roles.offsets`,
`dwell.live.roles.cycle_ledger`), and count from the first release of the run.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from dwell.dash.feed import Feed
from dwell.errors import LiveError
from dwell.live.failures import start_repeating
from dwell.live.host.operator_client import OperatorClient
from dwell.live.log import printable
from dwell.live.roles.cycle_ledger import Ledger, LiveCycle
from dwell.live.roles.data_ages import DataAges
from dwell.live.roles.role import Pulse
from dwell.live.wire import channels
from dwell.live.wire.local_addresses import running_elsewhere
from dwell.live.wire.messages import Stamped
from dwell.live.wire.transport import Arrival, Transport
from dwell.model import Problem
from dwell.model.instants import NEVER_NS
from dwell.record import shown_reason

if TYPE_CHECKING:
    from dwell.live.trust.keyring import Keyring

#: Largest number of cycles (with jobs, 2 to 3 kB each), windows and events in memory.
MOST_CYCLES, MOST_WINDOWS, MOST_EVENTS = 4_000, 4_000, 1_000
#: Least and largest time between two status requests to the controller.
LEAST_ASK_S, MOST_ASK_S = 0.1, 0.5
#: Wait for a cycle's completion after its deadline.
LATE_S = 1.0

#: Outcomes of a cycle that an observer can distinguish.
OUTCOMES = ("actuated", "not_applied", "behind", "stale", "replaced", "lost", "untold", "idle")

EventKind: TypeAlias = Literal["move", "guard", "refused", "pin", "drain", "health"]


@dataclass(frozen=True, slots=True)
class ObservedCycle:
    """A cycle that has ended, or whose completion is too late to wait for.

    Parameters
    ----------
    number : int
        Number in the stamp.
    release_ns : int
        Since the first release of the run.
    latency_ns : int or None
        None if no sink has completed the cycle, or the time of completion is unknown.
    known : bool
        Whether the outcome and the time of completion are known; if not, `missed` is false.
    outcome : str
        One of `OUTCOMES`.
    jobs : tuple of mapping
        Rows of the table ``jobs`` (`dwell.model.table_columns`), with the jobs of the shadow;
        ``cycle`` is the cycle's number.
    """

    run: int
    number: int
    term: int
    placement: str
    release_ns: int
    latency_ns: int | None
    missed: bool
    known: bool
    outcome: str
    jobs: tuple[Mapping[str, object], ...] = ()


@dataclass(frozen=True, slots=True)
class ObservedWindow:
    """A decision and its cycles, from the controller's status.

    The cycles are one window, or the last W at most if `decide_cycles` is below W.

    Parameters
    ----------
    number : int
        Window of the last cycle.
    at_s : float
        End of the window, in seconds since the first release of the run; its error is the delay of
        the status.
    said : mapping
        ``window`` of `dwell.live.roles.controlled_cell.ControlledCell.status`.
    """

    number: int
    at_s: float
    said: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class CellEvent:
    """A move, refusal, pin, drain or change of health of a cell.

    Parameters
    ----------
    text : str
        The event and its reason; it may contain text from the cell.
    """

    at_s: float
    kind: EventKind
    text: str


@dataclass(frozen=True, slots=True)
class ObservedCell:
    """State of a cell at an instant, from the messages received.

    Parameters
    ----------
    at_s : float
        Time since the first release of the run; 0 before the first stamp.
    status : mapping
        Last answer of the controller (`ControlledCell.status`); ``health`` is ``absent`` if the
        controller does not answer.
    answer_age_s : float or None
        Age of the last answer; None before the first.
    placement : str
        Placement in the newest stamp; without stamps, in the status; else empty.
    cycles : mapping of str to int
        Cycles since the start of the observer, by outcome.
    missed : int
        Cycles among them that missed the deadline.
    """

    at_s: float
    status: Mapping[str, Any]
    answer_age_s: float | None
    placement: str
    cycles: Mapping[str, int]
    missed: int


class _SeenMove(NamedTuple):
    """A change of placement between two stamps."""

    at_s: float
    run: int
    term: int
    old: str
    new: str


class Observer:
    """Observer of one live cell; a context manager.

    `now` returns the current state; the feeds contain the recent cycles, windows and events. Each
    reader of a feed has its own pace; the feed counts the items that a slow reader misses.

    Parameters
    ----------
    environment : mapping of str to str, optional
        Variables of `dwell.live.host.security`; default: the environment of this process.

    Attributes
    ----------
    cycles : Feed of ObservedCycle
    windows : Feed of ObservedWindow
    events : Feed of CellEvent
    security : Security
        With the keyring in use, if any.

    Raises
    ------
    LiveError
        If the cell uses other computers and this process has no keys.
    TrustError
        If the keys do not belong to a visitor (operator or observer).
    """

    def __init__(self, problem: Problem, environment: Mapping[str, str] | None = None) -> None:
        self.problem = problem
        self.cycles: Feed[ObservedCycle] = Feed(MOST_CYCLES)
        self.windows: Feed[ObservedWindow] = Feed(MOST_WINDOWS)
        self.events: Feed[CellEvent] = Feed(MOST_EVENTS)
        self._client = OperatorClient(problem, environment)
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self.security = self._client.security
        who = f"{self._client.name}-hears"
        # The observer's clock does not belong to the cell: the place has no node.
        self._place = self.security.place(who, "", self._visit(who), lambda _: None)
        self._pulse = Pulse(self._place, lambda: (True, ""), hears=[("*", "*")])
        self._renew: Callable[[], None] = lambda: None
        if (keyring := self.security.keyring) is not None:
            from dwell.live.host.key_renewal import KeyRenewal

            self._renew = KeyRenewal(keyring.folder, self, self._pulse, self._connected).step
        self._offsets = self._place.offsets()
        self._ledger = Ledger(problem, self._offsets)
        self._ages = DataAges(problem, self._ledger)
        self._deadline_ns = problem.pipeline.deadline_ns
        # First release of the run, on the stamper's clock.
        self._origin_ns = 0
        # Cycles without an outcome, by run and number, in the order of their stamps.
        self._open: dict[tuple[int, int], LiveCycle] = {}
        self._newest: tuple[LiveCycle, int] | None = None
        self._told_ns = 0
        self._outcomes: Counter[str] = Counter()
        self._missed = 0
        self._status: Mapping[str, Any] = {"health": ""}
        self._answered_s: float | None = None
        # Moves whose reason is still unknown: the status does not include them yet.
        self._moves: deque[_SeenMove] = deque(maxlen=MOST_EVENTS)

    def __enter__(self) -> Observer:
        """Request the status once, then subscribe and start the thread of requests."""
        self._look()
        self.hear_through(self._place.transport)
        # Twice per decision, within `LEAST_ASK_S` and `MOST_ASK_S`.
        apart_ms = self.problem.decide_cycles * self.problem.pipeline.period_ms
        every_s = min(max(apart_ms / 2e3, LEAST_ASK_S), MOST_ASK_S)
        self._asks = start_repeating("asks", every_s, self._stopped, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the requests and close the connections."""
        self._stopped.set()
        self._asks.join()
        self._place.transport.close()
        self._client.__exit__()

    def hear_through(self, transport: Transport) -> None:
        """Subscribe to the stamps and to the gathered messages on a transport."""
        keys = self._place.keys
        for key in (keys.of(channels.STAMPED), keys.of(channels.GATHERED)):
            transport.subscribe(key, self._heard)

    def _visit(self, who: str) -> Transport:
        relay, stamper = self.problem.relay_node, self.problem.stamper_node
        return self.security.visit(who, f"stamper@{stamper}", f"agent@{relay}")

    def _connected(self, keyring: Keyring) -> Transport:
        """Connect again with newer keys, also to the controller."""
        self.security = replace(self.security, keyring=keyring)
        self._client.__exit__()
        self._client = OperatorClient(self.problem, security=self.security)
        return self._visit(self._place.who)

    def act(self, what: str, about: str = "") -> Mapping[str, Any]:
        """Send a command to the controller: pin, unpin, drain or undrain; return its status.

        Raises
        ------
        LiveError
            If the controller refuses the command or does not answer.
        TrustError
            If the keys allow only reading.
        """
        # The thread of requests uses the other client.
        with OperatorClient(self.problem, security=self.security) as client:
            status = client.ask(what, about)
        self._answer(status)
        return status

    def now(self) -> ObservedCell:
        """Return the current state of the cell."""
        with self._lock:
            age_s = None if self._answered_s is None else time.monotonic() - self._answered_s
            newest = self._newest
            placement = str(self._status.get("placement") or "")
            return ObservedCell(
                at_s=self._now_s(),
                status=self._status,
                answer_age_s=age_s,
                placement=placement if newest is None else newest[0].placement,
                cycles=dict(self._outcomes),
                missed=self._missed,
            )

    def _now_s(self) -> float:
        """Return the seconds since the first release: newest release + age of its stamp."""
        if self._newest is None:
            return 0.0
        cycle, heard_ns = self._newest
        return (cycle.at_ns + max(time.monotonic_ns() - heard_ns, 0)) / 1e9

    # ------------------------------------------------------------------------ messages

    def _heard(self, sample: Arrival) -> None:
        with self._lock:
            try:
                self._take(sample)
            except LiveError as error:
                self._place.complain(error)
            self._settle()

    def _take(self, sample: Arrival) -> None:
        place = self._place
        match place.channel(sample):
            case channels.GATHERED:
                self._told_ns = time.monotonic_ns()
                for arrival in place.around(sample):
                    self._take(arrival)
            case channels.STAMPED:
                self._stamped(place.read(channels.STAMPED, sample))
            case channels.BEAT | channels.BEATS:
                for beat, _, _ in self._pulse.receive(sample, time.time_ns()):
                    for heard in beat.heard:
                        self._offsets.sample(heard.node, beat.node, heard.beat_ns, heard.at_ns)
            case channels.DONE | channels.ENDED:
                done = place.completion(sample)
                cycle = self._open.get(done.stamp.key)
                if cycle is not None and self._ledger.tells(done):
                    cycle.take(done, None)
            case channels.ACCEPTED:
                place.read(channels.ACCEPTED, sample)

    def _stamped(self, stamp: Stamped) -> None:
        before = None if self._newest is None else self._newest[0]
        if stamp.placement not in self.problem.candidates:
            raise LiveError(f"the stamper says {printable(stamp.placement)[:60]!r} holds")
        for number, interval_ns, _ in stamp.intervals:
            timed = self._open.get((stamp.run, number))
            if timed is not None:
                timed.stamper_interval_ns = interval_ns
        if before is not None and stamp.key <= before.key:
            return
        if before is None or stamp.run != before.run:
            self._origin_ns = self._begin_ns(stamp, before)
        cycle = self._ledger.cycle_of(stamp, self._origin_ns)
        cycle.group_ns = stamp.group_ns
        self._open[cycle.key] = cycle
        self._newest = cycle, time.monotonic_ns()
        if before is not None and cycle.placement != before.placement:
            where = cycle.run, cycle.term, before.placement, cycle.placement
            self._moves.append(_SeenMove(cycle.at_ns / 1e9, *where))

    def _begin_ns(self, stamp: Stamped, before: LiveCycle | None) -> int:
        """Return the origin of a run's instants; a later run continues the time of the first."""
        if before is not None:
            return stamp.released_ns - before.at_ns - self._place.period_ns
        origin_ns = self._status.get("origin_ns")
        if self._status.get("run") == stamp.run and isinstance(origin_ns, int):
            return origin_ns
        return stamp.released_ns

    def _settle(self) -> None:
        """Close the cycles that are over or too late."""
        if self._newest is None:
            return
        late_ns = self._deadline_ns + round(LATE_S * 1e9)
        for key, cycle in list(self._open.items()):
            over = self._ledger.is_over(cycle)
            if not over and self._newest[0].at_ns - cycle.at_ns <= late_ns:
                continue
            del self._open[key]
            self._ledger.settle(cycle)
            self._close(cycle)

    def _close(self, cycle: LiveCycle) -> None:
        # The outcome is unknown if the relay has sent nothing for LATE_S.
        quiet_ns = time.monotonic_ns() - self._told_ns
        cycle.deaf = quiet_ns > round(LATE_S * 1e9)
        self._ages.judge([cycle], NEVER_NS, self._ages.known)
        self._ages.closed([cycle])
        outcome, completed = _outcome(cycle), cycle.latency_ns < NEVER_NS
        # The time of completion is unknown until the clocks are compared.
        known = not cycle.untold and (completed or outcome not in ("actuated", "behind"))
        missed = known and cycle.missed(self._deadline_ns)
        jobs = tuple({**row, "cycle": cycle.number} for row in self._ledger.jobs(cycle))
        self.cycles.append(
            ObservedCycle(
                run=cycle.run,
                number=cycle.number,
                term=cycle.term,
                placement=cycle.placement,
                release_ns=cycle.at_ns,
                latency_ns=cycle.latency_ns if completed else None,
                missed=missed,
                known=known,
                outcome=outcome,
                jobs=jobs,
            )
        )
        self._outcomes[outcome] += 1
        self._missed += missed

    # ------------------------------------------------------------------------ status

    def _ask(self) -> None:
        """Use newer keys, if any, and request the status."""
        self._renew()
        self._look()

    def _look(self) -> None:
        status = self._client.look(patience_s=MOST_ASK_S)
        if status["health"] == "absent":
            status["headline"] = f"{status['headline']} {running_elsewhere(self.problem)}".rstrip()
        self._answer(status)

    def _answer(self, status: Mapping[str, Any]) -> None:
        """Store a status; add its window and the events since the last status to the feeds."""
        with self._lock:
            before, self._status = self._status, status
            if status["health"] != "absent":
                self._answered_s = time.monotonic()
            at_s = self._now_s()
            window = status.get("window") or {}
            last = self.windows.last
            if window and (last is None or window["last_cycle"] != last.said["last_cycle"]):
                close_s = max(at_s - window["age_ms"] / 1e3, 0.0)
                self.windows.append(ObservedWindow(window["number"], close_s, window))
            for event in self._events(before, status, at_s):
                self.events.append(event)

    def _events(
        self, before: Mapping[str, Any], status: Mapping[str, Any], at_s: float
    ) -> Iterator[CellEvent]:
        """Yield the events between two answers of the controller."""
        if before["health"] not in ("", status["health"]):
            why = status.get("headline")
            yield CellEvent(at_s, "health", f"{status['health']}{f': {why}' if why else ''}")
        if "mode" not in status:
            return
        guarded = status["guard_moves"] > before.get("guard_moves", status["guard_moves"])
        course = status["run"] or 0, status["term"] or 0
        while self._moves and (self._moves[0].run, self._moves[0].term) <= course:
            move = self._moves.popleft()
            kind: EventKind = "guard" if guarded else "move"
            why = _why((status, before), move.new, guarded=guarded)
            yield CellEvent(move.at_s, kind, f"{move.old} → {move.new}: {why}")
        if "mode" not in before:
            return
        if status["refused"] and status["refused"] != before["refused"]:
            yield CellEvent(at_s, "refused", str(status["refused"]))
        if status["pinned"] != before["pinned"]:
            pinned = status["pinned"]
            yield CellEvent(at_s, "pin", f"pinned to {pinned}" if pinned else "unpinned")
        for node in sorted({*status["drained"]} ^ {*before["drained"]}):
            word = "drained" if node in status["drained"] else "no longer drained"
            yield CellEvent(at_s, "drain", f"{node} {word}")


def _why(answers: Sequence[Mapping[str, Any]], new: str, *, guarded: bool) -> str:
    """Return the reason of a move, from the controller's answers, newest first."""
    if guarded:
        return "guard"
    if any(status.get("pinned") == new for status in answers):
        return "pinned"
    for status in answers:
        if status.get("drained"):
            return f"{', '.join(status['drained'])} drained"
    return shown_reason(str((answers[0].get("window") or {}).get("reason") or "ordered"))


def _outcome(cycle: LiveCycle) -> str:
    """Return the outcome of a cycle, one of `OUTCOMES`."""
    if cycle.idle:
        return "idle"
    words: Sequence[str] = [done.outcome for done in cycle.reports.values()]
    # The worst outcome that a sink reports.
    for word in ("not_applied", "stale", "behind"):
        if word in words:
            return word
    if words or cycle.told:
        return "actuated"
    return "untold" if cycle.untold else "replaced" if cycle.replaced else "lost"
