"""Agent: the process on each node that keeps the cell's other processes there running.

It sends their beats, and reports the load of the node's CPU. The agent of the relay node also
relays small messages. No data of stages passes through an agent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable

import msgspec
import psutil

from dwell.errors import LiveError
from dwell.live.failures import start_thread
from dwell.live.host.supervision import Supervisor
from dwell.live.roles.role import AGENT_DELAY, CONTROLLER_BEAT, Pulse, RolePlace, beat_in
from dwell.live.roles.stage_counts import REPORT_NS
from dwell.live.roles.worker import SHADOW_BEAT
from dwell.live.transport.abandoned import OUT_OF_FILES
from dwell.live.wire import channels
from dwell.live.wire.channels import CHANNELS
from dwell.live.wire.continuity import SetbackDetector
from dwell.live.wire.keys import Channel
from dwell.live.wire.messages import (
    MAX_HEADER_BYTES,
    Beats,
    Carried,
    Load,
    Receipt,
    StageCounts,
    encode,
)
from dwell.live.wire.relay_batch import MOST_MESSAGES, RelayBatch
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import roles
from dwell.model.instants import NEVER_NS

#: Period of the checks of the processes: while all run, and while a process waits for its start.
LOOK_NS, LOOK_SOON_NS = 200_000_000, 20_000_000
#: Period of the reports of the CPU's load.
LOAD_NS = 250_000_000
#: Period of the checks of the processes' memory and of the size of their logs.
HOUSEKEEPING_NS = 1_000_000_000
#: Age in periods from which an agent no longer sends the beat of a process of its node.
PATIENCE = 2 * SHADOW_BEAT
#: Length of the notes of beats that are too long for one message.
SHORT_NOTE = 100
#: Age from which a gauge's value is invalid.
GAUGE_S = 2.0


def busy_ns_of(cpus: Iterable[int]) -> int:
    """Core-nanoseconds that CPUs have been busy since the boot, in steps of 10 ms."""
    times = psutil.cpu_times(percpu=True)
    busy_s = 0.0
    for cpu in cpus:
        spent = times[cpu]
        busy_s += sum(spent) - spent.idle - spent.iowait - spent.guest - spent.guest_nice
    return round(busy_s * 1e9)


class Gauge:
    """Reads a utilisation (0 to 1) from a user's function in a thread, as it may fail or block."""

    def __init__(self, read: Callable[[], float], every_s: float = LOAD_NS / 1e9) -> None:
        self._read, self._every_s = read, every_s
        self._value, self._read_s = -1.0, time.monotonic()
        self._trouble = ""
        start_thread("gauge", self._run)

    def _run(self) -> None:
        while True:
            try:
                value = float(self._read())
                if not 0.0 <= value <= 1.0 or math.isnan(value):
                    raise ValueError(f"{value:g} is no share from 0 to 1")
                self._value, self._trouble = value, ""
            except (Exception, SystemExit) as error:  # the user's code
                self._value = -1.0
                self._trouble = f"the accelerator's utilisation: {type(error).__name__}: {error}"
            self._read_s = time.monotonic()
            time.sleep(self._every_s)

    def value(self) -> float:
        """Return the last value; -1 if the function failed or has not returned for `GAUGE_S`."""
        return self._value if self._silent_s() < GAUGE_S else -1.0

    def trouble(self) -> str:
        """Return why no value is available; empty if one is."""
        silent_s = self._silent_s()
        if silent_s < GAUGE_S:
            return self._trouble
        return f"the accelerator's utilisation: the function has not returned for {silent_s:.0f} s"

    def _silent_s(self) -> float:
        return time.monotonic() - self._read_s


class Agent:
    """Logic of the agent's role; `changed` returns a sentence about changed files, or none."""

    def __init__(
        self,
        place: RolePlace,
        supervisor: Supervisor,
        busy_ns: Callable[[], int],
        accelerator: Gauge | None = None,
        stages: Callable[[], Iterable[StageCounts]] = tuple,
        changed: Callable[[], str] = str,
    ) -> None:
        self.place, self.supervisor, self._changed = place, supervisor, changed
        self._read_stages = stages
        self._stages: tuple[StageCounts, ...] = ()
        self._busy_ns, self._accelerator = busy_ns, accelerator
        self.cpu_clock: Callable[[], int] = time.process_time_ns
        self._relays = place.node == place.problem.relay_node
        # Beats contain the number of the sender's roster.
        has_keys = place.seals is not None
        self.offsets = place.offsets()
        self.pulse = Pulse(
            *(place, self._state),
            hears=[place.stamper, place.controller] if has_keys else None,
            nodes=["*"] if self._relays or has_keys else self._senders(),
            offsets=self.offsets,
        )
        self._members = [
            role.who
            for role in roles(place.problem)
            if role.node == place.node and role.kind not in ("agent", "controller")
        ]
        # Periodic tasks with their periods; `_due_ns` has the time of the next call.
        self._chores: dict[Callable[[int], None], int] = {
            lambda _: supervisor.tend(): HOUSEKEEPING_NS,
            self._count: REPORT_NS,
            self._report: LOAD_NS,
        }
        self._due_ns = dict.fromkeys(self._chores, 0)
        self._looked_ns = -NEVER_NS
        self._carried = RelayBatch()
        self._carry_ns = NEVER_NS
        self._gathered = RelayBatch(MOST_MESSAGES // 2)
        self._beats = RelayBatch(MOST_MESSAGES // 2, newest=True)
        self._gather_ns = self._beats_ns = 0
        self._send_ns = self._missed_ns = -NEVER_NS
        self._relay_prefix = f"{place.keys.root}/relay/"
        self._setback = SetbackDetector()
        self._read: dict[str, int] = {}
        self._spent: dict[str, int] = {"own": 0, "shadow": 0}

    def subscriptions(self) -> Iterable[str]:
        """Yield the key expressions to subscribe to."""
        yield from self.pulse.subscriptions()
        if self._relays:
            yield self.place.keys.relay(f"{self.place.keys.root}/**")
            yield self.place.keys.of(channels.MISSED)

    def _senders(self) -> set[str]:
        """Return the nodes whose processes send messages to this node."""
        node, problem = self.place.node, self.place.problem
        tasks = problem.pipeline.tasks
        flows = (flow for flow in problem.pipeline.flows if node in tasks[flow.target].on)
        senders = {other for flow in flows for other in tasks[flow.source].on}
        return (senders | {problem.stamper_node}) - {node}

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        """Read beats, or queue messages to relay; return when to relay them, if at all."""
        keys, period_ns = self.place.keys, self.place.period_ns
        copied = sample.key.startswith(self._relay_prefix)
        key = sample.key.removeprefix(self._relay_prefix if copied else f"{keys.root}/")
        channel = CHANNELS.get(key.partition("/")[0])
        if not copied and self.pulse.hears(sample):
            self.pulse.receive(sample, now_ns)
        if not self._relays:
            return None
        if channel is channels.MISSED:
            self._missed_ns = now_ns
        if channel is None or not (channel.twice if copied else channel is channels.BEATS):
            return None
        beats = channel in (channels.BEAT, channels.BEATS)
        (self._beats if beats else self._gathered).add(key, sample.payload)
        wanted = copied or 0 <= now_ns - self._missed_ns < 2 * period_ns
        if wanted and self._carried.add(key, sample.payload):
            self._carry_ns = min(self._carry_ns, now_ns + period_ns // 4)
        return self._carry_ns

    def _state(self) -> tuple[bool, str]:
        trouble = "" if self._accelerator is None else self._accelerator.trouble()
        notes = self.supervisor.notes(), trouble, self._changed()
        return not self.supervisor.stuck(), "; ".join(note for note in notes if note)

    def wake(self, now_ns: int) -> int:
        """Check the processes, report the load, relay, beat; return the time of the next call."""
        if self._setback.back_ns(now_ns):
            self._due_ns = dict.fromkeys(self._chores, now_ns)
            self._looked_ns = -NEVER_NS
            self._gather_ns = self._beats_ns = now_ns
            self._carry_ns = min(self._carry_ns, now_ns + self.place.period_ns // 4)
        if now_ns >= self._look_due_ns():
            self._looked_ns = now_ns
            self._try(lambda _: self.supervisor.step(), now_ns)
        for chore, every_ns in self._chores.items():
            if now_ns >= self._due_ns[chore]:
                self._try(chore, now_ns)
                self._due_ns[chore] = now_ns + every_ns
        if now_ns >= self._carry_ns:
            self._carry_ns = NEVER_NS
            self._send(channels.CARRIED, self._carried.taken())
        wakes = [self._beat(now_ns), self._look_due_ns(), *self._due_ns.values()]
        wakes.append(self._carry_ns)
        if self._relays:
            if now_ns >= self._gather_ns:
                self._tell(now_ns)
                self._gather_ns = now_ns + self.place.period_ns
            wakes.append(self._gather_ns)
        return min(wakes)

    def _beat(self, now_ns: int) -> int:
        """Send the beats of the node if they are due; return when they are due next."""
        place = self.place
        period_ns, delay_ns = place.period_ns, place.period_ns // AGENT_DELAY
        if self._send_ns > now_ns >= self._send_ns - period_ns:
            return self._send_ns
        self._send_ns = (now_ns - delay_ns) // period_ns * period_ns + period_ns + delay_ns
        beats = [self.pulse.made(now_ns)]
        if place.slots is not None:
            slots, patience_ns = place.slots, PATIENCE * period_ns
            found = (beat_in(slots, who, now_ns) for who in self._members)
            beats += [beat for beat in found if beat and now_ns - beat.sent_ns <= patience_ns]
            times = {beat.who: beat.sent_ns for beat in beats}
            slots.write(encode(Receipt(place.life, now_ns, times, self.offsets.interval)))
        key = place.keys.of(channels.BEATS, place.node)
        payload = place.sealed(channels.BEATS, Beats(tuple(beats)))
        if len(payload) > MAX_HEADER_BYTES:
            # Only the notes can be that long.
            beats = [msgspec.structs.replace(beat, note=beat.note[:SHORT_NOTE]) for beat in beats]
            payload = place.sealed(channels.BEATS, Beats(tuple(beats)))
        place.transport.put(key, payload)
        if self._relays:
            self._beats.add(key.removeprefix(f"{place.keys.root}/"), payload)
        return self._send_ns

    def _look_due_ns(self) -> int:
        return self._looked_ns + (LOOK_SOON_NS if self.supervisor.pending else LOOK_NS)

    def _try(self, chore: Callable[[int], None], now_ns: int) -> None:
        """Run a task; skip it if other programs hold all file descriptors."""
        try:
            chore(now_ns)
        except OSError as error:
            if error.errno not in OUT_OF_FILES:
                raise
            who = self.place.who
            self.place.complain(LiveError(f"{who}: no file can be opened ({error.strerror})"))

    def _tell(self, now_ns: int) -> None:
        """Send relayed messages to the controller; beats less often, and only the newest."""
        messages = self._gathered.taken()
        if now_ns >= self._beats_ns:
            messages += self._beats.taken()
            self._beats_ns = now_ns + CONTROLLER_BEAT * self.place.period_ns
        if messages:
            self._send(channels.GATHERED, messages)

    def _send(self, channel: Channel[Carried], messages: list[tuple[str, bytes]]) -> None:
        self.place.send(channel, Carried(tuple(messages)))

    def _count(self, _: int) -> None:
        """Read the stage counts for the next report of the load."""
        self._stages = tuple(self._read_stages())

    def _report(self, now_ns: int) -> None:
        place = self.place
        processes = {who: round(s * 1e9) for who, s in self.supervisor.cpu_seconds().items()}
        for who, cpu_ns in processes.items():
            # The CPU time of a restarted process starts at 0.
            before = self._read.get(who, 0)
            grown = cpu_ns - before if cpu_ns >= before else cpu_ns
            self._spent["shadow" if who.endswith(".shadow") else "own"] += grown
        self._read |= processes
        busy_ns = self._busy_ns()
        used = -1.0 if self._accelerator is None else self._accelerator.value()
        spent = busy_ns, self._spent["own"], self._spent["shadow"]
        each = *processes.items(), (place.who, self.cpu_clock())
        load = Load(place.node, place.life, now_ns, *spent, used, each, self._stages)
        self._stages = ()
        place.send(channels.LOAD, load, place.node)
