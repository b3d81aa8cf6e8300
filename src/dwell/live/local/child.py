"""Child processes that answer their parent's requests, and end with it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Self

from dwell.errors import DwellError, LiveError

# A start imports NumPy, and what else runs on the CPU may be a lot of busy threads.
START_S = 60.0
ANSWER_S = 20.0
STOP_S = 2.0
#: How often a child looks for its parent, beside the end of their connection.
PARENT_CHECK_S = 0.5


def run_command(*words: str, given: str = "") -> str:
    """Run a command of the system to its end; returns its output.

    Raises
    ------
    LiveError
        If it fails, with its words and its reason.
    """
    done = subprocess.run(words, input=given, capture_output=True, text=True, check=False)  # noqa: S603 - no shell
    if done.returncode:
        reason = done.stderr.strip() or f"status {done.returncode}"
        raise LiveError(f"{' '.join(words)}: {reason}")
    return done.stdout


class Started(ABC):
    """Base of all that runs from the beginning of a ``with`` statement to its end.

    What its beginning has put on `_stack` is undone at the end, last in first out.
    """

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()

    def start(self) -> None:
        """Start it; where that fails, what has begun is ended.

        Raises
        ------
        LiveError
            If something is missing, in the way, or does not start.
        """
        try:
            self._start()
        except BaseException:
            self.stop()
            raise

    @abstractmethod
    def _start(self) -> None: ...

    def stop(self) -> None:
        """End it; safe to call twice."""
        self._stack.close()

    def __enter__(self) -> Self:
        """Start it."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.stop()


class Child(Started):
    """The parent's side; a context manager.

    The child stays in the parent's session: in one of its own, a kernel that shares the CPU by
    session (autogroup) would give all of its threads together what one of the others gets.

    Parameters
    ----------
    module : str
        Run as ``python -m``; its main function makes a `Parent`.
    name : str
        For messages.
    settings : object
        First request, which it is started with; it and all others are pickled.
    descriptors : sequence of int
        Open files that it has under the same numbers.
    prefix : sequence of str
        Words of a command that runs the words behind them, in the same process.

    Attributes
    ----------
    answered : object
        Answer to the settings, once it has been started.
    """

    def __init__(
        self,
        module: str,
        name: str,
        settings: object,
        *,
        descriptors: Sequence[int] = (),
        prefix: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.name, self.settings = name, settings
        self.answered: Any = None
        self._module = module
        self._descriptors = tuple(descriptors)
        self._prefix = tuple(prefix)
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection[Any, Any] | None = None
        self._lock = threading.Lock()

    @property
    def pid(self) -> int:
        """Process id.

        Raises
        ------
        LiveError
            If it has not been started.
        """
        if self._process is None:
            raise LiveError(f"{self.name} has not been started")
        return self._process.pid

    def start(self) -> None:
        """Start it, and wait for its answer to its settings.

        Raises
        ------
        LiveError
            If it has been started before, or does not answer, or answers with an error.
        """
        if self._process is not None:
            raise LiveError(f"{self.name} has been started before")
        super().start()

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        with theirs:
            # Standard output and error are the parent's: a child that fails says why there.
            self._process = subprocess.Popen(  # noqa: S603 (our own module)
                [*self._prefix, sys.executable, "-P", "-m", self._module],
                stdin=theirs.fileno(),
                pass_fds=self._descriptors,
            )
        self.answered = self.ask(self.settings, START_S)

    def ask(self, request: object, timeout_s: float = ANSWER_S) -> Any:
        """Send a request and return the answer; safe from any thread.

        Raises
        ------
        LiveError
            If it does not run, does not answer in time, or answers with an error.
        """
        with self._lock:
            if self._connection is None:
                raise LiveError(f"{self.name} does not run")
            who = f"{self.name} (process {self.pid})"
            try:
                self._connection.send(request)
                if not self._connection.poll(timeout_s):
                    raise LiveError(f"{who} has not answered within {timeout_s:g} s")
                answer = self._connection.recv()
            except (EOFError, OSError):
                raise LiveError(f"{who} has ended") from None
        if isinstance(answer, DwellError):
            raise LiveError(f"{self.name}: {answer}")
        return answer

    def stop(self) -> None:
        """End it and wait until it is gone; safe to call twice, and if it has ended by itself."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None
            if self._process is None:
                return
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:  # stopped by a signal, or hung
                self._process.kill()
                self._process.wait()


class Parent:
    """The child's side: requests come on standard input, a socket.

    Ctrl-C in a terminal reaches the children too; it is left to the parent to end them.
    """

    def __init__(self) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._pid = os.getppid()
        self._connection: Connection[Any, Any] = Connection(os.dup(0))

    def fileno(self) -> int:
        """Descriptor that is readable when there is a request, or the parent has gone."""
        return self._connection.fileno()

    @property
    def alive(self) -> bool:
        """Whether the parent still runs."""
        return os.getppid() == self._pid

    def receive(self) -> Any:
        """Return the next request; waits for it. The parent has at most one under way.

        Raises
        ------
        EOFError
            If the parent has gone, or wants this process to end.
        """
        try:
            while not self._connection.poll(PARENT_CHECK_S):
                if not self.alive:
                    raise EOFError
            return self._connection.recv()
        except OSError:
            raise EOFError from None

    def answer(self, answer: object) -> None:
        """Answer the request received last; with a DwellError, that it is refused."""
        with contextlib.suppress(ConnectionError):
            self._connection.send(answer)

    def serve(self, begin: Callable[[Any], Callable[[Any], object]]) -> None:
        """Answer requests until the parent ends, or wants this to.

        Parameters
        ----------
        begin : callable
            Takes the settings, and returns what takes a request and returns its answer.
        """
        answering: Callable[[Any], object] | None = None
        with contextlib.suppress(EOFError):
            while True:
                request = self.receive()
                try:
                    if answering is None:
                        answer, answering = None, begin(request)
                    else:
                        answer = answering(request)
                except DwellError as error:
                    answer = error
                self.answer(answer)
