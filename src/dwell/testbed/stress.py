"""Stress inside a node's group: busy threads that compete with its stages for its quota.

stress-ng where it is installed, otherwise the `Burner`'s own loop; to the kernel both are runnable
processes at normal priority. Either way the burner's process starts and ends them, and they end
with it, and it with the testbed's.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Sequence

from dwell.testbed.burner import Burner

#: One busy process; a loop without memory traffic, as the simulator has its foreign threads.
STRESS_NG = ("stress-ng", "--quiet", "--cpu", "1", "--cpu-method", "loop", "--timeout", "0")


class Stress(Burner):
    """As many busy threads as asked for, inside a group; a context manager.

    Parameters
    ----------
    prefix : sequence of str
        Words of a command that runs the words behind them where the threads are to be, in the same
        process: ``groups.inside(node, [])``.
    cpus : collection of int
        Where they run; those of this process if empty.
    program : sequence of str, optional
        A command that keeps one CPU busy; stress-ng where it is installed if left out, the
        burner's own loop if empty.
    """

    def __init__(
        self,
        prefix: Sequence[str],
        cpus: Collection[int] = (),
        *,
        program: Sequence[str] | None = None,
    ) -> None:
        if program is None:
            program = STRESS_NG if shutil.which(STRESS_NG[0]) else ()
        #: What the threads are, for the record of a run.
        self.kind = program[0] if program else "burner"
        super().__init__(cpus or os.sched_getaffinity(0), prefix=prefix, program=program)
