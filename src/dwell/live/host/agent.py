"""Agent: one a node. It keeps the cell's processes there running, and carries none of its data.

It also reports the load of the node's CPU, and on one node it is the detour for small messages.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable

import psutil

from dwell.errors import LiveError
from dwell.live.failures import start_thread
from dwell.live.host.supervision import Supervisor
from dwell.live.roles.role import AGENT_BEAT, Pulse, RolePlace
from dwell.live.roles.stage_counts import REPORT_NS
from dwell.live.transport.abandoned import OUT_OF_FILES
from dwell.live.wire.continuity import SetbackDetector
from dwell.live.wire.keys import TWICE
from dwell.live.wire.messages import Carried, Load, StageCounts, encode
from dwell.live.wire.relay_batch import MOST_MESSAGES, RelayBatch
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import roles
from dwell.model.instants import NEVER_NS

#: Time between two looks at the processes: while all run, and while one has to be started.
LOOK_NS, LOOK_SOON_NS = 200_000_000, 20_000_000
#: Time between two reports of the CPU.
LOAD_NS = 250_000_000
#: Time between two looks at the memory of the processes, and at how long their logs are.
HOUSEKEEPING_NS = 1_000_000_000
#: Age from which what a gauge showed counts no more.
GAUGE_S = 2.0


def busy_ns_of(cpus: Iterable[int]) -> int:
    """Core-nanoseconds that CPUs have been busy since the machine was started, by its 10 ms."""
    times = psutil.cpu_times(percpu=True)
    busy_s = 0.0
    for cpu in cpus:
        spent = times[cpu]
        busy_s += sum(spent) - spent.idle - spent.iowait - spent.guest - spent.guest_nice
    return round(busy_s * 1e9)


class Gauge:
    """Asks a user's function for a utilisation, in a thread of its own: it may fail, or hang.

    Parameters
    ----------
    read : callable
        Returns a share from 0 to 1.
    """

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
        """Return the last value; -1 where there is none that counts."""
        return self._value if self._silent_s() < GAUGE_S else -1.0

    def trouble(self) -> str:
        """Return what keeps it from telling, or nothing."""
        silent_s = self._silent_s()
        if silent_s < GAUGE_S:
            return self._trouble
        return f"the accelerator's utilisation: the function has not returned for {silent_s:.0f} s"

    def _silent_s(self) -> float:
        return time.monotonic() - self._read_s


class Agent:
    """See the module.

    Parameters
    ----------
    busy_ns : callable
        Returns the core-nanoseconds that the node has been busy so far.
    stages : callable, optional
        Returns the counts of the node's workers.
    changed : callable
        Returns which files have changed since the node began; empty for none.
    """

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
        # No guard waits for it: it carries nothing that a cycle needs.
        hears = [place.stamper]
        if place.seals is not None:
            # They say which roster they use.
            hears += [
                (role.node, role.who) for role in roles(place.problem) if role.kind == "agent"
            ]
        self.pulse = Pulse(place, self._state, hears=hears, every=AGENT_BEAT)
        self._relays = place.node == place.problem.relay_node
        # What is done again and again, every so often; and when each is due.
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
        self._beat_prefix = place.keys.relay(place.keys.beat("", "").removesuffix("/"))
        self._relay_prefix = f"{place.keys.root}/relay/"
        self._setback = SetbackDetector()
        self._read: dict[str, int] = {}
        self._spent: dict[str, int] = {"own": 0, "shadow": 0}

    def subscriptions(self) -> Iterable[str]:
        """Key expressions that it wants to hear."""
        yield from self.pulse.subscriptions()
        if self._relays:
            yield self.place.keys.relay(f"{self.place.keys.root}/**")

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        """Take a message in; carry it on where this is the detour."""
        if self.pulse.hears(sample):
            self.pulse.receive(sample, now_ns)
            return None
        if not (self._relays and sample.key.startswith(self._relay_prefix)):
            return None
        key = sample.key.removeprefix(self._relay_prefix)
        if key.partition("/")[0] not in TWICE:
            return None
        if self._carried.add(key, sample.payload):
            self._carry_ns = min(self._carry_ns, now_ns + self.place.period_ns // 4)
        is_beat = sample.key.startswith(self._beat_prefix)
        (self._beats if is_beat else self._gathered).add(key, sample.payload)
        return self._carry_ns

    def _state(self) -> tuple[bool, str]:
        trouble = "" if self._accelerator is None else self._accelerator.trouble()
        notes = self.supervisor.notes(), trouble, self._changed()
        return not self.supervisor.stuck(), "; ".join(note for note in notes if note)

    def wake(self, now_ns: int) -> int:
        """Look after the processes, report the load, beat; returns what is due next."""
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
            self._put(self.place.keys.carried(), self._carried.taken())
        wakes = [self.pulse.wake(now_ns), self._look_due_ns(), *self._due_ns.values()]
        wakes.append(self._carry_ns)
        if self._relays:
            if now_ns >= self._gather_ns:
                self._tell(now_ns)
                self._gather_ns = now_ns + self.place.period_ns
            wakes.append(self._gather_ns)
        return min(wakes)

    def _look_due_ns(self) -> int:
        return self._looked_ns + (LOOK_SOON_NS if self.supervisor.pending else LOOK_NS)

    def _try(self, chore: Callable[[int], None], now_ns: int) -> None:
        """Do a chore, or leave it for the next time where strangers hold all descriptors."""
        try:
            chore(now_ns)
        except OSError as error:
            if error.errno not in OUT_OF_FILES:
                raise
            who = self.place.who
            self.place.complain(LiveError(f"{who}: no file can be opened ({error.strerror})"))

    def _tell(self, now_ns: int) -> None:
        """Tell the controller what came over the detour; of beats the last, and less often."""
        messages = self._gathered.taken()
        if now_ns >= self._beats_ns:
            messages += self._beats.taken()
            self._beats_ns = now_ns + AGENT_BEAT * self.place.period_ns
        if messages:
            self._put(self.place.keys.gathered(), messages)

    def _put(self, key: str, messages: list[tuple[str, bytes]]) -> None:
        self.place.transport.put(key, encode(Carried(tuple(messages))))

    def _count(self, _: int) -> None:
        """Read what the next report of the load says of stages."""
        self._stages = tuple(self._read_stages())

    def _report(self, now_ns: int) -> None:
        place = self.place
        processes = {who: round(s * 1e9) for who, s in self.supervisor.cpu_seconds().items()}
        for who, cpu_ns in processes.items():
            # One that was started again counts from 0 again.
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
        place.put_twice(place.keys.load(place.node), load)
