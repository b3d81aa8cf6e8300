"""Hosting: a role gets a thread, a clock and a transport, and becomes a process."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterable, Sequence

from dwell.errors import LiveError, describe_raised
from dwell.live.failures import end_process, start_thread
from dwell.live.host.security import Security
from dwell.live.roles.role import RoleLogic
from dwell.live.roles.worker import Job, Worker
from dwell.live.stage import Message
from dwell.live.wire.continuity import SetbackDetector
from dwell.live.wire.transport import Arrival, Transport
from dwell.model import Problem

Clock = Callable[[], int]

#: No role is left alone for longer, so that its thread notices that it shall stop.
LONGEST_SLEEP_S = 0.2


def clock_of(problem: Problem) -> Clock:
    """Return what all processes of a live cell read the time from.

    Where clocks are kept synchronous by others, that is the time of day; elsewhere a clock that
    nobody sets.
    """
    return time.time_ns if problem.live.clock == "system" else time.monotonic_ns


class Platform:
    """Clock and transport of the processes of a node; a testbed's has faults around both.

    Attributes
    ----------
    program : sequence of str
        Module, and its first arguments, that runs one process of a cell.
    """

    program: Sequence[str] = ("dwell.live.host.role_command",)

    def clock(self, problem: Problem, node: str) -> Clock:
        """Return what the processes of a node read the time from."""
        return clock_of(problem)

    def transport(self, security: Security, who: str, node: str) -> Transport:
        """Open the sessions of a process on a node.

        Raises
        ------
        LiveError
            If there is no such process, or a port is taken.
        """
        return security.transport(who)


#: As everybody's is, but for a testbed's.
PLAIN = Platform()


def keep_collections_short() -> None:
    """Spare the garbage collector what there is now: modules, settings, sessions.

    It stops all threads while it looks at everything, for 15 ms after the imports alone.
    """
    gc.collect()
    gc.freeze()


class Hosted:
    """A role on a transport: called by one thread at a time, and woken when something is due.

    Parameters
    ----------
    clock : callable
        The node's clock, nanoseconds.
    heard : callable, optional
        Called, outside the role, after every message; `news` is released where it says so.
    stopped : Event, optional
        Ends `run` within a fifth of a second.
    hurry : Event, optional
        Set when something is due sooner than was said; roles that take turns share one.
    complain : callable, optional
        Told of a message at which the role has failed; it goes on with the next one.
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
        """Have the role get what a transport brings."""
        for key in self.role.subscriptions():
            transport.subscribe(key, self._receive)

    def _receive(self, sample: Arrival) -> None:
        with self.lock:
            # Also where it has waited for the last that was done: nothing follows that.
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
        """Have the role take a message."""
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
        """Time until the role is due; negative where it is late."""
        now_ns = self.clock()
        if self._setback.back_ns(now_ns):
            # And what is due with it: nobody knows for how long.
            self._due_ns = now_ns
        return self._due_ns - now_ns

    def wake(self) -> None:
        """Have the role do what is due."""
        with self.lock:
            now_ns = self.clock()
            latest_ns = now_ns + round(LONGEST_SLEEP_S * 1e9)
            self._due_ns = min(self.role.wake(now_ns), latest_ns)

    def wake_now(self) -> None:
        """Have `run` wake the role at once; any thread may call it."""
        with self.lock:
            self._due_ns = min(self._due_ns, self.clock())
        self.hurry.set()

    def run(self) -> None:
        """Wake the role whenever it is due, until `stop`."""
        take_turns([self])

    def stop(self) -> None:
        """Have `run` return."""
        self.stopped.set()
        self.hurry.set()


def take_turns(all_hosted: Sequence[Hosted], each_turn: Iterable[Callable[[], None]] = ()) -> None:
    """Wake roles in this thread, always the one that is due first, until they are told to stop.

    Parameters
    ----------
    all_hosted : sequence of Hosted
        With the same `stopped` and the same `hurry`.
    each_turn : iterable of callable, optional
        Called before each role that is woken, and several times a second.
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
    """Run a worker's jobs in this thread until it is told to stop.

    Parameters
    ----------
    note : callable, optional
        Told what job begins, and None when it is over.
    begin : callable, optional
        Called before the stage is started, when the thread of the beats runs.
    ready : callable, optional
        Called when the stage has started.
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
    """Do all that there is to do."""
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
        note(None)


def _frames(worker: Worker, hosted: Hosted, stopped: threading.Event) -> None:
    """Ask the stamper for a cycle whenever the source has a frame."""
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
