"""Observer: hears a live cell from outside, and changes nothing in it.

It subscribes to channels that the protocol has anyway, and to no more of them than one controller
does: the stamps of the stamper, and what the relay's agent gathers for the controller (beats,
completions, answers, loads). Beside that it asks the controller for its status, as
`dwell live status` does. With keys it takes those of an operator or an observer, and believes what
is signed alone.

Instants are put on the stamper's clock, as the controller does it (`dwell.live.roles.offsets`,
`dwell.live.roles.cycle_ledger`), and count from the first release of the run.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from dwell.dash.feed import Feed
from dwell.errors import LiveError
from dwell.live.failures import start_thread
from dwell.live.host.operator_client import OperatorClient
from dwell.live.host.security import Security
from dwell.live.log import printable
from dwell.live.roles.cycle_ledger import Ledger, LiveCycle
from dwell.live.roles.role import Pulse
from dwell.live.wire.local_addresses import running_elsewhere
from dwell.live.wire.messages import Accepted, Stamped, decode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role
from dwell.model import Problem
from dwell.model.instants import NEVER_NS

#: Cycles with their jobs (2 to 3 kB each), windows and events that are kept.
MOST_CYCLES, MOST_WINDOWS, MOST_EVENTS = 4_000, 4_000, 1_000
#: Time between two questions to the controller, at least and at most.
LEAST_ASK_S, MOST_ASK_S = 0.1, 0.5
#: A cycle that nobody has told the end of is given up so long after its deadline.
LATE_S = 1.0

#: What may become of a cycle, as far as it can be heard.
OUTCOMES = ("actuated", "not_applied", "behind", "stale", "replaced", "lost", "untold")

EventKind: TypeAlias = Literal["move", "guard", "refused", "pin", "drain", "health"]


@dataclass(frozen=True, slots=True)
class ObservedCycle:
    """A cycle whose end is known, or given up.

    Parameters
    ----------
    number : int
        As stamped.
    release_ns : int
        Since the first release of the run.
    latency_ns : int or None
        None where no sink has completed it, or it is not known when.
    known : bool
        False where it could not be heard what became of it, or when; it is then not missed.
    outcome : str
        One of `OUTCOMES`.
    jobs : tuple of mapping
        Rows of the table ``jobs`` (`dwell.model.table_columns`), its shadow's included; ``cycle``
        is its number.
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
    """A decision and its cycles, by the controller's status.

    The cycles are a window, or the last W at most if `decide_cycles` is below W.

    Parameters
    ----------
    number : int
        Window of the last of its cycles.
    at_s : float
        Its close, in seconds since the first release of the run; as exact as the status is young.
    said : mapping
        ``window`` of `dwell.live.roles.controlled_cell.ControlledCell.status`.
    """

    number: int
    at_s: float
    said: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class CellEvent:
    """Something that happened to a cell.

    Parameters
    ----------
    text : str
        What happened, and why; it may hold words of the cell's.
    """

    at_s: float
    kind: EventKind
    text: str


@dataclass(frozen=True, slots=True)
class ObservedCell:
    """A cell at an instant, as far as it is heard.

    Parameters
    ----------
    at_s : float
        Time since the first release of the run; 0 before a cycle was heard of.
    status : mapping
        Last answer of the controller (`ControlledCell.status`); with ``health`` ``absent`` where
        nobody answers.
    answer_age_s : float or None
        Age of that answer; None where there was none.
    placement : str
        Of the newest stamp, else of the status; empty where neither says.
    cycles : mapping of str to int
        Cycles since the observer began, by outcome.
    missed : int
        Those of them that missed.
    """

    at_s: float
    status: Mapping[str, Any]
    answer_age_s: float | None
    placement: str
    cycles: Mapping[str, int]
    missed: int


class _SeenMove(NamedTuple):
    """A change of placement, by the stamps."""

    at_s: float
    run: int
    term: int
    old: str
    new: str


class Observer:
    """Hears one cell; a context manager.

    Whoever wants more than the present reads the feeds, each at a pace of its own: what a slow
    reader misses is counted for it, and holds nobody up.

    Parameters
    ----------
    environment : mapping of str to str, optional
        With the variables of `dwell.live.host.security`; this process's own if left out.

    Attributes
    ----------
    cycles : Feed of ObservedCycle
    windows : Feed of ObservedWindow
    events : Feed of CellEvent
    security : Security
        With the keyring, if any.

    Raises
    ------
    LiveError
        If the cell leaves this computer, and there are no keys.
    TrustError
        If the keys are not those of somebody who visits.
    """

    def __init__(self, problem: Problem, environment: Mapping[str, str] | None = None) -> None:
        self.problem, self._environment = problem, environment
        self.cycles: Feed[ObservedCycle] = Feed(MOST_CYCLES)
        self.windows: Feed[ObservedWindow] = Feed(MOST_WINDOWS)
        self.events: Feed[CellEvent] = Feed(MOST_EVENTS)
        self._client = OperatorClient(problem, environment)
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        relay, stamper = problem.relay_node, f"stamper@{problem.stamper_node}"
        who = f"{self._client.name}-hears"
        role = Role(who, problem.controller_node, "visitor")
        self.security = Security.of(problem, role, environment)
        transport = self.security.visit(who, stamper, f"agent@{relay}")
        # Its own clock is none of the cell's.
        self._place = self.security.place(who, "", transport, lambda _: None)
        self._transport = transport
        self._pulse = Pulse(self._place, lambda: (True, ""), hears=[("*", "*")])
        self._offsets = self._place.offsets()
        self._ledger = Ledger(problem, self._offsets)
        self._deadline_ns = problem.pipeline.deadline_ns
        # First release of the run, on the stamper's clock.
        self._origin_ns = 0
        # Cycles that are not settled, by run and number, in the order of their stamps.
        self._open: dict[tuple[int, int], LiveCycle] = {}
        self._newest: tuple[LiveCycle, int] | None = None
        self._told_ns = 0
        self._outcomes: Counter[str] = Counter()
        self._missed = 0
        self._status: Mapping[str, Any] = {"health": ""}
        self._answered_s: float | None = None
        # Moves that no answer has told the reason of yet.
        self._moves: deque[_SeenMove] = deque(maxlen=MOST_EVENTS)

    def __enter__(self) -> Observer:
        """Begin to listen."""
        self._look()
        keys = self._place.keys
        for key in (keys.stamped(), keys.gathered()):
            self._transport.subscribe(key, self._heard)
        start_thread("asks", self._ask_on)
        return self

    def __exit__(self, *_: object) -> None:
        """Listen no more."""
        self._stopped.set()
        self._transport.close()
        self._client.__exit__()

    def act(self, what: str, about: str = "") -> Mapping[str, Any]:
        """Have the controller pin, unpin, drain or undrain; returns its status.

        Raises
        ------
        LiveError
            If it is refused, or nobody answers.
        TrustError
            If the keys are those of somebody who may only look.
        """
        # A client of its own: the other one is asking.
        with OperatorClient(self.problem, self._environment) as client:
            status = client.ask(what, about)
        self._answer(status)
        return status

    def now(self) -> ObservedCell:
        """Return how the cell is."""
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
        """Return the time since the first release: by the newest stamp, and its age here."""
        if self._newest is None:
            return 0.0
        cycle, heard_ns = self._newest
        return (cycle.at_ns + max(time.monotonic_ns() - heard_ns, 0)) / 1e9

    # ------------------------------------------------------------------------ hearing

    def _heard(self, sample: Arrival) -> None:
        with self._lock:
            try:
                self._take(sample)
            except LiveError as error:
                self._place.complain(error)
            self._settle()

    def _take(self, sample: Arrival) -> None:
        place = self._place
        match place.keys.word(sample.key):
            case "gathered":
                self._told_ns = time.monotonic_ns()
                for arrival in place.around(sample):
                    self._take(arrival)
            case "stamped":
                self._stamped(decode(sample.payload, Stamped))
            case "beat":
                beat = self._pulse.receive(sample, time.time_ns())
                if beat is not None:
                    for heard in beat.heard:
                        self._offsets.sample(heard.node, beat.node, heard.beat_ns, heard.at_ns)
            case "done" | "ended":
                done = place.completion(sample)
                cycle = self._open.get(done.stamp.key)
                if cycle is not None and self._ledger.tells(done):
                    cycle.take(done, None)
            case "accepted":
                place.read(sample, Accepted, lambda _: place.stamper[0])

    def _stamped(self, stamp: Stamped) -> None:
        before = None if self._newest is None else self._newest[0]
        if stamp.placement not in self.problem.candidates:
            raise LiveError(f"the stamper says {printable(stamp.placement)[:60]!r} holds")
        for number, interval_ns in stamp.intervals:
            timed = self._open.get((stamp.run, number))
            if timed is not None:
                timed.stamper_interval_ns = interval_ns
        if before is not None and stamp.key <= before.key:
            return
        if before is None or stamp.run != before.run:
            self._origin_ns = self._begin_ns(stamp, before)
        cycle = LiveCycle.of(stamp, self._origin_ns)
        cycle.group_ns = stamp.group_ns
        self._open[cycle.key] = cycle
        self._newest = cycle, time.monotonic_ns()
        if before is not None and cycle.placement != before.placement:
            where = cycle.run, cycle.term, before.placement, cycle.placement
            self._moves.append(_SeenMove(cycle.at_ns / 1e9, *where))

    def _begin_ns(self, stamp: Stamped, before: LiveCycle | None) -> int:
        """Return the first release of a run; that of a later run goes on with the time."""
        if before is not None:
            return stamp.released_ns - before.at_ns - self._place.period_ns
        origin_ns = self._status.get("origin_ns")
        if self._status.get("run") == stamp.run and isinstance(origin_ns, int):
            return origin_ns
        return stamp.released_ns

    def _settle(self) -> None:
        """Let go of the cycles that have ended, and of those that nobody will tell the end of."""
        if self._newest is None:
            return
        late_ns = self._deadline_ns + round(LATE_S * 1e9)
        for key, cycle in list(self._open.items()):
            complete = self._ledger.complete(cycle)
            if not complete and self._newest[0].at_ns - cycle.at_ns <= late_ns:
                continue
            del self._open[key]
            self._ledger.settle(cycle)
            self._close(cycle)

    def _close(self, cycle: LiveCycle) -> None:
        # Nothing came from the relay since: who knows.
        quiet_ns = time.monotonic_ns() - self._told_ns
        cycle.deaf = quiet_ns > round(LATE_S * 1e9)
        outcome, completed = _outcome(cycle), cycle.latency_ns < NEVER_NS
        # Before the clocks are compared, nobody knows when it was completed.
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

    # ------------------------------------------------------------------------ asking

    def _ask_on(self) -> None:
        """Ask the controller again and again, so often that few decisions are left out."""
        apart_ms = self.problem.decide_cycles * self.problem.pipeline.period_ms
        every_s = min(max(apart_ms / 2e3, LEAST_ASK_S), MOST_ASK_S)
        while not self._stopped.wait(every_s):
            self._look()

    def _look(self) -> None:
        status = self._client.look(patience_s=MOST_ASK_S)
        if status["health"] == "absent":
            status["headline"] = f"{status['headline']} {running_elsewhere(self.problem)}".rstrip()
        self._answer(status)

    def _answer(self, status: Mapping[str, Any]) -> None:
        """Take in how the cell is, and what has happened since the answer before."""
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
        """Yield what has happened between two answers."""
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
    """Return why a cell was moved, by the answers of the controller about it, the newest first."""
    if guarded:
        return "guard"
    if any(status.get("pinned") == new for status in answers):
        return "pinned"
    for status in answers:
        if status.get("drained"):
            return f"{', '.join(status['drained'])} drained"
    return str((answers[0].get("window") or {}).get("reason") or "ordered")


def _outcome(cycle: LiveCycle) -> str:
    """Return what became of a cycle, in a word."""
    words: Sequence[str] = [done.outcome for done in cycle.reports.values()]
    # The worst of what its sinks say.
    for word in ("not_applied", "stale", "behind"):
        if word in words:
            return word
    if words or cycle.told:
        return "actuated"
    return "untold" if cycle.untold else "replaced" if cycle.replaced else "lost"
