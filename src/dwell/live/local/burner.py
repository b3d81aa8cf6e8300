"""Foreign load on a node's CPUs: a number of busy threads at normal priority.

Each is a foreign thread of the simulator (`stress_threads`): always runnable, pinned to the node's
CPUs, almost without memory traffic. It is a separate process, because threads of one Python process
take turns instead of competing; the kernel schedules both alike. All end with the burner's process,
which ends with the testbed's.
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

#: Command of a busy process: a loop without memory traffic, like the simulator's foreign threads.
STRESS_NG = ("stress-ng", "--quiet", "--cpu", "1", "--cpu-method", "loop", "--timeout", "0")
MAX_THREADS = 1_000
# Turns of an empty loop (below a millisecond) between two checks whether the parent lives.
TURNS = 20_000
PR_SET_PDEATHSIG = 1  # linux/prctl.h


class Burner(Child):
    """Foreign threads on some CPUs, over which the kernel spreads them; a context manager.

    `prefix` is a command that executes the command after it in the same process, such as in a group
    of processes. `program` is a command that keeps one CPU busy [default: an empty loop].
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
        #: Process ids of the threads at the last answer.
        self.pids: tuple[int, ...] = ()
        name = f"burner on {','.join(map(str, sorted(cpus)))}"
        settings = sorted(cpus), tuple(program)
        super().__init__("dwell.live.local.burner", name, settings, prefix=prefix)

    def start(self, threads: int = 0) -> None:
        """Start the burner's process and a number of threads.

        Raises a ProblemError if the number is out of bounds, and a LiveError if the burner has been
        started before, or does not start.
        """
        super().start()
        self.set(threads)

    def set(self, threads: int) -> None:
        """Change the number of threads.

        Raises a ProblemError if the number is out of bounds, and a LiveError if the burner is not
        running.
        """
        from dwell.model.bounds import Bound  # the burner's own process does without the model

        Bound(0, MAX_THREADS, whole=True).check("threads", threads)
        self.pids = tuple(self.ask(threads))

    def stop(self) -> None:
        """End all threads; may be called twice."""
        super().stop()
        self.pids = ()


def stress(prefix: Sequence[str], cpus: Collection[int] = ()) -> Burner:
    """Return foreign load in a node's group: of stress-ng if it is installed, else of a loop.

    `prefix` is ``groups.inside(node, [])``; `cpus` default to the CPUs of this process. The kernel
    treats both kinds of load alike.
    """
    program = STRESS_NG if shutil.which(STRESS_NG[0]) else ()
    return Burner(cpus or os.sched_getaffinity(0), prefix=prefix, program=program)


# ------------------------------------------------------------------------- the burner's process


def main() -> None:
    """Run as many busy processes as the parent orders, until it ends."""
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
        """Apply the CPUs and the program; return the function for further requests."""
        cpus, self._program = settings
        os.sched_setaffinity(0, cpus)
        return self.burn

    def burn(self, threads: int) -> list[int]:
        """Change the number of busy processes; return their ids."""
        while len(self._pids) < threads:
            self._pids.append(_fork(self._program))
        ended, self._pids = self._pids[threads:], self._pids[:threads]
        for pid in ended:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        return self._pids


def _fork(program: Sequence[str]) -> int:
    """Start a busy process that leads a process group and ends with this process."""
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
    with contextlib.suppress(OSError):  # parent and child both set the group
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
