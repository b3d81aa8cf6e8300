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

# A start imports NumPy, and many busy threads may run on the same CPU.
START_S = 60.0
ANSWER_S = 20.0
STOP_S = 2.0
#: Period of a child's checks whether its parent lives, in addition to the end of their connection.
PARENT_CHECK_S = 0.5


def run_command(*words: str, given: str = "") -> str:
    """Run a command and return its output; raises a LiveError with the reason if it fails."""
    done = subprocess.run(words, input=given, capture_output=True, text=True, check=False)  # noqa: S603 - no shell
    if done.returncode:
        reason = done.stderr.strip() or f"status {done.returncode}"
        raise LiveError(f"{' '.join(words)}: {reason}")
    return done.stdout


class Started(ABC):
    """Base class of context managers that run during their ``with`` statement.

    The end calls the callbacks that `_start` has pushed on `_stack`, the last first.
    """

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()

    def start(self) -> None:
        """Start all parts, or raise a LiveError after ending the parts that have started."""
        try:
            self._start()
        except BaseException:
            self.stop()
            raise

    @abstractmethod
    def _start(self) -> None: ...

    def stop(self) -> None:
        """End all parts; may be called twice."""
        self._stack.close()

    def __enter__(self) -> Self:
        """Start it."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.stop()


class Child(Started):
    """The parent's side of a child process; a context manager.

    The child stays in the parent's session: a kernel that shares the CPU by session (autogroup)
    would give all threads of a separate session as much as one thread of the others.

    Parameters
    ----------
    module : str
        Run as ``python -m``; its main function makes a `Parent`.
    name : str
        Name for messages.
    settings : object
        First request; all requests are pickled.
    descriptors : sequence of int
        Open files that the child inherits with the same numbers.
    prefix : sequence of str
        Command that executes the command after it in the same process.

    Attributes
    ----------
    answered : object
        Answer to the settings, after the start.
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
        """Process id; raises a LiveError before the start."""
        if self._process is None:
            raise LiveError(f"{self.name} has not been started")
        return self._process.pid

    def start(self) -> None:
        """Start the child, and wait for its answer to its settings.

        Raises a LiveError if the child has been started before, does not answer, or answers with an
        error.
        """
        if self._process is not None:
            raise LiveError(f"{self.name} has been started before")
        super().start()

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        with theirs:
            # The child inherits standard output and error, for its error messages.
            self._process = subprocess.Popen(  # noqa: S603 (our own module)
                [*self._prefix, sys.executable, "-P", "-m", self._module],
                stdin=theirs.fileno(),
                pass_fds=self._descriptors,
            )
        self.answered = self.ask(self.settings, START_S)

    def ask(self, request: object, timeout_s: float = ANSWER_S) -> Any:
        """Send a request from any thread, and return the answer.

        Raises a LiveError if the child is not running, does not answer in time, or answers with an
        error.
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
        """End the child and wait for its end; may be called twice, or after the child has ended."""
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
    """The child's side of the connection to its parent: a socket at standard input.

    Ctrl-C in a terminal also signals the child, which ignores it: the parent ends its children.
    """

    def __init__(self) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._pid = os.getppid()
        self._connection: Connection[Any, Any] = Connection(os.dup(0))

    def fileno(self) -> int:
        """Return a descriptor that is readable at a request, or after the parent's end."""
        return self._connection.fileno()

    @property
    def alive(self) -> bool:
        """Whether the parent still runs."""
        return os.getppid() == self._pid

    def receive(self) -> Any:
        """Wait for the next request and return it.

        Raises an EOFError if the parent has ended, or closed the connection to end this process.
        """
        try:
            while not self._connection.poll(PARENT_CHECK_S):
                if not self.alive:
                    raise EOFError
            return self._connection.recv()
        except OSError:
            raise EOFError from None

    def answer(self, answer: object) -> None:
        """Answer the last request; a DwellError as the answer refuses it."""
        with contextlib.suppress(ConnectionError):
            self._connection.send(answer)

    def serve(self, begin: Callable[[Any], Callable[[Any], object]]) -> None:
        """Answer requests until the parent ends or closes the connection.

        `begin` gets the settings, and returns the function that answers the further requests.
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
