"""Worker: joins a task's inputs, runs its stage, and sends the output as the stamp directs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial

from msgspec.structs import asdict

from dwell.errors import LiveError
from dwell.live.roles.control_group import UNKNOWN, Counts
from dwell.live.roles.joins import MAX_JOINS, Job, Joins
from dwell.live.roles.origins import cycles_of, joint_origins
from dwell.live.roles.replicated_cycles import ReplicatedCycles
from dwell.live.roles.role import BeatState, Pulse, RolePlace
from dwell.live.roles.sampled_inputs import SampledInputs
from dwell.live.roles.source_cycles import SourceCycles
from dwell.live.roles.stage_counts import DROPPED, REPLACED, TAKEN, StageBook
from dwell.live.roles.state_transfer import Chore, StateTransfer, too_long
from dwell.live.stage import CellStage, Message
from dwell.live.wire import channels
from dwell.live.wire.keys import MAIN, SHADOW
from dwell.live.wire.messages import (
    CANCELLED,
    LATE,
    SAMPLED,
    Completion,
    Header,
    Hop,
    Origin,
    RatedHop,
    Rates,
    Stamp,
    encode,
)
from dwell.live.wire.payloads import read_payload, write_payload
from dwell.live.wire.routing import STAMPER, Destination, Routes
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import lane_of, longest_bytes
from dwell.model.instants import EVIDENCE_NS, NEVER_NS

#: Periods between two beats of a shadow worker.
SHADOW_BEAT = 10
#: Longest time that a migration waits for a call of snapshot() or restore().
MOVING_NS = 10_000_000_000
NOT_COUNTED = Counts(), UNKNOWN, Counts()


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
        #: Declared bytes of inputs (by source) and outputs (by target), which determine the lanes
        #: and the longest payloads.
        self._input_bytes = {f.source: f.payload_bytes for f in problem.pipeline.inputs(task)}
        self._output_bytes = {f.target: f.payload_bytes for f in problem.pipeline.outputs(task)}
        #: Inputs that the task does not wait for.
        forwards = not (shadow or stands_by)
        self.samples = SampledInputs(place, task, forwards=forwards)
        waited = frozenset(self._input_bytes) - self.samples.sources
        sources = waited or frozenset([STAMPER])
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
        if not problem.pipeline.sink_rates[task]:
            # No deadline passes for a task that no sink waits for.
            overlap = MAX_JOINS * self.routes.due.rates[task]
        self._joins = {
            MAIN: Joins(sources, lambda headers: self.book.ended(headers, DROPPED), overlap),
            SHADOW: Joins(sources, lambda _: None, overlap),
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
        rate = self.routes.due.rates[task]

        def begins_ns(stamp: Stamp) -> int:
            return max(offset_ns, self.routes.begins_ns(task, place.node, stamp))

        self._source = (
            SourceCycles(place, self.offsets, rate, begins_ns, shadow=shadow)
            if STAMPER in sources
            else None
        )
        #: Cycles with two copies.
        self.copies = ReplicatedCycles(problem)
        # Whether chains and samples count the age of data from its cycles.
        chains = problem.pipeline.chains.values()
        firsts = {*self.routes.due.sources, *(chain.source for chain in chains)}
        self._is_origin = place.has_origins and task in firsts
        #: Time from one job to the next.
        self._interval_ns = rate * place.period_ns
        #: State of the stage, which moves with the task.
        self.transfer = StateTransfer(place, task, stage, self._failed, shadow=shadow)
        self.started = False
        self.trouble = ""
        self.busy_since_ns: int | None = None
        self._busy_cycle = 0
        self._chore: Chore | None = None
        self.replaced = 0
        # Number of calls of process() in a row without an output to send; end of the last one.
        self._failed_in_a_row, self._failed_ns = 0, 0
        self._now_ns = 0
        # Whether its standby may have used newer values than it has, after a silence, and the
        # instant until which it then leaves the jobs to its standby.
        has_standby = problem.pipeline.tasks[task].on[place.node].standby > 0
        self._yields = has_standby and bool(self.samples.sources) and forwards
        self._resumes_ns = -NEVER_NS
        # Sender of each link that the inputs may take. The stamper's beats compare the clocks.
        before = [
            (node, f"{source}@{node}")
            for source in self._input_bytes
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
            yield keys.of(channels.INPUT, self.task, node, SHADOW)
            return
        yield keys.of(channels.INPUT, self.task, node, MAIN)
        if self.is_sink or self.samples.sources:
            yield keys.of(channels.INPUT, self.task, node, SHADOW)
        if self.place.problem.replicas:
            yield keys.all(channels.DONE)
        yield from self.transfer.subscriptions()
        yield from self.samples.subscriptions()

    def receive(self, sample: Arrival, now_ns: int) -> None:
        """Process a message."""
        if self.pulse.hears(sample):
            self.pulse.receive(sample, now_ns)
            return
        kind = sample.key.rpartition("/")[2]
        if kind in (MAIN, SHADOW) and "/in/" in sample.key:
            self._input(sample, kind, now_ns)
            return
        try:
            match self.place.channel(sample):
                case channels.SNAPSHOT | channels.STATE:
                    self.transfer.receive(sample)
                case channels.STAMPED | channels.VALUE:
                    self.samples.receive(sample, now_ns)
                    if self._source is not None and self.samples.is_away:
                        self._source.leave()
                case channels.DONE:
                    done = self.place.completion(sample)
                    if self.copies.completed(done):
                        self._cancel(done.stamp.key)
        except LiveError as error:
            self.place.complain(error)

    def _input(self, sample: Arrival, kind: str, now_ns: int) -> None:
        header = self.place.header(sample)
        if header is None:
            return
        if header.stamp.term:  # not a source's guess
            self.transfer.stamped(header.stamp.key)
        if header.source == STAMPER and self._source is not None:
            # A worker that samples hears the stamps of shadows, too.
            if (kind == SHADOW) == self.shadow and not self.copies.is_done(header.stamp):
                self._source.stamped(header, now_ns)
            return
        sampled = header.source in self.samples.sources
        # The shadow worker takes what its jobs wait for; this worker reports the rest.
        if kind == SHADOW and sampled == self.shadow and not self.is_sink:
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
        if sampled:
            self._sample(header, sample.payload, kind, now_ns)
            return
        if kind == MAIN and self._is_late(header):
            self.book.ended([header], DROPPED)
            self._report(header, now_ns, LATE)
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
            self.transfer.fork(job)
        else:
            self._jobs.append(job)
            if len(self._jobs) > (self._depth or 10 * MAX_JOINS):
                # The oldest waiting job or the new job, whichever has the earlier cycle.
                overtaken = job.order < self._jobs[0].order
                self._replace(self._jobs.pop() if overtaken else self._jobs.popleft())

    def _sample(self, header: Header, payload: bytes, kind: str, now_ns: int) -> None:
        """Take a sampled message; report its arrival, with all jobs upstream of it."""
        outcome = "shadow"
        if kind == MAIN:
            outcome = SAMPLED
            is_newest = self.samples.take(header, payload, now_ns)
            self.book.ended([header], TAKEN if is_newest else DROPPED)
        if kind == SHADOW or self.routes.runs(self.task, self.place.node, header.stamp):
            self._report(header, now_ns, outcome)

    def _report(self, header: Header, now_ns: int, outcome: str) -> None:
        """Report the arrival of a message that begins no job, with all jobs upstream of it."""
        if not self.stands_by:
            self._end(Job(header, {header.source: (header, b"", now_ns)}, False), outcome)

    def _is_late(self, header: Header) -> bool:
        """Whether a message is late: its cycle is done, or the other copy's message came first."""
        stamp, copies = header.stamp, self.copies
        return copies.has_copies(stamp) and (
            copies.is_done(stamp) or self._joins[MAIN].is_late(header)
        )

    def _cancel(self, cycle: tuple[int, int]) -> None:
        """Drop what waits in a cycle with two copies that is done."""
        jobs = [job for job in self._jobs if job.order == cycle and not job.shadow]
        for job in jobs:
            self._jobs.remove(job)
        waiting = self._joins[MAIN].cancel(cycle)
        jobs += [Job(header, waiting, False) for header, _, _ in [*waiting.values()][:1]]
        for job in jobs:
            self.book.ended(job.headers, DROPPED)
            if not self.stands_by:
                self._end(job, CANCELLED)
        if self._source is not None:
            self._source.cancel(cycle)

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
        place.send(channels.ENDED, ended)

    # -------------------------------------------------------------------------- state

    def _is_forked(self, job: Job) -> bool:
        """Whether a job was sent here only because the state will move here."""
        runs_here = self.routes.runs(self.task, self.place.node, job.header.stamp)
        return self.transfer.stateful and not runs_here and not job.shadow

    def next_chore(self, now_ns: int) -> Chore | None:
        """Return the chore before the next job; `do_chore` and `finish_chore` must follow."""
        if self.busy_since_ns is not None or not self.started:
            return None
        chore = self.transfer.next_chore()
        if chore is not None:
            self._chore, self.busy_since_ns, self._now_ns = chore, now_ns, now_ns
            if chore.number:
                # The beat announces the pause, which the guard must not count as a fault.
                self.pulse.send(now_ns)
        return chore

    def do_chore(self, chore: Chore) -> tuple[bytes, str]:
        """Call the stage; return the snapshot, and the error or an empty string."""
        return self.transfer.call(chore)

    def finish_chore(
        self, chore: Chore, data: bytes, failed: str, started_ns: int, ended_ns: int
    ) -> None:
        """Send the snapshot, or queue the forked jobs that follow a restored state."""
        self.busy_since_ns = self._chore = None
        self.transfer.finish(chore, data, failed, started_ns, ended_ns)

    # --------------------------------------------------------------------------- jobs

    @property
    def active(self) -> bool:
        """Whether it runs jobs: it is no standby, or its primary is silent or not ready."""
        if not self.stands_by:
            return self._now_ns >= self._resumes_ns
        detector = self.pulse.detector
        self.pulse.own(self.stands_by, self._now_ns)
        beat = detector.last(self.stands_by)
        return not (
            beat and beat.ready and detector.fresh(self.stands_by, self._now_ns, self._patience_ns)
        )

    @property
    def _patience_ns(self) -> int:
        """Silence after which a standby takes over."""
        return 2 * self.place.period_ns

    def _follow(self, now_ns: int) -> None:
        """After a silence, leave the jobs that have waited to the standby."""
        if self._yields and 0 < self._now_ns < now_ns - self._patience_ns:
            self._resumes_ns = now_ns + 3 * self._interval_ns
        elif -NEVER_NS < self._resumes_ns <= now_ns:
            # Newer messages than those that have waited may be lost.
            self._resumes_ns = -NEVER_NS
            self.samples.forget()

    @property
    def warms_up(self) -> bool:
        """Whether its next job is a warm-up job; their times are not representative."""
        return self._warmup > 0

    def rest_s(self, now_ns: int) -> float:
        """Seconds after which a job may be due without a message."""
        # A standby must notice silence.
        rest_s = 0.2 if not self.stands_by and self.active else 0.01
        due_ns = self.copies.due_ns if self._source is None else self._source.due_ns
        return min(max((min(due_ns, self.copies.due_ns) - now_ns) / 1e9, 0.0), rest_s)

    @property
    def has_work(self) -> bool:
        """Whether `next_chore` or `next_job` may return something."""
        holds = self.copies.due_ns < NEVER_NS
        waits = self._jobs or self._source is not None or self.transfer.pending or holds
        return bool(waits) and self.busy_since_ns is None

    def next_job(self, now_ns: int) -> Job | None:
        """Return the job to run now, or None; `run` and `finish` must follow."""
        self._follow(now_ns)
        self._now_ns = now_ns
        self.copies.send_due(now_ns)
        if self.busy_since_ns is not None or not self.started:
            return None
        if self._source is not None and (job := self._source.due(now_ns)) is not None:
            self._jobs.append(job)
        if self.transfer.replay:
            return self._taken(self.transfer.replay.popleft(), now_ns)
        self.transfer.report()
        restored_at = self.transfer.restored_at
        while self._jobs and not self._jobs[0].shadow and self._jobs[0].order <= restored_at:
            # The restored state already contains this job.
            self._replace(self._jobs.popleft())
        if not self.active:
            horizon_ns = now_ns - 2 * self._interval_ns
            while self._jobs and self._jobs[0].arrived_ns < horizon_ns:
                self._jobs.popleft()
            return None
        if not self._jobs:
            return None
        return self._taken(self._jobs.popleft(), now_ns)

    def _taken(self, job: Job, now_ns: int) -> Job:
        self.busy_since_ns = now_ns
        self._busy_cycle = job.header.stamp.cycle
        if not (job.shadow or job.values):
            job.values = self.samples.newest(job.header.stamp)
        if not job.shadow:
            self.book.ended(job.headers, TAKEN)
        return job

    def retry(self, shadow: bool, inputs: list[tuple[Header, bytes]], now_ns: int) -> None:
        """Put a job that another process has not finished at the head of the queue."""
        if inputs:
            given = {header.source: (header, data, now_ns) for header, data in inputs}
            values = {name: one for name, one in given.items() if name in self.samples.sources}
            waited = {name: one for name, one in given.items() if name not in values}
            self._jobs.appendleft(Job(inputs[0][0], waited, shadow, values))

    def run(self, job: Job, started_ns: int) -> tuple[Message | None, int]:
        """Call the stage; return its output (None if it failed) and the age of its checkpoint.

        The hop of the job gets the CPU time of the call and of reading its inputs: the time of this
        thread, or of the process if the cell gives the task several threads on this node. It
        also gets the CPU time of other processes during the call, if the kernel counts it.
        """
        before, begun_ns = self.group_clock(), self.cpu_clock()
        stamp = job.header.stamp
        self._counted = NOT_COUNTED
        state_age = self.transfer.recover(job) if self.transfer.stateful else UNKNOWN
        try:
            inputs = {
                source: self._message(source, header, payload, started_ns)
                for source, (header, payload, _) in (*job.inputs.items(), *job.values.items())
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

    def _message(self, source: str, header: Header, payload: bytes, started_ns: int) -> Message:
        """Return an input of a stage that is called at `started_ns`."""
        stamp = header.stamp
        released_ns, _ = self.offsets.from_reference(self.place.node, stamp.released_ns)
        data = read_payload(header.kind, payload, self.stage.inputs.get(source))
        age_ms = (started_ns - released_ns) / 1e6
        return Message(data, stamp.cycle, released_ns, age_ms, origins=cycles_of(header))

    def finish(
        self, job: Job, output: Message | None, started_ns: int, ended_ns: int, state_age: int = -1
    ) -> None:
        """Send a job's output to the destinations of its stamp."""
        self.busy_since_ns = None
        self.transfer.at = max(self.transfer.at, job.order)
        place, stamp = self.place, job.header.stamp
        if warmup := self.warms_up:
            self._warmup -= 1
        elif not job.shadow:
            self.book.ran(stamp, ended_ns - started_ns)
        runs_here = self.routes.runs(self.task, place.node, stamp)
        if runs_here and self.transfer.stateful:
            self.transfer.worked(job)
        # Counts as failed until there is an output to send.
        self._failed_in_a_row, self._failed_ns = self._failed_in_a_row + 1, ended_ns
        if output is None:
            return
        try:
            kind, data = write_payload(output.payload)
            routes, node = self.routes, place.node
            destinations = routes.destinations(self.task, stamp, node, shadow=job.shadow)
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
        if place.has_origins:
            hop = RatedHop(**asdict(hop), origins=self._origins(job))
        seal, hops = job.header.seal, (*job.hops(), hop)
        header = Header(stamp, self.task, place.node, kind, hops, job.shadow, seal)
        head = encode(header)
        if self.is_sink:
            longest = longest_bytes(0)
            if len(data) > longest:
                reason = too_long(f"its command of {len(data)}", longest)
                self._failed(f"cycle {stamp.cycle}: {reason}")
            elif runs_here or not self.transfer.stateful:
                place.transport.put(place.keys.of(channels.COMMAND, self.task), data, head)
        elif job.shadow or runs_here:
            if not job.shadow and self.copies.is_done(stamp):
                destinations = ()
            if not (job.shadow or destinations):
                # No message tells of this job.
                ended = Completion(stamp, self.task, ended_ns, CANCELLED, hops, place.node)
                place.send(channels.ENDED, ended)
            for target in destinations:
                self._send(target, stamp, data, head, ended_ns)
            self.transfer.plan_checkpoint(job, ended_ns)

    def _send(
        self, to: Destination, stamp: Stamp, data: bytes | memoryview, head: bytes, now_ns: int
    ) -> None:
        """Send an output to a worker, now or when its hold ends."""
        declared, place = self._output_bytes[to.task], self.place
        longest = longest_bytes(declared)
        if len(data) > longest:
            reason = too_long(f"its output of {len(data)}", longest, "the flow's bytes")
            self._failed(f"cycle {stamp.cycle}: {reason}")
            return

        def put(payload: bytes | memoryview) -> None:
            key = place.keys.of(channels.INPUT, to.task, to.node, to.kind)
            place.transport.put(key, payload, head, lane=lane_of(declared))
            if to.kind == MAIN:
                self.book.sent(stamp, f"{to.task}@{to.node}", len(payload))

        released_ns, _ = self.offsets.from_reference(place.node, stamp.released_ns)
        due_ns = released_ns + to.after_ns
        if to.after_ns and due_ns > now_ns:
            # The stage may use its memory again.
            self.copies.hold(stamp, due_ns, partial(put, bytes(data)))
        else:
            put(data)

    def _origins(self, job: Job) -> tuple[Origin, ...]:
        """Return the cycles from which a job descends."""
        headers = (header for header, _, _ in (*job.inputs.values(), *job.values.values()))
        origins, stamp = joint_origins(headers), job.header.stamp
        if self._is_origin:
            origins[self.task] = Origin(self.task, stamp.cycle, stamp.released_ns, stamp.cycle)
        return tuple(origins.values())

    def framed(self, now_ns: int) -> None:
        """Request a cycle from the stamper, because the source has a frame."""
        self._framed_ns = now_ns
        self.place.transport.put(self.place.keys.of(channels.FRAME), b"")

    def no_frame(self, error: Exception) -> None:
        """Record that waiting for a frame has failed."""
        known = isinstance(error, LiveError)
        self._failed(str(error) if known else f"wait() raised {type(error).__name__}: {error}")

    def _failed(self, what: str) -> str:
        """Report a failure of the stage; return its text."""
        self.trouble = f"{self.task} on {self.place.node}: {what}"
        self.place.complain(LiveError(self.trouble))
        return self.trouble

    # -------------------------------------------------------------------------- beats

    def _state(self) -> tuple[bool, str]:
        where = f"{self.task} on {self.place.node}"
        limit_ns = max(self.place.hang_ns, 10 * self._interval_ns)
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
        return True, self.trouble or report.note or self.transfer.note()

    def _moves(self) -> BeatState:
        """Return `moving`, set while a call of snapshot() or restore() for a migration runs."""
        since_ns, chore = self.busy_since_ns, self._chore
        called = chore is not None and chore.number > 0 and since_ns is not None
        moving = called and self._now_ns - (since_ns or 0) <= MOVING_NS
        topic = self.stage.report().topic
        return BeatState(moving=moving, rates=None if topic is None else Rates(*topic))

    def wake(self, now_ns: int) -> int:
        """Send the beat and the held messages that are due; return when to call again."""
        self._follow(now_ns)
        self._now_ns = max(self._now_ns, now_ns)
        self.copies.send_due(now_ns)
        if now_ns < self._resumes_ns:
            # Without a beat its standby continues.
            return self._resumes_ns
        return min(self.pulse.wake(now_ns), self.copies.due_ns)
