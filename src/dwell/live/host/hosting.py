"""Hosting: runs a role in a process, with a thread, a clock and a transport."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterable, Sequence

from dwell.errors import LiveError, describe_raised
from dwell.live.failures import end_process, start_thread
from dwell.live.host.security import Security
from dwell.live.roles.joins import Job
from dwell.live.roles.role import RoleLogic
from dwell.live.roles.worker import Worker
from dwell.live.stage import Message
from dwell.live.wire.continuity import SetbackDetector
from dwell.live.wire.transport import Arrival, Transport
from dwell.model import Problem
from dwell.model.instants import NEVER_NS

Clock = Callable[[], int]

#: Longest sleep of a role's thread, which then checks whether it has to stop.
LONGEST_SLEEP_S = 0.2


def clock_of(problem: Problem) -> Clock:
    """Return the clock of all processes of a live cell.

    This is the time of day if the cell file states that the system synchronises it (`clock:
    system`), else the monotonic clock.
    """
    return time.time_ns if problem.live.clock == "system" else time.monotonic_ns


class Platform:
    """Clock and transport of the processes of a node; a testbed adds faults to both."""

    #: Module that runs one process of a cell, and its first arguments.
    program: Sequence[str] = ("dwell.live.host.role_command",)

    def clock(self, problem: Problem, node: str) -> Clock:
        """Return the clock of the processes of a node."""
        return clock_of(problem)

    def transport(self, security: Security, who: str, node: str) -> Transport:
        """Open the sessions of a process; raises a LiveError if a port is taken."""
        return security.transport(who)


#: Platform of all cells, except for those in a testbed.
PLAIN = Platform()


def keep_collections_short() -> None:
    """Exclude all present objects (modules, settings, sessions) from garbage collection.

    A full collection stops all threads: for 15 ms with the imported modules alone.
    """
    gc.collect()
    gc.freeze()


class Hosted:
    """A role with its transport: calls the role from one thread at a time, and when it is due.

    `heard` is called after each message, without the lock; if it returns true, `news` is released.
    `hurry` is set when a message makes the role due sooner; roles of one thread share it. If the
    role fails at a message, `complain` reports the error, and the role gets the next message.
    """

    def __init__(
        self,
        role: RoleLogic,
        transport: Transport,
        clock: Clock = time.monotonic_ns,
        heard: Callable[[], bool] | None = None,
        stopped: threading.Event | None = None,
        hurry: threading.Event | None = None,
        complain: Callable[[LiveError], None] | None = None,
    ) -> None:
        self.role, self.transport, self.clock = role, transport, clock
        self.lock = threading.Lock()
        self.stopped = stopped or threading.Event()
        self.hurry = hurry or threading.Event()
        self._heard, self._complain = heard, complain
        self.news = threading.Semaphore(0)
        self._due_ns = 0
        self._setback = SetbackDetector()
        self.hear_through(transport)

    def hear_through(self, transport: Transport) -> None:
        """Subscribe the role to its messages on a transport."""
        for key in self.role.subscriptions():
            transport.subscribe(key, self._receive)

    def _receive(self, sample: Arrival) -> None:
        with self.lock:
            # The role may have stopped while this thread waited for the lock.
            if self.stopped.is_set():
                return
            wanted_ns = self._taken(sample)
            sooner = wanted_ns is not None and wanted_ns < self._due_ns
            if sooner and wanted_ns is not None:
                self._due_ns = wanted_ns
        if sooner:
            self.hurry.set()
        if self._heard is not None and self._heard():
            self.news.release()

    def _taken(self, sample: Arrival) -> int | None:
        """Pass a message to the role; return when it is due, or None."""
        try:
            return self.role.receive(sample, self.clock())
        except KeyboardInterrupt:
            raise
        except Exception as error:
            if self._complain is None:
                raise
            self._complain(LiveError(f"a message under {sample.key}: {describe_raised(error)}"))
            return None
        except BaseException as error:  # an actuator that calls sys.exit(), a panic of Zenoh's
            end_process(f"a message under {sample.key}", error)

    def rest_ns(self) -> int:
        """Return the time until the role is due; negative if it is late."""
        now_ns = self.clock()
        if self._setback.back_ns(now_ns):
            # The clock was set back, so the due time may be far in the future.
            self._due_ns = now_ns
        return self._due_ns - now_ns

    def wake(self) -> None:
        """Wake the role, and note when it is due next."""
        with self.lock:
            now_ns = self.clock()
            latest_ns = now_ns + round(LONGEST_SLEEP_S * 1e9)
            self._due_ns = min(self.role.wake(now_ns), latest_ns)

    def wake_now(self) -> None:
        """Make the role due now, from any thread."""
        with self.lock:
            self._due_ns = min(self._due_ns, self.clock())
        self.hurry.set()

    def run(self) -> None:
        """Wake the role whenever it is due, until `stop`."""
        take_turns([self])

    def stop(self) -> None:
        """End `run`."""
        self.stopped.set()
        self.hurry.set()


def take_turns(all_hosted: Sequence[Hosted], each_turn: Iterable[Callable[[], None]] = ()) -> None:
    """Wake roles in this thread, earliest due time first, until `stopped` is set.

    All roles share one `stopped` and one `hurry`. The functions `each_turn` are called before each
    role, and at least five times per second.
    """
    stopped, hurry = all_hosted[0].stopped, all_hosted[0].hurry
    try:
        while not stopped.is_set():
            for step in each_turn:
                step()
            first = min(all_hosted, key=Hosted.rest_ns)
            rest_ns = first.rest_ns()
            if rest_ns > 0:
                hurry.wait(rest_ns / 1e9)
                hurry.clear()
            else:
                first.wake()
    finally:
        stopped.set()


def work(
    worker: Worker,
    transport: Transport,
    *,
    stopped: threading.Event,
    note: Callable[[Job | None], None] = lambda job: None,
    clock: Clock = time.monotonic_ns,
    begin: Callable[[], None] = lambda: None,
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Run a worker's jobs in this thread until `stopped` is set.

    `note` gets each job when it starts, and None when it ends. `begin` is called before the stage
    starts, while the worker already beats; `ready` is called after the stage has started.
    """
    complain = worker.place.complain
    hosted = Hosted(worker, transport, clock, heard=lambda: worker.has_work, complain=complain)
    start_thread("beats", hosted.run)
    stage = worker.stage
    begin()
    stage.start()
    with hosted.lock:
        worker.started = True
        worker.pulse.send(clock())
    ready()
    keep_collections_short()
    if worker.triggers:
        start_thread("frames", _frames, worker, hosted, stopped)
    try:
        while not stopped.is_set():
            _drain(worker, hosted, note, clock)
            hosted.news.acquire(timeout=worker.rest_s(clock()))
    finally:
        hosted.stop()
        stage.stop()


def _drain(
    worker: Worker, hosted: Hosted, note: Callable[[Job | None], None], clock: Clock
) -> None:
    """Run all chores and jobs that are due; chores first."""
    while True:
        with hosted.lock:
            chore = worker.next_chore(clock())
            job = None if chore is not None else worker.next_job(clock())
        if chore is not None:
            started_ns = clock()
            result = worker.do_chore(chore)
            with hosted.lock:
                worker.finish_chore(chore, *result, started_ns, clock())
            continue
        if job is None:
            return
        note(job)
        started_ns = clock()
        output: Message | None
        output, state_age = worker.run(job, started_ns)
        ended_ns = clock()
        with hosted.lock:
            worker.finish(job, output, started_ns, ended_ns, state_age)
        if worker.copies.due_ns < NEVER_NS:
            # The thread of the beats sends held messages while this thread runs a job.
            hosted.wake_now()
        note(None)


def _frames(worker: Worker, hosted: Hosted, stopped: threading.Event) -> None:
    """Request a cycle from the stamper for each frame of the source."""
    while not stopped.is_set():
        try:
            worker.stage.wait()
        except Exception as error:  # the user's code; a camera that fails shows in its beats
            with hosted.lock:
                worker.no_frame(error)
            stopped.wait(LONGEST_SLEEP_S)
            continue
        with hosted.lock:
            worker.framed(hosted.clock())
