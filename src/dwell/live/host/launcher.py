"""Launcher of a node's processes: a fork server.

Imports are most of the cost of starting a process: about one core-second, which running processes
lack. So an agent has one process, the *fork server*, that imports the modules once and forks each
new process. It opens no session, and imports neither Zenoh nor users' stages, as both start
threads, which a fork does not copy.
"""

from __future__ import annotations

import errno
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import BinaryIO, TypeAlias

import psutil

#: Exit code of a process whose fork server has died before it.
UNKNOWN_CODE = 1 << 16
LONGEST_BYTES = 1 << 16
#: Longest time for a fork on a busy machine.
PATIENCE_S = 10.0
#: Shortest time between two starts of a fork server.
AGAIN_S = 1.0

#: A started process.
Running: TypeAlias = "subprocess.Popen[bytes] | Survivor"


class ForkServer:
    """Client of a fork server, which ends with this process; the forked processes survive it.

    `program` is the command of the fork server, which calls `serve`. `environment` defaults to this
    process's environment.
    """

    def __init__(
        self, program: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        given = os.environ if environment is None else environment
        self.environment = {**given, "PYTHONUNBUFFERED": "1"}
        self._program = list(program)
        self._server: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._serves = False
        self._next_s = 0.0
        self._codes: dict[int, int] = {}
        #: Processes that the present server has forked, and whose end it will report.
        self.watched: set[int] = set()

    def ready(self) -> bool:
        """Return whether the server has finished its imports; start it if it is not running."""
        if self._channel is None and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + AGAIN_S
            channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                # A separate process group: Ctrl-C in a terminal is for the agent. A separate
                # session would also be a scheduling group with its own share of the CPU.
                self._server = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                    self._program, stdin=theirs.fileno(), env=self.environment, process_group=0
                )
            self._channel = channel
        self.hear()
        return self._serves

    def start(self, command: Sequence[str], log: BinaryIO) -> Running:
        """Fork a process that prints to a log; `serve` returns `command` in it.

        Raises an OSError if the process cannot be started.
        """
        deadline = time.monotonic() + PATIENCE_S
        if self._channel is not None:
            self._channel.settimeout(PATIENCE_S)
            words = json.dumps(list(command)).encode()
            socket.send_fds(self._channel, [words], [log.fileno()])
        while self._channel is not None and (left_s := deadline - time.monotonic()) > 0:
            reply = self._receive(left_s)
            if "forked" in reply:
                self.watched.add(reply["forked"])
                return _Forked(self, reply["forked"])
            if "refused" in reply:
                raise OSError(reply["refused"], os.strerror(reply["refused"]))
        self._end()
        raise OSError(errno.ECHILD, "the fork server does not answer")

    def hear(self) -> None:
        """Read the server's pending messages."""
        while self._channel is not None and self._receive(0.0):
            pass

    def _receive(self, patience_s: float) -> dict[str, int]:
        """Return the next message; empty after the timeout, or if the server has ended."""
        if self._channel is None:
            return {}
        self._channel.settimeout(patience_s)
        try:
            data = self._channel.recv(LONGEST_BYTES)
        except (BlockingIOError, TimeoutError):
            return {}
        except OSError:
            data = b""
        if not data:
            self._end()
            return {}
        message: dict[str, int] = json.loads(data)
        self._serves = True
        if "code" in message:
            self._codes[message["ended"]] = message["code"]
        return message

    def code(self, pid: int) -> int | None:
        """Return the exit code of a forked process; None while it is unknown."""
        self.hear()
        return self._codes.pop(pid, None)

    def _end(self) -> None:
        channel, self._channel, self._serves = self._channel, None, False
        self.watched.clear()
        if channel is not None:
            channel.close()
        if self._server is not None:
            self._server.kill()
            self._server.wait()
            self._server = None

    def stop(self) -> None:
        """End the server for good; the forked processes continue."""
        self._end()
        self._next_s = float("inf")


class Survivor:
    """A process that has outlived its agent or fork server, so its exit code is unknown."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._process: psutil.Process | None = None
        with suppress(psutil.NoSuchProcess):
            self._process = psutil.Process(pid)

    def poll(self) -> int | None:
        """Return `UNKNOWN_CODE` after the process has ended; None while it runs."""
        process = self._process
        with suppress(psutil.NoSuchProcess):
            if process and process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                return None
        return UNKNOWN_CODE

    def wait(self) -> int:
        """Wait until the process has ended, and return its exit code."""
        while (code := self.poll()) is None:
            time.sleep(0.005)
        return code


class _Forked(Survivor):
    """A forked process, whose exit code the fork server reports while it lives itself."""

    def __init__(self, server: ForkServer, pid: int) -> None:
        super().__init__(pid)
        self._server = server
        self._code: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while the process runs."""
        if self._code is None:
            self._code = self._server.code(self.pid)
        if self._code is None and self.pid not in self._server.watched:
            self._code = super().poll()
        return self._code


def serve(stdin: int = 0) -> list[str] | None:
    """Fork at each request from `ForkServer`, whose socket is the descriptor `stdin`.

    Returns the command in a forked process, which prints to the log and has closed the server's
    descriptors. Returns None in the server after the agent has ended.
    """
    channel = socket.socket(fileno=os.dup(stdin))
    empty = os.open(os.devnull, os.O_RDWR)
    os.dup2(empty, stdin)
    os.close(empty)
    # Exclude the present objects from garbage collection in forked processes.
    gc.collect()
    gc.freeze()
    woken, wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    try:
        _tell(channel, {"serves": os.getpid()})
        while True:
            ready, _, _ = select.select([channel.fileno(), woken], [], [])
            if woken in ready:
                os.read(woken, LONGEST_BYTES)
                with suppress(ChildProcessError):
                    while (ended := os.waitpid(-1, os.WNOHANG)) != (0, 0):
                        code = os.waitstatus_to_exitcode(ended[1])
                        _tell(channel, {"ended": ended[0], "code": code})
            if channel.fileno() in ready and (words := _fork(channel)) is not None:
                return words
    except (EOFError, ConnectionError):
        return None
    finally:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for descriptor in (woken, wake):
            os.close(descriptor)
        channel.close()


def _tell(channel: socket.socket, what: Mapping[str, int]) -> None:
    channel.sendall(json.dumps(what).encode())


def _fork(channel: socket.socket) -> list[str] | None:
    """Read a request and fork; return the command in the new process, None in the server.

    Raises an EOFError if the agent has ended.
    """
    data, descriptors, _, _ = socket.recv_fds(channel, LONGEST_BYTES, 1)
    if not data:
        raise EOFError
    (log,) = descriptors
    try:
        with warnings.catch_warnings():
            # The warning is about threads. Only OpenBLAS has some, and ends them before a fork.
            warnings.simplefilter("ignore", DeprecationWarning)
            pid = os.fork()
    except OSError as error:
        os.close(log)
        _tell(channel, {"refused": error.errno or errno.EAGAIN})
        return None
    if pid:
        os.close(log)
        with suppress(OSError):
            os.setpgid(pid, pid)
        _tell(channel, {"forked": pid})
        return None
    # Server and child both set the group, as the server may have died by now.
    os.setpgid(0, 0)
    for descriptor in (sys.stdout.fileno(), sys.stderr.fileno()):
        os.dup2(log, descriptor)
    os.close(log)
    words: list[str] = json.loads(data)
    return words
