"""ControlledCell: closes the windows of a live cell and sends orders to its stamper.

`dwell.control.Controller` makes the decisions, here and in the simulator.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, Protocol, TypeAlias

from dwell.control import Controller, Proposal
from dwell.errors import LiveError
from dwell.live.roles.health import PATIENCE_NS, diagnose, silent_after_ns
from dwell.live.roles.live_windows import LiveWindows
from dwell.live.roles.members_status import members_status
from dwell.live.roles.operator_wishes import OperatorWishes
from dwell.live.roles.role import CONTROLLER_BEAT, REPEATED_NS, Pulse, RolePlace
from dwell.live.roles.run_rows import Resume, Rows
from dwell.live.wire import channels
from dwell.live.wire.continuity import Continuity, SetbackDetector
from dwell.live.wire.messages import (
    OTHER,
    Accepted,
    Answer,
    Ask,
    Order,
    Restored,
    Snapshot,
    Stamp,
    Stamped,
)
from dwell.live.wire.transport import Arrival
from dwell.model import REASONS, Reason
from dwell.model.placement import nodes_of

#: Time between two status requests to the stamper, and between two copies of an unanswered order.
ASK_NS = 250_000_000
RESEND_NS = 40_000_000
#: Number of stamps in a row that confirm a move without an answer to its order.
CONFIRMATIONS = 3

#: Factor on the transfer time of a state, which shares its link.
TRANSFER_SHARE = 2

#: Reasons of moves: the policy's, the guard, an operator's (pinned, drained), an unknown order.
MOVED_BY = tuple(reason for reason in REASONS if reason not in ("dwell", "hold"))

Phase: TypeAlias = Literal["fork", "state", "order"]


class Recorder(Protocol):
    """Keeps the rows of a run."""

    @property
    def trouble(self) -> str:
        """Reason that the rows cannot be written; empty if they can."""
        ...

    def open(self, run: int) -> Resume:
        """Start or continue the record of a run; return its next window and cycle."""
        ...

    def append(self, rows: Rows, **meta: object) -> None:
        """Record rows that belong together, and update the run's metadata."""
        ...


@dataclass(slots=True)
class _Move:
    """A migration under way.

    Tasks with a state move first: their inputs are forked to the new nodes, then the states are
    sent. The placement is ordered when all workers have restored their states.
    """

    name: str
    reason: Reason
    since_ns: int
    phase: Phase
    forks: tuple[tuple[str, str], ...] = ()
    awaited: dict[int, str] = field(default_factory=dict)
    patience_ns: int = PATIENCE_NS
    order: Order | None = None
    sent_ns: int = 0
    refused: str = ""
    # Whether its order was refused for now: the next order needs a new number.
    anew: bool = False
    # The policy's proposal; None for an operator's move.
    proposal: Proposal | None = None


class ControlledCell:
    """See the module.

    `name` distinguishes this controller from others of the cell. `changed` returns the files that
    have changed since the start, or an empty string.
    """

    def __init__(
        self,
        place: RolePlace,
        controller: Controller,
        recorder: Recorder,
        name: str,
        now_ns: int,
        changed: Callable[[], str] = str,
    ) -> None:
        self.place, self.controller, self.name = place, controller, name
        self._recorder, self._changed = recorder, changed
        self.offsets = place.offsets()
        self.windows: LiveWindows | None = None
        # Beats arrive in batches of the relay's agent. They carry their own times of sending and
        # arrival, so a delay on the detour does not harm clock comparisons.
        self.pulse = Pulse(place, lambda: (True, recorder.trouble), hears=(), every=CONTROLLER_BEAT)
        # Run, term and placement from the stamper's answers and stamps; its last answer, or None
        # if only stamps have confirmed the current term.
        self.course = controller.course
        self._told: Accepted | None = None
        # Checks the order of cycles. Numbers of the last orders sent before the newest cycle, and
        # the current term, were known.
        self.continuity = Continuity(place.period_ns)
        self._cycle_asked = self._term_asked = 0
        # Run, term and placement of stamps that no answer has confirmed, whether they match the
        # open order, and the number of such stamps in a row.
        self._unconfirmed: tuple[tuple[int, int, str], bool, int] | None = None
        self._doubted_until_ns: int | None = None
        self.refused = ""
        self.wishes = OperatorWishes(place.problem)
        self._move: _Move | None = None
        self.order_number = now_ns
        self._setback = SetbackDetector()
        self._began_ns: int | None = None
        self._ask_ns = 0
        # Number of moves by reason (see `MOVED_BY`).
        self.moves = Counter(dict.fromkeys(MOVED_BY, 0))
        self._window: dict[str, Any] = {}
        self._window_ns = 0
        # Whether there are rows to record.
        self._unwritten = False

    # ---------------------------------------------------------------------- receiving

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""
        yield from self.pulse.subscriptions()
        yield from self.place.channels_to("controller")

    def receive(self, sample: Arrival, now_ns: int) -> int:
        """Process a message; return the instant of the next call of `wake`."""
        self._follow_clock(now_ns)
        self._take(sample, now_ns)
        return self._due_ns(now_ns)

    def _due_ns(self, now_ns: int) -> int:
        """Return when a decision, a copy of an unanswered order or a status request is due."""
        due_ns = self._ask_ns
        if self._move is not None:
            due_ns = min(due_ns, self._move.sent_ns + RESEND_NS)
        close_ns = None if self.windows is None else self.windows.due_ns(now_ns)
        return due_ns if close_ns is None else min(due_ns, close_ns)

    def _follow_clock(self, now_ns: int) -> None:
        """Shift due times and times of arrival if the clock was set back."""
        back_ns = self._setback.back_ns(now_ns)
        if not back_ns:
            return
        self._ask_ns -= back_ns
        self._window_ns -= back_ns
        if self._began_ns is not None:
            self._began_ns -= back_ns
        if self._move is not None:
            self._move.since_ns -= back_ns
            self._move.sent_ns -= back_ns
        if self.windows is not None:
            self.windows.set_back(back_ns)

    def _take(self, sample: Arrival, now_ns: int) -> None:
        channel = self.place.channel(sample)
        if channel is channels.GATHERED:
            for arrival in self.place.around(sample):
                self._take(arrival, now_ns)
            return
        if self.pulse.hears(sample):
            for beat, _, _ in self.pulse.receive(sample, now_ns):
                for heard in beat.heard:
                    self.offsets.sample(heard.node, beat.node, heard.beat_ns, heard.at_ns)
                if beat.moving and self._move is not None:
                    # A stage is writing or restoring its state.
                    self._move.since_ns = now_ns
            return
        windows = self.windows
        try:
            match channel:
                case channels.STAMPED:
                    self._stamped(self.place.read(channels.STAMPED, sample), now_ns)
                case channels.DONE | channels.ENDED if windows is not None:
                    done = self.place.completion(sample)
                    who = f"{done.sink}@{done.node}"
                    # A source's guess counts if the stamper has released such a cycle.
                    guess = not done.stamp.term
                    if guess or self._goes_on(done.stamp, who, now_ns, alone=True):
                        windows.completed(done, now_ns)
                case channels.LOAD if windows is not None:
                    windows.loaded(self.place.load(sample), now_ns)
                case channels.ACCEPTED:
                    self._answered(self.place.read(channels.ACCEPTED, sample), now_ns)
                case channels.RESTORED:
                    self._restored(self.place.read(channels.RESTORED, sample), now_ns)
                case channels.ASK:
                    self._asked(self.place.read(channels.ASK, sample), now_ns)
                case channels.LOOK:
                    looks = Ask(self.place.read(channels.LOOK, sample).number, "status")
                    self._asked(looks, now_ns)
        except LiveError as error:
            self.place.complain(error)

    def _require_candidate(self, placement: str) -> None:
        """Raise a LiveError if the stamper's placement is not a candidate here."""
        known = self.place.problem.candidates
        if placement not in known:
            raise LiveError(
                f"the stamper says {placement[:60]!r} holds, which is no candidate here "
                f"({', '.join(known)}); the nodes' cell files differ"
            )

    def _goes_on(self, stamp: Stamp, who: str, now_ns: int, *, alone: bool = False) -> bool:
        """Whether a cycle can follow the known cycles; complain about the first that cannot."""
        continuity, cycle = self.continuity, stamp.key
        newest, ahead = continuity.newest, continuity.ahead(now_ns)
        course = self.course
        terms = stamp.term - course.term if course.run == stamp.run else 0
        if terms <= ahead and continuity.takes(cycle, now_ns, alone=alone):
            if continuity.newest == cycle != newest:
                self._cycle_asked = self.order_number
            return True
        if terms > ahead:
            continuity.leaps += 1
        if self._doubted_until_ns is None or now_ns >= self._doubted_until_ns:
            self.place.complain(
                LiveError(
                    f"{who} speaks of run {stamp.run}, cycle {stamp.cycle}, term {stamp.term}, "
                    f"after {newest} and term {course.term}; at most {ahead} more are believed "
                    "(damaged, or made up)"
                )
            )
        self._doubted_until_ns = now_ns + REPEATED_NS
        return False

    def _stamped(self, stamp: Stamped, now_ns: int) -> None:
        self._require_candidate(stamp.placement)
        windows, course = self.windows, self.course
        if windows is None or not self._goes_on(stamp, self.place.stamper[1], now_ns):
            return
        windows.stamped(stamp, now_ns)
        windows.measured(stamp.run, stamp.intervals)
        if (stamp.run, stamp.term) <= (course.run, course.term):
            self._unconfirmed = None
            return
        reported = stamp.run, stamp.term, stamp.placement
        known, ordered, count = self._unconfirmed or (None, False, 0)
        if known != reported:
            # Only an order that was sent before this stamp can have caused the move.
            ordered, count = self._has_ordered(stamp), 0
            # Request an answer, which shows whether the guard or an order moved the cell.
            self._ask_ns = now_ns
        count += 1
        self._unconfirmed = reported, ordered, count
        if count == CONFIRMATIONS:
            self._now_at(*reported, by_guard=not ordered)

    def _has_ordered(self, stamp: Stamp) -> bool:
        """Whether a stamp's term and placement match the order that has no answer yet."""
        move = self._move
        return (
            move is not None
            and move.order is not None
            and (stamp.run, stamp.term) == (self.course.run, move.order.term + 1)
            and stamp.placement == move.name
        )

    def _now_at(self, run: int, term: int, placement: str, *, by_guard: bool) -> None:
        """Enter a new term: end the migration under way, and count and adopt the move."""
        controller, course, move = self.controller, self.course, self._move
        left = course.placement
        self._unconfirmed = self._told = None
        self._term_asked = self.order_number
        self.refused = ""
        reason: Reason = "guard" if by_guard else "ordered"
        if move is not None and move.name == placement and not by_guard:
            self._move, self._unwritten, reason = None, True, move.reason
            if move.proposal is not None:
                controller.commit(move.proposal)
        else:
            self._stay(f"the placement became {placement} meanwhile")
            if by_guard and move is not None:
                # The placement may be the migration's target, but the states were not sent.
                self.refused = (
                    f"the guard moved the cell to {placement} before the move to {move.name}"
                )
        self.moves[reason] += 1
        if by_guard:
            if self.windows is not None:
                controller.looked = self.windows.fell(run, term)
            controller.adopt(placement, left=left)
        else:
            if placement != course.placement:
                # An operator's choice, not the policy's.
                if self.windows is not None:
                    controller.looked = self.windows.before(run, term)
                controller.resume(placement, moved_by=reason)
            course.credit(by_guard=False)
        course.enter(run, term)

    def _begin_run(self, answer: Accepted) -> None:
        """Start with the run and placement of the stamper's first answer."""
        self._term_asked = self.order_number
        resume = self._recorder.open(answer.run)
        self._follow(answer)
        self.windows = LiveWindows(self.place.problem, self.offsets, self.controller, resume=resume)

    def _follow(self, answer: Accepted) -> None:
        """Adopt run, term and placement of the stamper's answer."""
        self.controller.resume(answer.placement, fallback=answer.fallback)
        self.course.enter(answer.run, answer.term)
        self._told = answer

    @property
    def _proven(self) -> str:
        """Candidate that the stamper has proven; empty if none."""
        return "" if self._told is None else self._told.proven

    # ------------------------------------------------------------------------- orders

    def _answered(self, answer: Accepted, now_ns: int) -> None:
        if answer.controller != self.name:
            return
        self._require_candidate(answer.placement)
        if answer.number > self.order_number:
            raise LiveError(f"an answer to order {answer.number}, which was never sent")
        begins = self.windows is None
        if begins:
            self._begin_run(answer)
        elif not self._corrected(answer, now_ns):
            return
        # The clock of an earlier controller may have been ahead of this controller's.
        self.order_number = max(self.order_number, answer.newest)
        if begins:
            return
        course, move, proven = self.course, self._move, self._proven
        of_move = move is not None and move.order is not None and answer.number == move.order.number
        if (answer.run, answer.term) > (course.run, course.term):
            # The stamper may have accepted an earlier order than the unanswered order.
            self._now_at(answer.run, answer.term, answer.placement, by_guard=answer.fallback)
        else:
            # Stamps show the placement; only the answer shows whether the guard moved the cell.
            course.credit(by_guard=answer.fallback)
        self._told = answer
        if self._move is None and answer.proven and answer.proven != proven:
            self._follow_operators(now_ns)
        if not of_move or move is None or move is not self._move:
            return
        self.refused = answer.refused
        if answer.refused:
            move.refused, move.anew = answer.refused, True
            if not answer.refused.startswith("not ready"):
                self._give_up(now_ns)
        elif move.phase == "fork":
            self._ask_for_states(move, answer)

    def _corrected(self, answer: Accepted, now_ns: int) -> bool:
        """Correct the known term and cycle by the stamper's answer; return False for an old answer.

        An answer is newer than a message that arrived before its order was sent. If its term or
        cycle is nevertheless lower, the earlier message was wrong.
        """
        if (answer.run, answer.term) < (self.course.run, self.course.term):
            if answer.number <= self._term_asked:
                return False
            self._take_back(answer)
        self._unconfirmed = None
        continuity, windows = self.continuity, self.windows
        newest, upcoming = continuity.newest, (answer.run, answer.cycle)
        ahead = continuity.ahead(now_ns)
        leaps = newest is None or newest[0] < answer.run or answer.cycle > newest[1] + ahead
        if newest is not None and not leaps:
            if upcoming > newest or answer.number <= self._cycle_asked:
                return True
            self.place.complain(
                LiveError(f"the stamper has not stamped cycle {newest[1]}; {answer.cycle} is next")
            )
            if windows is not None:
                windows.forget(answer.run, answer.cycle)
        continuity.believe((answer.run, answer.cycle - 1), now_ns)
        self._cycle_asked = self.order_number
        return True

    def _take_back(self, answer: Accepted) -> None:
        """Return to the stamper's term and placement, because the known term was false."""
        self.place.complain(
            LiveError(
                f"the stamper is in term {answer.term}, at {answer.placement}; so it was not moved"
            )
        )
        self._term_asked = self.order_number
        self._stay(f"the stamper says that {answer.placement} holds")
        self._follow(answer)

    def _stay(self, why: str) -> None:
        """End the migration under way and keep the current placement."""
        move, self._move = self._move, None
        if move is not None and move.proposal is not None:
            self.controller.reject(move.proposal, why)
        self._unwritten = True
        if self.windows is not None:
            self.windows.refused()

    def _send(self, order: Order) -> None:
        if self.place.stamper[1] in self.pulse.strangers:
            # Its cell file differs, so its candidates may differ under the same names.
            return
        self.place.send(channels.ORDER, order)

    def _next_number(self) -> int:
        self.order_number += 1
        return self.order_number

    def _order(self, placement: str, now_ns: int) -> Order:
        """Return an order; every order also has the forks and the candidate to prove."""
        course, move = self.course, self._move
        where = course.run, course.term
        fraction = self.controller.shadow_fractions[placement or course.placement]
        forks = () if move is None else move.forks
        want = self._desired(now_ns) if move is None else move.name
        return Order(self._next_number(), self.name, *where, placement, fraction, forks, want)

    def _desired(self, now_ns: int) -> str:
        """Return the candidate to replace the guard's fallback: the operator's, else the policy's.

        It must stay the same until the cell has moved, even if windows end and orders are given
        up: without it the stamper restarts the count of its probes.
        """
        here, wanted = self.course.placement, self.course.wanted
        if not self.course.by_guard:
            return ""
        chosen = self._allowed(here, now_ns)
        if self.wishes.pinned or chosen != here:
            return "" if chosen == here else chosen
        return wanted if wanted is not None and self.wishes.allow(wanted) else ""

    def _begin(self, name: str, now_ns: int, proposal: Proposal | None = None) -> None:
        """Begin a migration that the policy has proposed or an operator has requested."""
        if self._move is not None:
            self._stay(self.wishes.why())
        problem = self.place.problem
        old, new = (problem.candidates[one] for one in (self.course.placement, name))
        # A state moves, or is copied, to each node that is new to its task.
        forks = tuple(
            (task.name, node)
            for task in problem.pipeline.tasks.values()
            for node in nodes_of(new[task.name])
            if task.state_bytes and node not in nodes_of(old[task.name])
        )
        phase: Phase = "fork" if forks else "order"
        wish: Reason = "pinned" if self.wishes.pinned else "drained"
        reason = wish if proposal is None else proposal.decision.reason
        patience_ns = PATIENCE_NS + self._transfer_ns(forks)
        self._move = _Move(
            *(name, reason, now_ns, phase, forks), patience_ns=patience_ns, proposal=proposal
        )
        self.refused = ""
        if self.windows is not None:
            self.windows.ordered(self.course.run, self.course.term)
        self._push(self._move, now_ns)

    def _transfer_ns(self, forks: tuple[tuple[str, str], ...]) -> int:
        """Return the time to send the states of some tasks, ns, on links that they share."""
        problem = self.place.problem
        here, transfer_s = problem.candidates[self.course.placement].first, 0.0
        for task, to in forks:
            link = problem.fabric.links.get(f"{here[task]}->{to}")
            if link is not None:
                bits = 8 * problem.pipeline.tasks[task].state_bytes
                transfer_s += TRANSFER_SHARE * bits / (link.rate_mbps * 1e6)
        return round(transfer_s * 1e9)

    def _push(self, move: _Move, now_ns: int) -> None:
        """Send the order of a migration's current phase, if it has one."""
        move.sent_ns = now_ns
        if move.phase == "state":
            return
        if move.order is None:
            placement = move.name if move.phase == "order" else ""
            move.order = self._order(placement, now_ns)
        elif move.anew:
            # A refused order is sent with a new number; an unanswered order is sent again as it is.
            move.order = self._order(move.order.placement, now_ns)
            move.anew = False
        self._send(move.order)

    def _ask_for_states(self, move: _Move, answer: Accepted) -> None:
        """Request the states of the tasks whose inputs are forked."""
        move.phase = "state"
        old = self.place.problem.candidates[answer.placement].first
        for task, to in move.forks:
            number = self._next_number()
            move.awaited[number] = task
            asked = Snapshot(number, task, old[task], to, answer.run, answer.cycle)
            # The receiving worker must know the request: it accepts only a requested state.
            for node in (to, old[task]):
                self.place.send(channels.SNAPSHOT, asked, task, node)

    def _restored(self, restored: Restored, now_ns: int) -> None:
        move = self._move
        if move is None or restored.number not in move.awaited:
            return
        del move.awaited[restored.number]
        if restored.failed:
            self.place.complain(LiveError(restored.failed))
            move.refused = restored.failed
            self._give_up(now_ns)
        elif not move.awaited:
            move.phase, move.order = "order", None
            self._push(move, now_ns)

    def _give_up(self, now_ns: int) -> None:
        """Give up the migration under way, if any, and end its forks."""
        move = self._move
        if move is None:
            return
        self._stay(move.refused or "no answer")
        if move.forks:
            self._send(self._order("", now_ns))

    # ------------------------------------------------------------------------- windows

    def wake(self, now_ns: int) -> int:
        """Make due decisions, send due orders and beats; return the instant of the next call."""
        self._follow_clock(now_ns)
        if self._began_ns is None:
            self._began_ns = now_ns
        windows, unwritten = self.windows, self._unwritten
        while windows is not None:
            due_ns = windows.due_ns(now_ns)
            if due_ns is None or due_ns > now_ns:
                break
            self._close(windows, now_ns)
        if unwritten:
            self.write()
        move = self._move
        if move is not None:
            if now_ns - move.since_ns > move.patience_ns:
                self._give_up(now_ns)
            elif now_ns - move.sent_ns >= RESEND_NS:
                self._push(move, now_ns)
        if now_ns >= self._ask_ns:
            self._ask_ns = now_ns + ASK_NS
            # This order also renews the lease and names the candidate to prove.
            self._send(self._order("", now_ns))
        due_ns = min(self.pulse.wake(now_ns), self._due_ns(now_ns))
        # Record in the next call, after this call's orders are sent: no order waits for a disk.
        return min(due_ns, now_ns) if self._unwritten else due_ns

    def _close(self, windows: LiveWindows, now_ns: int) -> None:
        """Make the decision that is due, and act on it."""
        before = windows.last
        closed = windows.close(unix_ns=time.time_ns())
        self._unwritten = self._unwritten or windows.last is not before
        windows.spent(self.place.node, now_ns, self.place.who, time.process_time_ns())
        # A migration that is still under way at the next decision is given up.
        self._give_up(now_ns)
        # Miss the decision if less than half of its cycles are known, if no sink was due in them,
        # or if the next decision is due too.
        next_ns = windows.due_ns(now_ns) if windows.often else None
        late = next_ns is not None and next_ns <= now_ns
        looked = windows.looked
        unknown = 2 * windows.heard < self.place.problem.decide_cycles
        if late or looked is None or unknown or not len(closed.latency_ns):
            self.controller.miss()
            return
        course, proven = self.course, self._proven
        proposal = self.controller.propose(closed)
        looked.seen = proposal.seen
        wanted = proposal.decision.name
        unproven = course.leaves_unproven(wanted, proven)
        permitted = course.placement if unproven else wanted
        target = self._allowed(permitted, now_ns)
        if course.leaves_unproven(target, proven):
            target = course.placement
        overruled = target != permitted and self.place.problem.live.mode == "control"
        why = self.wishes.why() if overruled else None
        if unproven:
            self.controller.hold(proposal, why)
        elif target != permitted:
            self.controller.reject(proposal, why)
        elif target == course.placement:
            self.controller.commit(proposal)
        if windows.last is not None:
            self._window_ns = now_ns
            self._window = looked.shown(proposal, self.controller, windows.record.ages)
        if target != course.placement:
            self._begin(target, now_ns, proposal if target == wanted else None)

    def write(self) -> None:
        """Record the rows that are new or have changed since the last call."""
        self._unwritten = False
        if self.windows is not None:
            self._recorder.append(self.windows.record.rows(), origin_ns=self.windows.origin_ns)

    def finish(self) -> Rows | None:
        """Return the remaining rows; an order without an answer counts as carried out."""
        if self.windows is None:
            return None
        if self._move is not None and self._move.proposal is not None:
            self.controller.commit(self._move.proposal)
        self.windows.finish()
        return self.windows.record.rows(last=True)

    def _allowed(self, wanted: str, now_ns: int) -> str:
        """Return the placement that operators and the mode allow for a wanted placement."""
        probed = "" if self._told is None else self._told.probed
        ready = partial(self._workers_ready, now_ns=now_ns)
        return self.wishes.allowed(wanted, self.course.placement, probed, ready)

    def _workers_ready(self, name: str, now_ns: int) -> bool:
        """Whether all workers of a candidate have sent a recent beat and are ready."""
        detector, silent_ns = self.pulse.detector, silent_after_ns(self.place.problem)
        workers = [f"{task}@{node}" for task, node in self.place.problem.candidates[name].sites]
        beats = [detector.last(who) for who in workers if detector.fresh(who, now_ns, silent_ns)]
        return len(beats) == len(workers) and all(beat is not None and beat.ready for beat in beats)

    # ----------------------------------------------------------------------- operators

    def _asked(self, ask: Ask, now_ns: int) -> None:
        refused = self._do(ask, now_ns)
        answer = Answer(ask.number, refused, self.status(now_ns))
        self.place.send(channels.ANSWER, answer, ask.number)

    def _do(self, ask: Ask, now_ns: int) -> str:
        if ask.what == "status":
            return ""
        told = self._told
        if told is not None and told.refused.startswith(OTHER):
            return told.refused
        refused = self.wishes.take(ask.what, ask.about)
        if not refused:
            self._follow_operators(now_ns)
        return refused

    def _follow_operators(self, now_ns: int) -> None:
        """Begin an operator's move; from a fallback only to a proven candidate."""
        if self.windows is None:
            return
        here = self.course.placement
        target = self._allowed(here, now_ns)
        under_way = None if self._move is None else self._move.name
        if self.course.leaves_unproven(target, self._proven):
            return
        if target not in (here, under_way):
            self._begin(target, now_ns)

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return the status of the cell, as plain values."""
        known, course, told, move = self.windows is not None, self.course, self._told, self._move
        began_ns = now_ns if self._began_ns is None else self._began_ns
        age_ms = round((now_ns - self._window_ns) / 1e6, 1)
        joined_ns = self.pulse.detector.joined_age_ns(now_ns)
        status = {
            "cell": self.place.problem.name,
            "controller": self.name,
            "up_ms": round((now_ns - began_ns) / 1e6, 1),
            "joined_ms": round((now_ns - began_ns if joined_ns is None else joined_ns) / 1e6, 1),
            "mode": self.place.problem.live.mode,
            "run": course.run if known else None,
            "term": course.term if known else None,
            "placement": course.placement if known else None,
            "fallback": course.by_guard,
            "resting": course.by_guard if told is None else told.resting,
            "wanted": course.wanted,
            "pinned": self.wishes.pinned or None,
            "drained": sorted(self.wishes.drained),
            "proving": self._proving(now_ns),
            "moving_to": move.name if move is not None and not move.refused else None,
            "refused": self.refused or None,
            "migrations": self.moves.total() - self.moves["guard"],
            "guard_moves": self.moves["guard"],
            "moves": dict(self.moves),
            "disbelieved": self.continuity.leaps,
            "window": {**self._window, "age_ms": age_ms} if self._window else {},
            "stages": {},
            "flows": {},
            **(self.windows.status() if self.windows is not None else {}),
            **(self.windows.symptoms(now_ns) if self.windows is not None else {}),
            **members_status(self.pulse, now_ns),
            "complaints": dict(list(self.place.complaints.items())[-10:]),
            "record": self._recorder.trouble or None,
            "changed": self._changed() or None,
        }
        health, headline = diagnose(self.place.problem, status)
        return {"health": health, "headline": headline, **status}

    def _proving(self, now_ns: int) -> dict[str, Any] | None:
        """Return the progress of the proof that lets the cell leave the guard's fallback."""
        told, desired = self._told, self._desired(now_ns)
        if not desired or self._move is not None:
            return None
        needed = (told and told.needed) or self.place.problem.controller.probe_cycles
        done = told.probes if told is not None and told.probed == desired else 0
        return {"candidate": desired, "done": done, "needed": needed}
