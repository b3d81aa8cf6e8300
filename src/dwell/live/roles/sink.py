"""Sink: the gate before the actuator, and the watchdog."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, Protocol, TypeAlias

from dwell.errors import LiveError
from dwell.live.roles.control_group import UNKNOWN
from dwell.live.roles.origins import cycles_of
from dwell.live.roles.role import BeatState, Pulse, RolePlace
from dwell.live.stage import CellActuator, Message
from dwell.live.wire import channels
from dwell.live.wire.messages import ACTUATED, BEHIND, NOT_APPLIED, STALE, Completion, Header
from dwell.live.wire.payloads import read_payload
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import longest_bytes

#: Methods that bring an actuator to rest.
Rest: TypeAlias = Literal["hold", "zero", "stop"]


class Highest(Protocol):
    """Stores the highest actuated cycle across restarts."""

    def load(self) -> tuple[int, int]:
        """Return run and cycle; (-1, -1) before the first cycle."""

    def store(self, run: int, cycle: int) -> None:
        """Store run and cycle; called before the actuator."""


class Sink:
    """Passes each fresh command to the actuator once and in order; without commands, stops it.

    The gate decides and stores the cycle before any user code runs. The cell's `silence` names the
    method that is called without commands: `hold` or `zero`.
    """

    def __init__(
        self,
        place: RolePlace,
        task: str,
        actuator: CellActuator,
        highest: Highest,
    ) -> None:
        self.place, self.task, self.actuator = place, task, actuator
        self._highest = highest
        self.max_age_ns = round(place.problem.max_age_ms(task) * 1e6)
        self.newest = highest.load()
        self.offsets = place.offsets()
        #: CPU time that this process's control group has used, if the kernel counts it.
        self.group_clock: Callable[[], int] = lambda: UNKNOWN
        self.pulse = Pulse(place, self._state, self._passed, offsets=self.offsets)
        self.counts = {ACTUATED: 0, NOT_APPLIED: 0, BEHIND: 0, STALE: 0, "silences": 0}
        # Errors of the actuator at the last command, and at the last call of `hold` or `zero`.
        self.trouble = self._restless = ""
        self._alarm_ns: int | None = None
        # Whether `hold` or `zero` was called since the last command.
        self._rests = False
        # Call of the actuator that has not returned yet, and its start.
        self._call: tuple[str, int] | None = None
        # After a restart the watchdog runs at once, without waiting for a first command.
        self._takes_over = self.newest >= (0, 0)

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""
        yield from self.pulse.subscriptions()
        yield self.place.keys.of(channels.COMMAND, self.task)

    def receive(self, sample: Arrival, now_ns: int) -> None:
        """Process a command or a beat."""
        if self.pulse.hears(sample):
            self.pulse.receive(sample, now_ns)
            return
        header = self.place.header(sample)
        if header is None or header.source != self.task:
            return
        length, longest = len(sample.payload), longest_bytes(0)
        if length > longest:
            reason = f"{sample.key}: a command of {length} bytes; at most {longest} are taken"
            self.place.complain(LiveError(reason))
            return
        group_ns = self.group_clock()
        outcome, rested = self._gate(header, now_ns), self._rests
        if outcome == ACTUATED and not self._apply(header, sample.payload, now_ns):
            outcome = NOT_APPLIED
        self.counts[outcome] += 1
        ways = header.hops, self.place.node, group_ns, rested
        done = Completion(header.stamp, self.task, now_ns, outcome, *ways)
        self.place.send(channels.DONE, done, self.task)

    def age_ns(self, header: Header, now_ns: int) -> int:
        """Upper bound of the time since a cycle's release, with the clocks' error bound."""
        here_ns, bound_ns = self.offsets.to_reference(self.place.node, now_ns)
        return here_ns + bound_ns - header.stamp.released_ns

    def _gate(self, header: Header, now_ns: int) -> str:
        cycle = header.stamp.key
        if cycle <= self.newest:
            return BEHIND
        if self.age_ns(header, now_ns) > self.max_age_ns:
            return STALE
        self.newest = cycle
        self._highest.store(*cycle)
        return ACTUATED

    def _apply(self, header: Header, payload: bytes, now_ns: int) -> bool:
        """Pass a command to the actuator; return whether it accepted the command.

        The first command starts the watchdog, and only accepted commands reset it.
        """
        stamp = header.stamp
        alarm_ns = now_ns + self.max_age_ns
        self._alarm_ns = self._alarm_ns or alarm_ns
        age_ms = self.age_ns(header, now_ns) / 1e6
        try:
            expected = self.actuator.inputs.get(self.task)
            command = read_payload(header.kind, payload, expected)
            released_ns, _ = self.offsets.from_reference(self.place.node, stamp.released_ns)
            self._call = f"cycle {stamp.cycle}: apply()", now_ns
            behind = self._oldest_ns(header), cycles_of(header)
            self.actuator.apply(Message(command, stamp.cycle, released_ns, age_ms, *behind))
        except Exception as error:  # the user's code
            self.trouble = self._complain(f"cycle {stamp.cycle}: apply()", error)
            return False
        finally:
            self._call = None
        self.trouble = self._restless = ""
        self._alarm_ns, self._rests = alarm_ns, False
        return True

    def _oldest_ns(self, header: Header) -> int | None:
        """Return the stamp of the oldest source, or of the source that the actuator names."""
        wanted = self.actuator.stamp_from
        found = [hop.stamp_ns for hop in header.hops if wanted in ("", hop.task)]
        return min((one for one in found if one is not None), default=None)

    def rest(self, how: Rest) -> bool:
        """Call an actuator's method that brings it to rest; return False if it raised."""
        try:
            getattr(self.actuator, how)()
        except (Exception, SystemExit) as error:  # the user's code
            self._restless = self._complain(f"{how}()", error)
            return False
        self._restless = ""
        return True

    @property
    def _where(self) -> str:
        return f"sink of {self.task} on {self.place.node}"

    def watch(self, now_ns: int) -> None:
        """Send beats while a call of the actuator runs; a separate thread calls this."""
        call = self._call
        if call is None or (waits_ns := now_ns - call[1]) < self.place.period_ns:
            return
        hangs = waits_ns > self.place.hang_ns
        note = f"{self._where}: {call[0]} has not returned for {waits_ns / 1e9:.0f} s"
        self.pulse.send_alone(now_ns, ready=not hangs, note=note if hangs else "")

    def _complain(self, what: str, error: BaseException) -> str:
        trouble = f"{self._where}: {what} raised {type(error).__name__}: {error}"
        self.place.complain(LiveError(trouble))
        return trouble

    def _state(self) -> tuple[bool, str]:
        report = self.actuator.report()
        return report.ready, "; ".join(filter(None, (self._restless, self.trouble, report.note)))

    def _passed(self) -> BeatState:
        return BeatState(run=max(self.newest[0], 0))

    def wake(self, now_ns: int) -> int:
        """Send due beats, run the watchdog, and return the instant of the next call.

        If the actuator raises, the watchdog calls it again after the same time, until the next
        command.
        """
        if self._takes_over:
            self._takes_over = False
            self._alarm_ns = self._alarm_ns or now_ns + self.max_age_ns
        # If the alarm is further away than it is ever set, the clock was set back.
        back = self._alarm_ns is not None and self._alarm_ns > now_ns + self.max_age_ns
        if self._alarm_ns is not None and (back or now_ns >= self._alarm_ns):
            self.counts["silences"] += not self._restless
            how = self.place.problem.live.silence
            self._call, self._rests = (f"{how}()", now_ns), True
            rests = self.rest(how)
            self._call = None
            self._alarm_ns = None if rests else now_ns + self.max_age_ns
        due_ns = self.pulse.wake(now_ns)
        return due_ns if self._alarm_ns is None else min(due_ns, self._alarm_ns)
