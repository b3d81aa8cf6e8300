"""Worker: joins a task's inputs, runs its stage, and sends the output as the stamp directs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeAlias

from dwell.errors import LiveError
from dwell.live.roles.control_group import UNKNOWN, Counts
from dwell.live.roles.offsets import Offsets
from dwell.live.roles.role import BeatState, Pulse, RolePlace
from dwell.live.roles.stage_counts import DROPPED, REPLACED, TAKEN, StageBook
from dwell.live.stage import CellStage, Message
from dwell.live.wire.keys import CONTROLLER, MAIN, SHADOW
from dwell.live.wire.messages import (
    Completion,
    Header,
    Hop,
    Rates,
    Restored,
    Snapshot,
    Stamp,
    State,
    decode,
    encode,
)
from dwell.live.wire.payloads import read_payload, write_payload
from dwell.live.wire.routing import STAMPER, Routes
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import SPARE, lane_of, longest_bytes
from dwell.model.instants import EVIDENCE_NS, NEVER_NS
from dwell.model.pipeline import LONGEST_DEADLINE

#: Largest number of cycles that wait for the rest of their inputs: those of the longest deadline.
MAX_JOINS = LONGEST_DEADLINE
#: Periods between two beats of a shadow worker.
SHADOW_BEAT = 10
#: Least time between two checkpoints, as a multiple of the cost of a checkpoint.
CHECKPOINT_SPACING = 20
#: Longest time that a migration waits for a call of snapshot() or restore().
MOVING_NS = 10_000_000_000
#: Header, payload and time of arrival by source task.
Inputs: TypeAlias = dict[str, tuple[Header, bytes, int]]
NOT_COUNTED = Counts(), UNKNOWN, Counts()


@dataclass(slots=True)
class Job:
    """A complete set of inputs of one cycle; `header` is the header of one of them."""

    header: Header
    inputs: Inputs
    shadow: bool

    @property
    def arrived_ns(self) -> int:
        """Arrival of the last input."""
        return max(at_ns for _, _, at_ns in self.inputs.values())

    @property
    def order(self) -> tuple[int, int]:
        """Run and cycle; they grow with every job."""
        return self.header.stamp.key

    @property
    def headers(self) -> Iterable[Header]:
        """Headers of the inputs."""
        return (header for header, _, _ in self.inputs.values())

    def hops(self) -> tuple[Hop, ...]:
        """Return all jobs upstream in this cycle, each once."""
        hops = (hop for header, _, _ in self.inputs.values() for hop in header.hops)
        return tuple({(hop.task, hop.node): hop for hop in hops}.values())


@dataclass(frozen=True, slots=True)
class Chore:
    """A call of the stage between two jobs: snapshot() for the nodes `to`, or restore().

    `number` is the number of the request, 0 for a checkpoint; `state` and `data` are the state to
    restore.
    """

    to: tuple[str, ...] = ()
    number: int = 0
    state: State | None = None
    data: bytes = b""

    @property
    def call(self) -> str:
        """Name of the call."""
        return "snapshot()" if self.state is None else "restore()"


@dataclass(slots=True)
class _Joins:
    """Inputs of incomplete cycles; a complete cycle evicts earlier ones whose deadline has passed.

    These are `open_cycles` or more before it. `drop` gets the headers of inputs that are too late
    or evicted.
    """

    sources: frozenset[str]
    drop: Callable[[Iterable[Header]], None]
    open_cycles: int = 1
    waiting: dict[tuple[int, int], Inputs] = field(default_factory=dict)
    newest: tuple[int, int] = (-1, -1)
    # Complete cycles among the newest `open_cycles`.
    done: set[tuple[int, int]] = field(default_factory=set)

    @property
    def _last_over(self) -> tuple[int, int]:
        """The last cycle whose inputs are too late."""
        run, number = self.newest
        return run, number - self.open_cycles

    def add(self, header: Header, payload: bytes, at_ns: int) -> Inputs | None:
        """Add an input; return the set of its cycle's inputs if it is now complete."""
        cycle = header.stamp.key
        late = cycle <= self._last_over or cycle in self.done
        if late or header.source not in self.sources:
            self.drop([header])
            return None
        inputs = self.waiting.setdefault(cycle, {})
        inputs.setdefault(header.source, (header, payload, at_ns))
        if len(inputs) < len(self.sources):
            if len(self.waiting) > MAX_JOINS:
                self._evict(min(self.waiting))
            return None
        self.newest = max(self.newest, cycle)
        del self.waiting[cycle]
        last = self._last_over
        self.done = {other for other in (*self.done, cycle) if other > last}
        for other in [other for other in self.waiting if other <= last]:
            self._evict(other)
        return inputs

    def _evict(self, cycle: tuple[int, int]) -> None:
        self.drop(header for header, _, _ in self.waiting.pop(cycle).values())


class _Source:
    """Stamps of a source task; each waits for the instant at which its cycle begins here.

    If the source's node is not the stamper's, stamps arrive one cycle early. If a stamp is missing
    and cycles are released by a timer, the source guesses up to g stamps in a row.
    """

    def __init__(self, place: RolePlace, offsets: Offsets, offset_ns: int) -> None:
        self._place, self._offsets, self._offset_ns = place, offsets, offset_ns
        self._guesses = place.problem.controller.guard_cycles
        self._alone = place.node != place.stamper[0] and place.problem.live.release == "timer"
        self._waiting: dict[tuple[int, int], tuple[Header, int]] = {}
        self._last: Header | None = None
        self._guessed = 0

    def stamped(self, header: Header, now_ns: int) -> None:
        """Store a stamp; of several stamps of one cycle, the highest term counts."""
        cycle = header.stamp.key
        if self._last is not None and cycle <= self._last.stamp.key:
            return
        known = self._waiting.get(cycle)
        if known is None or known[0].stamp.term < header.stamp.term:
            self._waiting[cycle] = header, now_ns
            if len(self._waiting) > MAX_JOINS:
                del self._waiting[min(self._waiting)]

    def _begins_ns(self, header: Header) -> int:
        return self._offsets.from_reference(self._place.node, header.stamp.released_ns)[0]

    @property
    def due_ns(self) -> int:
        """Instant at which the next cycle begins, or its stamp is guessed."""
        if self._waiting:
            header, _ = self._waiting[min(self._waiting)]
            return self._begins_ns(header) + self._offset_ns
        if self._last is None or not self._alone or self._guessed >= self._guesses:
            return NEVER_NS
        period_ns = self._place.period_ns
        return self._begins_ns(self._last) + self._offset_ns + period_ns + period_ns // 4

    def due(self, now_ns: int) -> Job | None:
        """Return the job of the cycle that begins now; None if no cycle does."""
        if now_ns < self.due_ns:
            return None
        if self._waiting:
            header, at_ns = self._waiting.pop(min(self._waiting))
            self._guessed = 0
        elif self._last is not None:
            before, at_ns = self._last.stamp, now_ns
            released_ns = before.released_ns + self._place.period_ns
            guess = Stamp(before.run, before.cycle + 1, 0, before.placement, released_ns)
            seal = self._place.stamped(guess)
            header = Header(guess, STAMPER, self._place.node, "none", seal=seal)
            self._guessed += 1
        else:
            return None
        self._last = header
        return Job(header, {STAMPER: (header, b"", at_ns)}, False)


class Worker:
    """A task on a node, for cycles or for their shadows.

    A standby receives the same inputs as the process `stands_by`, and takes over when the beats
    of this process are missing; downstream processes drop messages that arrive twice. `book` counts
    jobs and messages, but ignores shadows.
    """

    def __init__(
        self,
        place: RolePlace,
        task: str,
        stage: CellStage,
        *,
        shadow: bool = False,
        stands_by: str = "",
        book: StageBook | None = None,
    ) -> None:
        self.place, self.task, self.stage = place, task, stage
        self.shadow, self.stands_by = shadow, stands_by
        problem = place.problem
        self.routes = Routes(problem)
        self.offsets = place.offsets()
        #: Declared bytes of inputs (by source), outputs (by target) and state; they determine the
        #: lanes and the longest payloads.
        self._input_bytes = {f.source: f.payload_bytes for f in problem.pipeline.inputs(task)}
        self._output_bytes = {f.target: f.payload_bytes for f in problem.pipeline.outputs(task)}
        self._state_bytes = problem.pipeline.tasks[task].state_bytes
        self._nodes = frozenset(problem.pipeline.tasks[task].on)
        sources = frozenset(self._input_bytes) or frozenset([STAMPER])
        #: Whether frames of this stage start the cycles; only frames of the first source do.
        first = next(name for name in problem.pipeline.tasks if not problem.pipeline.inputs(name))
        frames = problem.live.release == "frames" and task == first
        self.triggers = frames and not shadow and not stands_by
        self._framed_ns: int | None = None
        self.is_sink = not self._output_bytes
        self._depth = problem.pipeline.tasks[task].depth
        self.book = book or StageBook(problem, task, place.node)
        self.book.begin()
        self._warmup = problem.pipeline.tasks[task].warmup_jobs
        overlap = problem.pipeline.open_cycles
        self._joins = {
            MAIN: _Joins(sources, lambda headers: self.book.ended(headers, DROPPED), overlap),
            SHADOW: _Joins(sources, lambda _: None, overlap),
        }
        #: CPU clock of a job: this thread's, or the process's if the cell file gives the stage
        #: several threads.
        alone = problem.pipeline.tasks[task].on[place.node].threads == 1
        self.cpu_clock: Callable[[], int] = time.thread_time_ns if alone else time.process_time_ns
        #: CPU time that other processes have used, if the kernel counts it.
        self.group_clock: Callable[[], Counts] = Counts
        self._counted: tuple[Counts, int, Counts] = NOT_COUNTED
        self._jobs: deque[Job] = deque()
        offset_ns = round(problem.pipeline.tasks[task].offset_ms * 1e6)
        self._source = _Source(place, self.offsets, offset_ns) if STAMPER in sources else None
        self._stateful = stage.stateful and not shadow
        self._asked: Snapshot | None = None
        #: Request for a state to be sent here; received states and checkpoints by sending node.
        self._awaited: Snapshot | None = None
        self._answers: dict[str, tuple[State, bytes]] = {}
        self._checkpoints: dict[str, tuple[State, bytes]] = {}
        #: Run and cycle of the newest stamp that has arrived with an input.
        self._newest = (-1, -1)
        # Jobs forked to here ahead of a migration; jobs to process after restoring the state.
        self._forked: deque[Job] = deque(maxlen=10 * MAX_JOINS)
        self._replay: deque[Job] = deque(maxlen=10 * MAX_JOINS)
        self._follows = False
        self._restored: Restored | None = None
        # Run and cycle of the last job in the state, of the restored state, and of the last job
        # that the placement assigned to this worker.
        self.state_at = self._restored_at = self._worked_at = (-1, -1)
        self.started = False
        self.trouble = ""
        self.busy_since_ns: int | None = None
        self._busy_cycle = 0
        self._chore: Chore | None = None
        # Nodes for which a checkpoint is due; duration of the last snapshot, made here or received,
        # and the end of the last one made here.
        self._checkpoint_to: tuple[str, ...] = ()
        self._cost_ns, self._snapshot_ns = 0, -NEVER_NS
        self.replaced = 0
        self.failures = 0
        # Number of calls of process() in a row without an output to send; end of the last one.
        self._failed_in_a_row, self._failed_ns = 0, 0
        self._now_ns = 0
        # Sender of each link that the inputs may take. The stamper's beats compare the clocks.
        before = [
            (node, f"{source}@{node}")
            for source in sources - {STAMPER}
            for node in problem.pipeline.tasks[source].on
            if node != place.node
        ]
        primary = [(place.node, stands_by)] if stands_by else []
        hears = [] if shadow else [*before, *primary]
        # The guard ignores shadow workers, so they can beat less often.
        slow = SHADOW_BEAT if shadow else 1
        hears = [place.stamper, *hears]
        given = place, self._state, self._moves
        self.pulse = Pulse(*given, hears=hears, every=slow, offsets=self.offsets)

    # ---------------------------------------------------------------------- receiving

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""
        keys, node = self.place.keys, self.place.node
        yield from self.pulse.subscriptions()
        if self.shadow:
            yield keys.inputs(self.task, node, SHADOW)
            return
        yield keys.inputs(self.task, node, MAIN)
        if self.is_sink:
            yield keys.inputs(self.task, node, SHADOW)
        if self._stateful:
            yield keys.snapshot(self.task, node)
            yield keys.state(self.task, node)

    def receive(self, sample: Arrival, now_ns: int) -> None:
        """Process a message."""
        if self.pulse.hears(sample):
            self.pulse.receive(sample, now_ns)
            return
        kind = sample.key.rpartition("/")[2]
        if kind in (MAIN, SHADOW) and "/in/" in sample.key:
            self._input(sample, kind, now_ns)
        elif "/snapshot/" in sample.key or "/state/" in sample.key:
            try:
                self._about_state(sample)
            except LiveError as error:
                self.place.complain(error)

    def _input(self, sample: Arrival, kind: str, now_ns: int) -> None:
        header = self.place.header(sample)
        if header is None:
            return
        if header.stamp.term:  # not a source's guess
            self._newest = max(self._newest, header.stamp.key)
        if header.source == STAMPER and self._source is not None:
            self._source.stamped(header, now_ns)
            return
        if kind == MAIN and not self.stands_by:
            self.book.arrived(header)
        declared = self._input_bytes.get(header.source)
        longest = 0 if declared is None else longest_bytes(declared)
        if len(sample.payload) > longest:
            what = f"{len(sample.payload)} bytes from {header.source}; at most {longest} are taken"
            self.place.complain(LiveError(f"{self.task} on {self.place.node}: {what}"))
            self._joins[kind].drop([header])
            return
        complete = self._joins[kind].add(header, sample.payload, now_ns)
        if complete is None:
            return
        # Term 0 marks a source's guess; a stamp from the stamper has precedence.
        stamped = max((one for one, _, _ in complete.values()), key=lambda one: one.stamp.term)
        job = Job(stamped, complete, kind == SHADOW)
        if self.is_sink and job.shadow:
            # A shadow ends before its sink.
            self._end(job, "shadow")
        elif self._is_forked(job):
            self.book.ended(job.headers, TAKEN)
            self._forked.append(job)
            if self._follows:
                self._replay.append(job)
        else:
            self._jobs.append(job)
            if len(self._jobs) > (self._depth or 10 * MAX_JOINS):
                # Of the oldest waiting job and the new job, the earlier cycle.
                overtaken = job.order < self._jobs[0].order
                self._replace(self._jobs.pop() if overtaken else self._jobs.popleft())

    def _replace(self, job: Job) -> None:
        """Report a job that a later cycle has replaced."""
        self.replaced += 1
        if not job.shadow:
            self.book.ended(job.headers, REPLACED)
        self._end(job, "shadow" if job.shadow else "replaced")

    def _end(self, job: Job, outcome: str) -> None:
        """Report a job that has arrived and will not run, with all jobs upstream of it."""
        place, at_ns = self.place, job.arrived_ns
        inputs = tuple((source, at_ns) for source, (_, _, at_ns) in job.inputs.items())
        times = at_ns, UNKNOWN, UNKNOWN
        here = Hop(self.task, place.node, *times, inputs, warmup=self.warms_up)
        hops = (*job.hops(), here)
        ended = Completion(job.header.stamp, self.task, at_ns, outcome, hops, place.node)
        place.put_twice(place.keys.ended(), ended)

    # -------------------------------------------------------------------------- state

    def _is_forked(self, job: Job) -> bool:
        """Whether a job was sent here only because the state will move here."""
        runs_here = self.routes.runs(self.task, self.place.node, job.header.stamp)
        return self._stateful and not runs_here and not job.shadow

    def _about_state(self, sample: Arrival) -> None:
        if "/snapshot/" in sample.key:
            asked = self.place.read(sample, Snapshot, lambda _: CONTROLLER)
            if asked.task == self.task and asked.node == self.place.node:
                self._asked = asked
            elif asked.task == self.task and asked.to == self.place.node:
                self._awaited = asked
            return
        state = decode(sample.header, State)
        if state.task != self.task:
            raise LiveError(f"a state of {state.task} came to {self.task}")
        if not sample.key.endswith(f"/{state.node}") or state.node not in self._nodes:
            raise LiveError(f"{sample.key}: a state of {state.task} on {state.node}")
        length, longest = len(sample.payload), longest_bytes(self._state_bytes)
        if length > longest:
            raise LiveError(f"{self.task}: a state of {length} bytes; at most {longest} are taken")
        kept = self._answers if state.number else self._checkpoints
        kept[state.node] = state, sample.payload
        self._cost_ns = self._cost_ns or state.cost_ns

    @property
    def _restoring(self) -> tuple[State, bytes] | None:
        """The requested state, if it has arrived and the stamp of its last cycle is known here.

        Inputs of later cycles are forked to here.
        """
        asked = self._awaited
        found = None if asked is None else self._answers.get(asked.node)
        if asked is None or found is None or found[0].number != asked.number:
            return None
        return found if (asked.run, asked.cycle - 1) <= found[0].key <= self._newest else None

    def next_chore(self, now_ns: int) -> Chore | None:
        """Return the chore before the next job; `do_chore` and `finish_chore` must follow."""
        if self.busy_since_ns is not None or not self.started:
            return None
        asked = self._asked
        if asked is not None and self.state_at >= (asked.run, asked.cycle - 1):
            self._asked, chore = None, Chore((asked.to,), asked.number)
        elif (found := self._restoring) is not None:
            self._awaited = None
            self._answers.clear()
            chore = Chore((), found[0].number, *found)
        elif self._checkpoint_to:
            chore = Chore(self._checkpoint_to)
        else:
            return None
        self._checkpoint_to = ()
        self._chore, self.busy_since_ns, self._now_ns = chore, now_ns, now_ns
        if chore.number:
            # The beat announces the pause, which the guard must not count as a fault.
            self.pulse.send(now_ns)
        return chore

    def do_chore(self, chore: Chore) -> tuple[bytes, str]:
        """Call the stage; return the snapshot, and the error or an empty string."""
        state = chore.state
        if state is None:
            try:
                return bytes(self.stage.snapshot()), ""
            except Exception as error:  # the user's code
                return b"", f"snapshot() failed ({type(error).__name__}: {error})"
        if state.key < self._worked_at:
            cycle = self._worked_at[1]
            return b"", f"{self.task}: a state of cycle {state.cycle} came after one of {cycle}"
        if state.key < self._restored_at:
            return b"", ""
        return b"", self._take_over(state, chore.data)

    def finish_chore(
        self, chore: Chore, data: bytes, failed: str, started_ns: int, ended_ns: int
    ) -> None:
        """Send the snapshot, or queue the forked jobs that follow a restored state."""
        self.busy_since_ns = self._chore = None
        state = chore.state
        if state is None:
            self._cost_ns, self._snapshot_ns = max(ended_ns - started_ns, 0), ended_ns
            if failed:
                self._failed(failed)
            else:
                self._send_state(chore, data)
            return
        if not failed and state.key == self._restored_at:
            self._follows = True
            self._replay.clear()
            self._replay.extend(job for job in self._forked if job.order > self.state_at)
        who = state.number, self.task, self.place.node
        self._restored = Restored(*who, *state.key, failed)
        if failed:
            self._say_restored()

    def _say_restored(self) -> None:
        if self._restored is not None:
            self.place.put(self.place.keys.restored(), self._restored)
            self._restored = None

    def _send_state(self, chore: Chore, data: bytes) -> None:
        place = self.place
        run, cycle = (max(part, 0) for part in self.state_at)
        if len(data) > (longest := longest_bytes(self._state_bytes)):
            self._failed(_too_long(f"its state of {len(data)}", longest, "state_bytes"))
            return
        state = State(run, cycle, self.task, place.node, chore.number, self._cost_ns)
        header, lane = encode(state), lane_of(self._state_bytes)
        for node in chore.to:
            key = place.keys.state(self.task, node, place.node)
            place.transport.put(key, data, header, lane=lane)

    def _take_over(self, state: State, data: bytes) -> str:
        """Restore a state; return the error, or an empty string."""
        if not self.stage.stateful:
            return f"{self.task} has no restore()"
        try:
            self.stage.restore(data)
        except Exception as error:  # the user's code
            self._failed(f"restore() failed ({type(error).__name__}: {error})")
            return self.trouble
        self.state_at = self._restored_at = state.key
        return ""

    def _recover(self, job: Job) -> int:
        """Restore the last checkpoint if it is newer than this state; return its age in cycles."""
        if not self._checkpoints:
            return UNKNOWN
        kept, self._checkpoints = self._checkpoints.values(), {}
        # This job can only continue a checkpoint of an earlier cycle of its run.
        past = (max(self.state_at, (job.header.stamp.run, -1)), job.order)
        fit = [(state, data) for state, data in kept if past[0] < state.key < past[1]]
        if not fit:
            return UNKNOWN
        state, data = max(fit, key=lambda one: one[0].key)
        if self._take_over(state, data):
            return UNKNOWN
        return job.header.stamp.cycle - state.cycle

    @property
    def _checkpoint_nodes(self) -> tuple[str, ...]:
        """Other nodes on which fallbacks run this task; they get checkpoints."""
        problem = self.place.problem
        if not (self._stateful and problem.live.checkpoint_cycles):
            return ()
        nodes = {problem.candidates[name][self.task] for name in problem.controller.fallbacks}
        return tuple(sorted(nodes - {self.place.node}))

    @property
    def _too_slow(self) -> bool:
        """Whether a checkpoint takes so long that the guard would move the cell."""
        return self._cost_ns > self.place.problem.guard_patience_ns

    def _plan_checkpoint(self, job: Job, now_ns: int) -> None:
        """Plan a checkpoint every `checkpoint_cycles`, if they use at most 1/20 of the time."""
        nodes = self._checkpoint_nodes
        if not nodes or job.header.stamp.cycle % self.place.problem.live.checkpoint_cycles:
            return
        rests = 0 <= now_ns - self._snapshot_ns < CHECKPOINT_SPACING * self._cost_ns
        if not (rests or self._too_slow):
            self._checkpoint_to = nodes

    # --------------------------------------------------------------------------- jobs

    @property
    def active(self) -> bool:
        """Whether it runs jobs: it is no standby, or its primary is silent or not ready."""
        if not self.stands_by:
            return True
        detector = self.pulse.detector
        self.pulse.own(self.stands_by, self._now_ns)
        beat = detector.last(self.stands_by)
        patience_ns = 2 * self.place.period_ns
        return not (
            beat and beat.ready and detector.fresh(self.stands_by, self._now_ns, patience_ns)
        )

    @property
    def warms_up(self) -> bool:
        """Whether its next job is a warm-up job; their times are not representative."""
        return self._warmup > 0

    def rest_s(self, now_ns: int) -> float:
        """Seconds after which a job may be due without a message."""
        # A standby must notice silence.
        rest_s = 0.01 if self.stands_by else 0.2
        if self._source is None:
            return rest_s
        return min(max((self._source.due_ns - now_ns) / 1e9, 0.0), rest_s)

    @property
    def has_work(self) -> bool:
        """Whether `next_chore` or `next_job` may return something."""
        waits = (
            self._jobs
            or self._replay
            or self._restored is not None
            or self._source is not None
            or self._asked is not None
            or self._restoring is not None
            or self._checkpoint_to
        )
        return bool(waits) and self.busy_since_ns is None

    def next_job(self, now_ns: int) -> Job | None:
        """Return the job to run now, or None; `run` and `finish` must follow."""
        self._now_ns = now_ns
        if self.busy_since_ns is not None or not self.started:
            return None
        if self._source is not None and (job := self._source.due(now_ns)) is not None:
            self._jobs.append(job)
        if self._replay:
            return self._taken(self._replay.popleft(), now_ns)
        self._say_restored()
        while self._jobs and not self._jobs[0].shadow and self._jobs[0].order <= self._restored_at:
            # The restored state already contains this job.
            self._replace(self._jobs.popleft())
        if not self.active:
            horizon_ns = now_ns - 2 * self.place.period_ns
            while self._jobs and self._jobs[0].arrived_ns < horizon_ns:
                self._jobs.popleft()
            return None
        if not self._jobs:
            return None
        return self._taken(self._jobs.popleft(), now_ns)

    def _taken(self, job: Job, now_ns: int) -> Job:
        self.busy_since_ns = now_ns
        self._busy_cycle = job.header.stamp.cycle
        if not job.shadow:
            self.book.ended(job.headers, TAKEN)
        return job

    def retry(self, shadow: bool, inputs: list[tuple[Header, bytes]], now_ns: int) -> None:
        """Put a job that another process has not finished at the head of the queue."""
        if inputs:
            by_source = {header.source: (header, data, now_ns) for header, data in inputs}
            self._jobs.appendleft(Job(inputs[0][0], by_source, shadow))

    def run(self, job: Job, started_ns: int) -> tuple[Message | None, int]:
        """Call the stage; return its output (None if it failed) and the age of its checkpoint.

        The hop of the job gets the CPU time of the call and of reading its inputs: the time of this
        thread, or of the process if the cell gives the task several threads on this node. It
        also gets the CPU time of other processes during the call, if the kernel counts it.
        """
        before, begun_ns = self.group_clock(), self.cpu_clock()
        stamp = job.header.stamp
        self._counted = NOT_COUNTED
        state_age = self._recover(job) if self._stateful else UNKNOWN
        released_ns, _ = self.offsets.from_reference(self.place.node, stamp.released_ns)
        try:
            inputs = {
                source: Message(
                    read_payload(header.kind, payload, self.stage.inputs.get(source)),
                    stamp.cycle,
                    released_ns,
                    (started_ns - released_ns) / 1e6,
                )
                for source, (header, payload, _) in job.inputs.items()
            }
            try:
                output = self.stage.process(inputs)
            except Exception as error:  # the user's code
                raise LiveError(f"process() raised {type(error).__name__}: {error}") from error
            after = self.group_clock()
            self._counted = before, max(self.cpu_clock() - begun_ns, 0), after
            if not isinstance(output, Message):
                what = type(output).__name__
                raise LiveError(f"process() returned a {what}, not a Message")
        except LiveError as error:
            self._failed(f"cycle {stamp.cycle}: {error}")
            return None, state_age
        return output, state_age

    def finish(
        self, job: Job, output: Message | None, started_ns: int, ended_ns: int, state_age: int = -1
    ) -> None:
        """Send a job's output to the destinations of its stamp."""
        self.busy_since_ns = None
        self.state_at = max(self.state_at, job.order)
        place, stamp = self.place, job.header.stamp
        if warmup := self.warms_up:
            self._warmup -= 1
        elif not job.shadow:
            self.book.ran(stamp, ended_ns - started_ns)
        runs_here = self.routes.runs(self.task, place.node, stamp)
        if runs_here and self._stateful:
            self._worked_at = max(self._worked_at, job.order)
            self._follows = False
            self._awaited = None
            self._forked.clear()
        # Counts as failed until there is an output to send.
        self._failed_in_a_row, self._failed_ns = self._failed_in_a_row + 1, ended_ns
        if output is None:
            return
        try:
            kind, data = write_payload(output.payload)
            destinations = self.routes.destinations(self.task, stamp, shadow=job.shadow)
        except LiveError as error:
            self._failed(f"cycle {stamp.cycle}: {error}")
            return
        self.trouble, self._failed_in_a_row = "", 0
        inputs = tuple((source, at_ns) for source, (_, _, at_ns) in job.inputs.items())
        times = job.arrived_ns, started_ns, ended_ns
        before, cpu_ns, after = self._counted
        spent = cpu_ns, after.others_since(before)
        group_ns = before.group_ns, after.group_ns
        stamp_ns, here = output.stamp_ns, (self.task, place.node)
        hop = Hop(*here, *times, inputs, state_age, *spent, group_ns, warmup, stamp_ns)
        seal, hops = job.header.seal, (*job.hops(), hop)
        header = Header(stamp, self.task, place.node, kind, hops, job.shadow, seal)
        head = encode(header)
        if self.is_sink:
            longest = longest_bytes(0)
            if len(data) > longest:
                reason = _too_long(f"its command of {len(data)}", longest)
                self._failed(f"cycle {stamp.cycle}: {reason}")
            elif runs_here or not self._stateful:
                place.transport.put(place.keys.command(self.task), data, head)
        elif job.shadow or runs_here:
            for target, node, to in destinations:
                declared = self._output_bytes[target]
                longest = longest_bytes(declared)
                if len(data) > longest:
                    reason = _too_long(f"its output of {len(data)}", longest, "the flow's bytes")
                    self._failed(f"cycle {stamp.cycle}: {reason}")
                    continue
                key = place.keys.inputs(target, node, to)
                place.transport.put(key, data, head, lane=lane_of(declared))
                if to == MAIN:
                    self.book.sent(stamp, f"{target}@{node}", len(data))
            self._plan_checkpoint(job, ended_ns)

    def framed(self, now_ns: int) -> None:
        """Request a cycle from the stamper, because the source has a frame."""
        self._framed_ns = now_ns
        self.place.transport.put(self.place.keys.frame(), b"")

    def no_frame(self, error: Exception) -> None:
        """Record that waiting for a frame has failed."""
        known = isinstance(error, LiveError)
        self._failed(str(error) if known else f"wait() raised {type(error).__name__}: {error}")

    def _failed(self, what: str) -> None:
        self.trouble = f"{self.task} on {self.place.node}: {what}"
        self.failures += 1
        self.place.complain(LiveError(self.trouble))

    # -------------------------------------------------------------------------- beats

    def _state(self) -> tuple[bool, str]:
        where = f"{self.task} on {self.place.node}"
        limit_ns = self.place.hang_ns
        if self.busy_since_ns is not None:
            busy_ns, chore = self._now_ns - self.busy_since_ns, self._chore
            call = f"cycle {self._busy_cycle}: process()" if chore is None else chore.call
            if busy_ns > (limit_ns if chore is None else MOVING_NS):
                since_s = busy_ns / 1e9
                return False, f"{where}: {call} has not returned for {since_s:.0f} s"
        if not self.started:
            return False, self.trouble or f"{where}: start() has not returned yet"
        count = self._failed_in_a_row
        recent = self._now_ns < self._failed_ns + EVIDENCE_NS
        if recent and count >= self.place.problem.controller.failures_in_a_row:
            return False, f"{self.trouble}, {count} calls in a row"
        report = self.stage.report()
        if not report.ready:
            return False, f"{where}: {report.note}"
        if self.triggers and self._framed_ns is None:
            self._framed_ns = self._now_ns
        if self._framed_ns is not None and self._now_ns - self._framed_ns > limit_ns:
            silent_s = (self._now_ns - self._framed_ns) / 1e9
            return (
                True,
                self.trouble or f"{where}: wait() has brought no frame for {silent_s:.0f} s",
            )
        return True, self.trouble or report.note or self._without_checkpoints()

    def _without_checkpoints(self) -> str:
        if not (self._too_slow and self._checkpoint_nodes):
            return ""
        cost_s, period_ms = self._cost_ns / 1e9, self.place.period_ns / 1e6
        call = f"{self.task}@{self.place.node}'s snapshot()"
        return f"no checkpoints: {call} takes {cost_s:.2g} s of a period of {period_ms:g} ms"

    def _moves(self) -> BeatState:
        """Return `moving`, set while a call of snapshot() or restore() for a migration runs."""
        since_ns, chore = self.busy_since_ns, self._chore
        called = chore is not None and chore.number > 0 and since_ns is not None
        moving = called and self._now_ns - (since_ns or 0) <= MOVING_NS
        topic = self.stage.report().topic
        return BeatState(moving=moving, rates=None if topic is None else Rates(*topic))

    def wake(self, now_ns: int) -> int:
        """Send the beat if it is due; return the instant of the next one."""
        self._now_ns = max(self._now_ns, now_ns)
        return self.pulse.wake(now_ns)


def _too_long(what: str, longest: int, declared: str = "") -> str:
    more = f"; raise {declared}, {SPARE} times which may be sent" if declared else ""
    return f"{what} bytes is not sent: at most {longest} are{more}"
