"""Invariants: violations of a cell's promises, found in its messages on the wire.

The checks decode the messages and compare them with the cell file. They do not call the cell's own
decisions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from dwell.errors import LiveError
from dwell.estimators.registry import resolved
from dwell.live.wire import channels
from dwell.live.wire.channels import CHANNELS
from dwell.live.wire.keys import MAIN, Keys
from dwell.live.wire.messages import (
    HANDED_OVER,
    MAX_HEADER_BYTES,
    Accepted,
    Completion,
    Header,
    Order,
    Stamp,
    Stamped,
    decode,
)
from dwell.model import Problem
from dwell.model.placement import nodes_of
from dwell.policies.registry import estimator_of
from dwell_lab.chaos.actuations import Seen
from dwell_lab.chaos.stages import APPLY, HOLD, ZERO

#: Channels of the messages that `Judge` reads.
JUDGED = channels.STAMPED, channels.ORDER, channels.ACCEPTED, channels.DONE, channels.INPUT
#: Smallest share of the commands that must reach the actuator while the status is `ok`.
LEAST_APPLIED = 0.9
#: Largest number of stamps, and of orders, in memory.
MEMORY = 10_000

K = TypeVar("K")
V = TypeVar("V")


@dataclass(slots=True)
class Term:
    """A term, with the placement and the cycle of its first stamp.

    Parameters
    ----------
    cycle : int
        First cycle received with a stamp of this term.
    """

    term: int
    placement: str
    cycle: int
    at_ns: int


@dataclass(slots=True)
class Judge:
    """Reads all messages in the order of their arrival, and finds violations.

    Parameters
    ----------
    renews : bool
        Whether a fault may have destroyed the stamper's saved state: then a new run may begin.
    held : dict of int to bool
        Whether the controller, and not the guard, chose the placement of a term; from the
        stamper's answers.
    """

    problem: Problem
    renews: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    terms: dict[int, Term] = field(default_factory=dict)
    stamped_ns: dict[int, int] = field(default_factory=dict)
    _stamps: list[tuple[int, int, int]] = field(default_factory=list)
    _last: tuple[int, int, int] = (-1, -1, -1)
    _orders: dict[tuple[str, int], Order] = field(default_factory=dict)
    _early: dict[tuple[str, int], Accepted] = field(default_factory=dict)
    held: dict[int, bool] = field(default_factory=dict)
    # Terms that began with an accepted order.
    _moved: set[int] = field(default_factory=set)
    _looked: int = -1

    def __post_init__(self) -> None:
        self.problem = resolved(self.problem, estimator_of(self.problem))

    def hear(self, at_ns: int, key: str, payload: bytes, header: bytes) -> Iterable[str]:
        """Process a message; return its violations."""
        word = Keys(self.problem.name).word(key)
        self.counts[word] += 1
        try:
            match CHANNELS.get(word):
                case channels.STAMPED:
                    return list(self._stamped(at_ns, decode(payload, Stamped)))
                case channels.ORDER:
                    return self._ordered(decode(payload, Order))
                case channels.ACCEPTED:
                    return self._accepted(decode(payload, Accepted))
                case channels.INPUT:
                    decoded = decode(header, Header, limit=MAX_HEADER_BYTES)
                    return list(self._routed(key, decoded))
                case channels.DONE:
                    return list(self._done(decode(payload, Completion)))
        except LiveError as error:
            return [f"{key}: {error}"]
        return ()

    # ------------------------------------------------------------------------- stamps

    @property
    def run(self) -> int:
        """Run of the last stamp; -1 before the first."""
        return self._last[0]

    def _begin_run(self) -> None:
        """Clear the state of the previous run; its cycle numbers and terms may occur again."""
        self.terms.clear()
        self.held.clear()
        self.stamped_ns.clear()
        self._stamps.clear()
        self._moved.clear()
        self._looked, self._last = -1, (-1, -1, -1)

    def _stamped(self, at_ns: int, stamp: Stamp) -> Iterable[str]:
        if self.renews and -1 < self.run < stamp.run:
            self._begin_run()
        run, cycle, term = self._last
        if run not in (-1, stamp.run):
            yield f"cycle {stamp.cycle} is of run {stamp.run}, after {run}"
        elif stamp.cycle <= cycle:
            yield f"cycle {stamp.cycle} is stamped after {cycle}"
        elif stamp.term < term:
            yield f"cycle {stamp.cycle} has term {stamp.term}, after term {term}"
        if stamp.placement not in self.problem.candidates:
            yield f"cycle {stamp.cycle} is stamped {stamp.placement!r}, no candidate"
        self._last = stamp.run, stamp.cycle, stamp.term
        self._stamps.append(self._last)
        del self._stamps[:-MEMORY]
        _remember(self.stamped_ns, stamp.cycle, at_ns)
        known = self.terms.get(stamp.term)
        if known is None:
            self.terms[stamp.term] = Term(stamp.term, stamp.placement, stamp.cycle, at_ns)
        elif known.placement != stamp.placement:
            yield f"term {stamp.term} has two placements: {known.placement}, {stamp.placement}"

    # ------------------------------------------------------------------------- orders

    def _ordered(self, order: Order) -> list[str]:
        who = order.controller, order.number
        _remember(self._orders, who, order)
        # Orders and answers use different connections: an answer may arrive before its order.
        answer = self._early.pop(who, None)
        return [] if answer is None else list(self._weigh(order, answer))

    def _accepted(self, answer: Accepted) -> list[str]:
        self.held[answer.term] = not answer.fallback
        if answer.refused:
            return []
        who = answer.controller, answer.number
        if who not in self._orders:
            _remember(self._early, who, answer)
            return []
        return list(self._weigh(self._orders[who], answer))

    def _weigh(self, order: Order, answer: Accepted) -> Iterable[str]:
        """Compare an answer with its order, and with the stamps before it."""
        if (order.run, order.term) == (0, 0):
            return
        what = f"order {order.number} of term {order.term}"
        if order.run != answer.run:
            yield f"{what} and run {order.run} is accepted in run {answer.run}"
        if answer.term not in (order.term, order.term + 1):
            yield f"{what} is accepted in term {answer.term}"
        later = [one for one in self._stamps if one[1] < answer.cycle and one[2] > order.term]
        if later:
            yield f"{what} is accepted after cycle {later[0][1]} of term {later[0][2]}"
        if order.placement not in ("", answer.placement):
            yield f"{what} asks for {order.placement} and gets {answer.placement}"
        if order.placement and order.placement not in self.problem.candidates:
            yield f"{what} to {order.placement!r}, no candidate, is accepted"
        if answer.term == order.term + 1:
            self._moved.add(answer.term)

    def migrations(self) -> list[str]:
        """Return the controller's migrations since the last call that were too early.

        Two migrations must be at least `Problem.stay_cycles` cycles apart: K windows of W cycles
        contain at most K·W / `stay_cycles`. The guard's moves do not count.
        """
        apart = self.problem.stay_cycles
        violations = []
        before: Term | None = None
        previous: Term | None = None
        for term in sorted(self.terms):
            one = self.terms[term]
            elsewhere = previous is not None and one.placement != previous.placement
            if elsewhere and term in self._moved:
                if before is not None and term > self._looked and one.cycle - before.cycle < apart:
                    violations.append(
                        f"migrations at cycles {before.cycle} (to {before.placement}) and "
                        f"{one.cycle} (to {one.placement}): fewer than {apart} cycles apart"
                    )
                before = one
            previous = one
        self._looked = max(self.terms, default=-1)
        return violations

    def moved_by_guard(self, after: int) -> bool:
        """Whether the guard began a term later than `after`."""
        return any(term > after and self.held.get(term) is False for term in self.terms)

    def ordered_since(self, at_ns: int) -> int | None:
        """Return the instant of the first stamp since `at_ns` whose placement was ordered.

        The first placement of a run counts as ordered. None before the first such stamp.
        """
        instants = [
            self.stamped_ns[cycle]
            for _, cycle, term in self._stamps
            if self.stamped_ns.get(cycle, -1) >= at_ns and self.held.get(term, term <= 1)
        ]
        return min(instants, default=None)

    # ------------------------------------------------------------------------ routing

    def looked(self, status: Mapping[str, Any], seen: Sequence[Seen]) -> list[str]:
        """Compare a status `ok` with the actuator's calls up to that instant.

        At most one of the status's recent windows may have a call of ``hold`` or ``zero``, or lack
        more than 1 - `LEAST_APPLIED` of its commands.
        """
        if status.get("health") != "ok" or "recent" not in status:
            return []
        windows = status["recent"]["cycles"]
        bad = [why for first, last in windows if (why := self._unserved(first, last, seen))]
        return [f"status reads ok: {'; '.join(bad)}"] if len(bad) > 1 else []

    def _unserved(self, first: int, last: int, seen: Sequence[Seen]) -> str:
        """Return which commands the actuator lacked in some cycles; an empty text if none."""
        released_ns = [at_ns for cycle, at_ns in self.stamped_ns.items() if first <= cycle <= last]
        if not released_ns:  # cycles of an earlier run
            return ""
        passed_ns = max(released_ns) - min(released_ns)
        due = max(passed_ns // self.problem.pipeline.period_ns + 1, len(released_ns))
        applied = silences = 0
        follows = False
        for one in reversed(seen):
            if one.what == APPLY:
                if one.cycle < first:
                    break
                follows = one.cycle <= last
                applied += follows
            elif one.what in (HOLD, ZERO):
                silences, follows = silences + follows, False
        lacks = applied < LEAST_APPLIED * due
        what = f"{applied} of {due} commands, {silences} silences in cycles {first} to {last}"
        return what if silences or lacks else ""

    # ------------------------------------------------------------------------- routing

    def _routed(self, key: str, header: Header) -> Iterable[str]:
        task, node, kind = key.split("/")[-3:]
        stamp = header.stamp
        where = f"cycle {stamp.cycle} ({stamp.placement}, term {stamp.term}): {task} on {node}"
        if not self._feasible(task, node):
            yield f"{where}: infeasible"
            return
        if not stamp.term:
            return
        shadow = kind != MAIN
        name = stamp.shadow if shadow else stamp.placement
        candidate = self.problem.candidates.get(name)
        if candidate is None:
            yield f"{where}: {name!r} is no candidate"
        elif node not in nodes_of(candidate[task]) and (shadow or (task, node) not in stamp.forks):
            yield f"{where}: {name} has it on {' and '.join(nodes_of(candidate[task]))}"

    def _feasible(self, task: str, node: str) -> bool:
        tasks: Mapping[str, object] = self.problem.pipeline.tasks
        return task in tasks and node in self.problem.pipeline.tasks[task].on

    def _done(self, done: Completion) -> Iterable[str]:
        """Compare the nodes on which the jobs of a cycle ran with its stamp."""
        if done.outcome not in (*HANDED_OVER, "behind", "stale"):
            return
        stamp = done.stamp
        candidate = self.problem.candidates.get(stamp.placement)
        for hop in done.hops:
            where = f"cycle {stamp.cycle}: {hop.task} ran on {hop.node}"
            if not self._feasible(hop.task, hop.node):
                yield f"{where}: infeasible"
                continue
            placed = () if candidate is None else nodes_of(candidate[hop.task])
            if stamp.term and placed and hop.node not in placed:
                yield f"{where}, not where {stamp.placement} has it"


def _remember(known: dict[K, V], key: K, value: V) -> None:
    known[key] = value
    if len(known) > MEMORY:
        del known[next(iter(known))]
