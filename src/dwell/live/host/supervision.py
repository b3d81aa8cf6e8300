"""Supervision: keeps the processes of a node running, and finds the causes of their deaths."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import psutil

from dwell.errors import LiveError
from dwell.files import write_whole
from dwell.live.host.launcher import UNKNOWN_CODE, ForkServer, Running, Survivor
from dwell.live.host.process_ends import ProcessEnds
from dwell.live.host.process_group import ProcessGroup, end_processes
from dwell.live.host.state_files import InFlight, make_folder, open_own
from dwell.live.log import printable

#: Shortest and longest wait before a restart of a process that keeps dying.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.05, 5.0
#: Time for a clean end of processes; an actuator may take two seconds.
STOP_S = 3.5
#: Longest wait for a restarted process to be ready, before the next process is restarted.
TURN_S = 30.0
#: Lifetime after which a process has recovered.
HEALTHY_S = 10.0
#: Number of deaths at one message after which the message is quarantined.
POISONOUS = 2
#: Warm-up time of a process. Its memory is reported if it has since grown by more than this number
#: of bytes, and to more than twice its size after the warm-up.
WARM_S, GROWTH_BYTES = 30.0, 128 << 20
#: Least increase of the largest memory of a process that counts as growth.
GROWS_BYTES = 1 << 20
#: Time for which notes repeat a death for lack of memory, a quarantined message, or a growth of
#: memory.
TOLD_S = 60.0
#: Number of consecutive deaths of a process from which its agent is not ready.
MOST_TRIES = 10
#: Cause of death of a process that a previous agent has started: unknown.
ENDED = "has ended"
#: File with the kernel's count of processes killed for lack of memory, and its key.
EVENTS, OOM_KILL = Path("/proc/vmstat"), "oom_kill"
#: Largest size of a log; a longer log replaces the older log.
LOG_BYTES = 8 << 20


@dataclass(slots=True)
class SupervisedProcess:
    """A supervised process, with its deaths and its memory."""

    who: str
    command: Sequence[str]
    folder: Path
    process: Running | None = None
    starts: int = 0
    failures: int = 0
    started_s: float = 0.0
    next_s: float = 0.0
    note: str = ""
    deaths: Counter[str] = field(default_factory=Counter)
    #: Note that is reported for `TOLD_S`, even if the process runs again, and its time.
    told: str = ""
    told_s: float = -math.inf
    #: Offset in the log at which the output of the present process begins.
    log_begins: int = 0
    group: ProcessGroup | None = None
    #: Number of helper processes that have outlived the process and still run.
    helpers: int = 0
    has_bytes: int = 0
    watched: psutil.Process | None = None
    warm_bytes: int | None = None
    #: Largest memory so far, its time, and the note about its growth.
    peak_bytes: int = 0
    peak_s: float = -math.inf
    growth: str = ""

    @property
    def pid(self) -> int | None:
        """Id of the running process; None if it has ended."""
        return self.process.pid if self.process is not None else None

    @property
    def ails(self) -> bool:
        """Whether the process has died more than once, and has not recovered since."""
        lives_s = time.monotonic() - self.started_s if self.process is not None else 0.0
        return self.failures > 1 and lives_s < HEALTHY_S

    def file(self, kind: str) -> Path:
        """Return a file of the process by its suffix.

        ``log`` has its output, ``inflight`` the inputs of its present job, ``pid`` its process
        group for the next agent, and ``again`` the inputs of a job that the next worker runs first.
        ``ready`` exists when the process can work.
        """
        return self.folder / f"{self.who}.{kind}"


class Supervisor:
    """Starts processes, restarts them when they die, and adopts processes of a previous agent.

    `folder` is the node's state folder; `say` writes a line to the agent's log. See `WARM_S`,
    `GROWTH_BYTES` and `LOG_BYTES` for the other parameters.
    """

    def __init__(
        self,
        folder: Path,
        say: Callable[[str], None],
        launcher: ForkServer,
        *,
        warm_s: float = WARM_S,
        growth_bytes: int = GROWTH_BYTES,
        log_bytes: int = LOG_BYTES,
    ) -> None:
        self.folder = folder
        self._warm_s, self._growth_bytes, self._log_bytes = warm_s, growth_bytes, log_bytes
        self.children: list[SupervisedProcess] = []
        self.ends = ProcessEnds()
        self._say = say
        self._oom_kills = _oom_kills()
        self._launcher = launcher
        # Processes to restart (the next is the last of the list), and the process that is being
        # restarted, with the time and its number of starts before.
        self._turns: list[SupervisedProcess] = []
        self._turn: tuple[SupervisedProcess, float, int] | None = None
        # Note about a removed state folder, and its time.
        self._lost, self._lost_s = "", -math.inf

    def keep(self, who: str, command: Sequence[str]) -> SupervisedProcess:
        """Add a process to keep running."""
        child = SupervisedProcess(who, command, self.folder)
        child.group = marked_group(child.file("pid"))
        if not self._adopts(child):
            self._end_group(child)
        self.children.append(child)
        return child

    def _adopts(self, child: SupervisedProcess) -> bool:
        """Supervise a running process of a previous agent; return whether one exists."""
        if (process := survivor(child.file("pid"))) is None:
            return False
        child.process, child.group = Survivor(process.pid), marked_group(child.file("pid"))
        self.ends.watch(process.pid)
        self._say(f"{child.who}: goes on (process {process.pid})")
        child.started_s = time.monotonic()
        return True

    def _end_group(self, child: SupervisedProcess) -> bool:
        """Kill the helpers of a dead process; return whether all have ended."""
        left = 0 if child.group is None else child.group.kill()
        if left > child.helpers:
            self._say(f"{child.who}: {left} of its helpers have outlived it, and are ended")
        child.helpers = left
        if not left:
            child.group = None
        return not left

    def step(self) -> None:
        """Check each process once, and start the missing processes."""
        ready = self._launcher.ready()
        for child in self.children:
            if self._alive(child) or not self._end_group(child):
                continue
            if ready and time.monotonic() >= child.next_s and not self._adopts(child):
                self._start(child)

        self._take_turn()

    @property
    def pending(self) -> bool:
        """Whether `step` is due soon, because a process has ended or waits for its start."""
        pids = [child.pid for child in self.children]
        return self.restarting or None in pids or self.ends.pending(pids)

    @property
    def restarting(self) -> bool:
        """Whether processes are being restarted in turn."""
        return self._turn is not None or bool(self._turns)

    def restart_in_turn(self) -> None:
        """Restart all processes one by one, each after the previous process is ready.

        The order is the reverse of `children`: workers before sinks, and the stamper last.
        """
        self._turns = list(self.children)

    def _take_turn(self) -> None:
        now_s = time.monotonic()
        if self._turn is not None:
            child, since_s, starts = self._turn
            if child.starts == starts and child.pid is not None and now_s > since_s + STOP_S:
                _send(child.pid, signal.SIGKILL)
            ready = child.starts > starts and child.file("ready").exists()
            if not ready and now_s < since_s + TURN_S:
                return
            self._turn = None
        if self._turns:
            child = self._turns.pop()
            self._turn = child, now_s, child.starts
            child.failures = 0
            self._say(f"{child.who}: is restarted")
            if child.pid is not None:
                for number in (signal.SIGTERM, signal.SIGCONT):
                    _send(child.pid, number)

    def _alive(self, child: SupervisedProcess) -> bool:
        if child.process is None:
            return False
        code = child.process.poll()
        if code is not None:
            self.ends.forget(child.process.pid)
            child.process = None
            self._died(child, _reason(code))
        return code is None

    def _died(self, child: SupervisedProcess, reason: str) -> None:
        now_s = time.monotonic()
        lived_s = now_s - child.started_s
        last = _last_line(child.file("log"), child.log_begins)
        if starved := self._starved(child, reason, last):
            reason = starved
            child.told, child.told_s = f"{child.who} {starved}", now_s
        child.failures = 1 if lived_s > HEALTHY_S else child.failures + 1
        wait_s = min(FIRST_WAIT_S * 2 ** (child.failures - 1), LONGEST_WAIT_S)
        child.next_s = now_s + (wait_s if child.failures > 1 else 0.0)
        child.note = f"{child.who} {reason}{f': {last}' if last else ''}"
        again = f"; start {child.starts + 1} in {wait_s:.1f} s" if child.failures > 1 else ""
        self._say(f"{child.note}{again}")
        try:
            self._hand_on_suspect(child, reason)
        except OSError as error:
            self._say(f"{child.who}: what it died of cannot be kept ({error.strerror})")

    def _starved(self, child: SupervisedProcess, reason: str, last: str) -> str:
        """Return how a process died for lack of memory; empty for other causes.

        The kernel's count of processes killed for lack of memory includes the whole machine.
        """
        killed = self._oom_kills < (kills := _oom_kills())
        self._oom_kills = kills
        had = f"; it had {child.has_bytes >> 20} MB" if child.has_bytes else ""
        if killed and reason in (_reason(-signal.SIGKILL), ENDED):
            return f"was killed by the kernel, which had no memory left{had}"
        if "MemoryError" in last:
            return f"{reason} for want of memory{had}"
        return ""

    def _hand_on_suspect(self, child: SupervisedProcess, reason: str) -> None:
        """Pass the inputs at which a worker died to the next worker, or quarantine them."""
        content = InFlight.read(child.file("inflight"))
        again = child.file("again")
        again.unlink(missing_ok=True)
        if content is None:
            return
        child.file("inflight").unlink(missing_ok=True)
        name = hashlib.sha256(content).hexdigest()[:16]
        child.deaths[name] += 1
        if child.deaths[name] < POISONOUS:
            again.write_bytes(content)
            return
        quarantine = child.folder / "quarantine"
        quarantine.mkdir(exist_ok=True)
        kept = quarantine / f"{child.who}-{name}.bin"
        kept.write_bytes(content)
        child.note = f"{child.who}: a message has killed it twice ({reason}); it is kept in {kept}"
        child.told, child.told_s = child.note, time.monotonic()
        self._say(child.note)

    def _start(self, child: SupervisedProcess) -> None:
        """Start a process; a full disk must not end the agent, and so the node."""
        child.starts += 1
        child.started_s = time.monotonic()
        with suppress(OSError):
            child.file("ready").unlink(missing_ok=True)
        try:
            with open(child.file("log"), "ab", opener=open_own) as log:
                child.log_begins = log.tell()
                child.process = self._launcher.start(child.command, log)
                child.group = ProcessGroup.of(child.process.pid)
                self.ends.watch(child.process.pid)
        except OSError as error:
            self._died(child, f"could not be started ({error.strerror})")
            return
        child.warm_bytes, child.peak_bytes, child.growth = None, 0, ""
        self._write_mark(child)

    def _write_mark(self, child: SupervisedProcess) -> None:
        """Replace the ``pid`` file of the previous process."""
        try:
            child.file("pid").unlink(missing_ok=True)
            write_mark(child.file("pid"), child.group)
        except OSError as error:
            self._say(f"{child.who}: its mark cannot be written ({error.strerror})")

    def tend(self) -> None:
        """Check the memory and the logs of the processes, and restore missing files."""
        self._oom_kills = _oom_kills()
        if self.children and not self.folder.is_dir():
            self._make_folder()
        for child in self.children:
            if shorten_log(child.file("log"), self._log_bytes):
                child.log_begins = 0
            if child.process is not None and not child.file("pid").exists():
                self._write_mark(child)  # the disk was full before, or the file was removed
            self._weigh(child)

    def _make_folder(self) -> None:
        """Make the removed state folder again; a missing disk must not end the agent."""
        lost = f"{self.folder}: was removed, and is made again"
        try:
            make_folder(self.folder)
        except LiveError as error:
            if (lost := str(error)) == self._lost:
                return
        self._lost, self._lost_s = lost, time.monotonic()
        self._say(lost)

    def _weigh(self, child: SupervisedProcess) -> None:
        """Report each doubling of a process's memory since its warm-up."""
        if child.pid is None:
            return
        try:
            memory = psutil.Process(child.pid).memory_info()
        except psutil.Error:
            return
        # Subtract shared memory, which contains payloads.
        child.has_bytes = has_bytes = memory.rss - memory.shared
        now_s = time.monotonic()
        if has_bytes > child.peak_bytes + GROWS_BYTES:
            child.peak_bytes, child.peak_s = has_bytes, now_s
        if now_s - child.started_s < self._warm_s:
            return
        before = child.warm_bytes
        if before is None:
            child.warm_bytes = has_bytes
        elif has_bytes > max(2 * before, before + self._growth_bytes):
            child.warm_bytes = has_bytes
            child.growth = (
                f"{child.who}: its memory has grown from {before >> 20} to {has_bytes >> 20} MB; "
                "does its stage leak?"
            )
            self._say(child.growth)

    def cpu_seconds(self) -> dict[str, float]:
        """Return the CPU time of each running process since its start."""
        seconds: dict[str, float] = {}
        for child in self.children:
            if child.pid is None:
                continue
            try:
                if child.watched is None or child.watched.pid != child.pid:
                    child.watched = psutil.Process(child.pid)
                times = child.watched.cpu_times()
            except psutil.Error:
                continue
            seconds[child.who] = times.user + times.system
        return seconds

    def stuck(self) -> bool:
        """Return whether a process has died `MOST_TRIES` times, so the user has to act."""
        return any(child.failures >= MOST_TRIES and child.ails for child in self.children)

    def notes(self) -> str:
        """Return notes about processes that keep dying, whose memory grows, or lacked memory."""
        since_s = time.monotonic() - TOLD_S
        ailing = [child for child in self.children if child.ails]
        ailing.sort(key=lambda child: -child.failures)
        notes = [self._lost] if self._lost_s > since_s else []
        notes += [child.note for child in ailing]
        notes += [child.told for child in self.children if child.told_s > since_s]
        notes += [child.growth for child in self.children if child.peak_s > since_s]
        return "; ".join(dict.fromkeys(filter(None, notes)))[:2000]

    def stop(
        self, patience_s: float = STOP_S, *, hurried: threading.Event | None = None
    ) -> dict[str, str]:
        """End all processes; return the causes of unclean ends by process.

        Processes that still run after `patience_s`, or when `hurried` is set, are killed.
        """
        running = [
            psutil.Process(c.pid) for c in self.children if c.pid and psutil.pid_exists(c.pid)
        ]
        end_processes(running, patience_s, hurried=hurried)
        failed = {}
        for child in self.children:
            if child.process is not None:
                code = child.process.wait()
                if code not in (0, UNKNOWN_CODE):
                    last = _last_line(child.file("log"), child.log_begins)
                    failed[child.who] = f"{_reason(code)}{f': {last}' if last else ''}"
            child.process = None
        self._end_groups(patience_s)
        for child in self.children:
            child.file("pid").unlink(missing_ok=True)
        self._launcher.stop()
        return failed

    def _end_groups(self, patience_s: float) -> None:
        """Kill the processes' helpers; give up after `patience_s`."""
        deadline = time.monotonic() + patience_s
        left = [child for child in self.children if not self._end_group(child)]
        while left and time.monotonic() < deadline:
            time.sleep(0.01)
            left = [child for child in left if not self._end_group(child)]


def _send(pid: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def write_mark(mark: Path, group: ProcessGroup | None) -> None:
    """Write the group of a running process for the next agent."""
    if group is not None:
        # No sync to the disk: after a power failure, the process has ended anyway.
        write_whole(mark, msgspec.json.encode(group), durable=False)


def claim(folder: Path, who: str) -> None:
    """Write the ``pid`` file of this process, as its agent may have died since the fork.

    Raises a LiveError if another process of this name runs on the node.
    """
    mark = folder / f"{who}.pid"
    other = survivor(mark)
    if other is not None and other.pid != os.getpid():
        raise LiveError(f"{who}: runs already (process {other.pid})")
    # If the disk is full, the agent tries again.
    with suppress(OSError):
        write_mark(mark, ProcessGroup.of(os.getpid()))


def marked_group(mark: Path) -> ProcessGroup | None:
    """Return the group in a ``pid`` file, whether its process runs or not."""
    try:
        return msgspec.json.decode(mark.read_bytes(), type=ProcessGroup)
    except (OSError, msgspec.MsgspecError):
        return None


def survivor(mark: Path) -> psutil.Process | None:
    """Return the process in a ``pid`` file, if it still runs."""
    group = marked_group(mark)
    return None if group is None else group.leader()


def _reason(code: int) -> str:
    if code == UNKNOWN_CODE:
        return ENDED
    if code < 0:
        try:
            return f"was killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"was killed by signal {-code}"
    return f"ended with exit code {code}"


def _oom_kills() -> int:
    """Return the kernel's count of processes killed for lack of memory; 0 without a count."""
    try:
        counts = dict(line.split() for line in EVENTS.read_text().splitlines())
        return int(counts.get(OOM_KILL, 0))
    except (OSError, ValueError):
        return 0


def shorten_log(path: Path, longest: int) -> bool:
    """Move the content of a long log to ``.log.1``; its process keeps appending to the log.

    Returns whether the log was too long and has been emptied.
    """
    try:
        if path.stat().st_size <= longest:
            return False
        older = path.with_suffix(".log.1")
        write_whole(older, lambda draft: shutil.copyfile(path, draft), durable=False)
        os.truncate(path, 0)
    except OSError:
        return False
    return True


def _last_line(path: Path, begins: int) -> str:
    """Return the last line of a log after an offset."""
    try:
        with path.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - 2_000, begins))
            lines = file.read().decode(errors="replace").strip().split("\n")
    except OSError:
        return ""
    return printable(lines[-1])[:300] if lines else ""
