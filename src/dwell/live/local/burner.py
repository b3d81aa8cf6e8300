"""Foreign work on a node's CPUs: busy threads at normal priority, as many as asked for.

Each is what the simulator calls a foreign thread (`stress_threads`): always runnable, pinned to the
node's CPUs, no memory traffic to speak of. It is a process of its own, because threads of one
Python process take turns instead of competing; the kernel knows no difference. All end with the
process that starts them, and that one with the testbed's.
"""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import signal
import sys
from collections.abc import Callable, Collection, Sequence

from dwell.errors import LiveError
from dwell.live.local.child import Child, Parent

#: One busy process; a loop without memory traffic, as the simulator has its foreign threads.
STRESS_NG = ("stress-ng", "--quiet", "--cpu", "1", "--cpu-method", "loop", "--timeout", "0")
MAX_THREADS = 1_000
# Turns of an empty loop between two looks at whether the parent lives: below a millisecond.
TURNS = 20_000
PR_SET_PDEATHSIG = 1  # linux/prctl.h


class Burner(Child):
    """Foreign threads on some CPUs, as many as ordered; a context manager.

    Parameters
    ----------
    cpus : collection of int
        Where the threads run; the kernel spreads them over these.
    prefix : sequence of str
        Words of a command that runs the words behind them, in the same process: as a group of
        processes that the threads are to be in.
    program : sequence of str
        A command that keeps one CPU busy, in place of this module's own empty loop.
    """

    def __init__(
        self,
        cpus: Collection[int],
        *,
        prefix: Sequence[str] = (),
        program: Sequence[str] = (),
    ) -> None:
        allowed = os.sched_getaffinity(0)
        missing = sorted(set(cpus) - allowed)
        if missing or not cpus:
            asked = f"CPU {', '.join(map(str, missing))}" if missing else "no CPU"
            known = ", ".join(map(str, sorted(allowed)))
            raise LiveError(f"a burner cannot run on {asked}; this process may use {known}")
        #: Ids of the threads as of the last answer: each is a process.
        self.pids: tuple[int, ...] = ()
        name = f"burner on {','.join(map(str, sorted(cpus)))}"
        settings = sorted(cpus), tuple(program)
        super().__init__("dwell.live.local.burner", name, settings, prefix=prefix)

    def start(self, threads: int = 0) -> None:
        """Start it with so many threads.

        Raises
        ------
        ProblemError
            If the number is out of its bounds.
        LiveError
            If it has been started before, or does not start.
        """
        super().start()
        self.set(threads)

    def set(self, threads: int) -> None:
        """Have so many threads from now on.

        Raises
        ------
        ProblemError
            If the number is out of its bounds.
        LiveError
            If it does not run.
        """
        from dwell.model.bounds import Bound  # the burner's own process does without the model

        Bound(0, MAX_THREADS, whole=True).check("threads", threads)
        self.pids = tuple(self.ask(threads))

    def stop(self) -> None:
        """End it, and with it all threads; safe to call twice."""
        super().stop()
        self.pids = ()


def stress(prefix: Sequence[str], cpus: Collection[int] = ()) -> Burner:
    """Return foreign work in a node's group, by stress-ng where it is installed.

    To the kernel its processes, and those of the burner's own loop, are the same.

    Parameters
    ----------
    prefix : sequence of str
        First words of its command: ``groups.inside(node, [])``.
    cpus : collection of int
        Where its threads run; the CPUs of this process if empty.
    """
    program = STRESS_NG if shutil.which(STRESS_NG[0]) else ()
    return Burner(cpus or os.sched_getaffinity(0), prefix=prefix, program=program)


# ------------------------------------------------------------------------- the burner's process


def main() -> None:
    """Keep as many busy processes as the parent wants, until it ends."""
    gc.freeze()
    fire = _Fire()
    try:
        Parent().serve(fire.begin)
    finally:
        fire.burn(0)


class _Fire:
    """The busy processes."""

    def __init__(self) -> None:
        self._pids: list[int] = []
        self._program: tuple[str, ...] = ()

    def begin(self, settings: tuple[list[int], tuple[str, ...]]) -> Callable[[int], list[int]]:
        """Take over CPUs and program."""
        cpus, self._program = settings
        os.sched_setaffinity(0, cpus)
        return self.burn

    def burn(self, threads: int) -> list[int]:
        """Have so many of them; returns their ids."""
        while len(self._pids) < threads:
            self._pids.append(_fork(self._program))
        ended, self._pids = self._pids[threads:], self._pids[:threads]
        for pid in ended:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        return self._pids


def _fork(program: Sequence[str]) -> int:
    """Start a busy process that leads a process group and ends with this one."""
    parent = os.getpid()
    pid = os.fork()
    if pid == 0:
        os.setpgid(0, 0)
        if program:
            _become(program, parent)
        while os.getppid() == parent:
            for _ in range(TURNS):
                pass
        os._exit(0)
    with contextlib.suppress(OSError):  # of both sides whoever comes first
        os.setpgid(pid, pid)
    return pid


def _become(program: Sequence[str], parent: int) -> None:
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    try:
        if os.getppid() == parent:
            os.execvp(program[0], list(program))  # noqa: S606 (what the parent was told to run)
    except OSError as error:
        print(f"{program[0]}: {error.strerror}", file=sys.stderr)
    os._exit(127)


if __name__ == "__main__":
    main()
