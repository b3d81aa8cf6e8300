"""What the live example weighs at rest: processes, threads, memory, and its share of a core."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import psutil

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.live import cpu_s, everywhere
from benchmarks.timing import ROOT
from dwell.live.host.parent_death import OPTION
from dwell.live.local.loopback import Loopback, on_this_machine

CELL = ROOT / "examples" / "live" / "cell.yaml"
RUNS, SECONDS = 5, 20.0
#: Time after which no process starts any more.
SETTLED_S = 5.0
#: A share of a core in %, processes, and MB that the cell is meant to take at most.
SHARE, PROCESSES, MEMORY = 20.0, 12, 400.0


def measure(quick: bool) -> Section:
    """See the module."""
    everywhere()
    runs, seconds = (1, 10.0) if quick else (RUNS, SECONDS)
    each = [_run(seconds) for _ in range(runs)]
    shares, agents, counts, threads, memories = zip(*each, strict=True)
    return Section(
        f"The live example at rest, {runs} runs of {seconds:g} s",
        [
            Figure("CPU of all processes", shares, "% of a core", Goal(high=SHARE)),
            Figure("CPU of the agents", agents, "% of a core"),
            Figure("processes", counts, "", Goal(high=PROCESSES)),
            Figure("threads", threads, ""),
            Figure("memory (PSS)", memories, "MB", Goal(high=MEMORY)),
        ],
        ["agents, controller, fork servers and all that they have forked; user and kernel time"],
    )


def _run(seconds: float) -> tuple[float, float, float, float, float]:
    """Run the example once; returns shares in %, counts, and MB, in the order of `measure`."""
    problem = on_this_machine(dwell.load(CELL))
    with tempfile.TemporaryDirectory() as folder, Loopback(problem, Path(folder) / "cell", {}):
        time.sleep(SETTLED_S)
        processes = {one: one.cmdline() for one in psutil.process_iter() if _is_ours(one)}
        begin, before = time.monotonic(), {one: cpu_s(one) for one in processes}
        time.sleep(seconds)
        passed_s = time.monotonic() - begin
        spent = {one: 100 * (cpu_s(one) - before[one]) / passed_s for one in processes}
        return (
            sum(spent.values()),
            sum(share for one, share in spent.items() if "agent" in processes[one]),
            len(processes),
            sum(one.num_threads() for one in processes),
            sum(one.memory_full_info().pss for one in processes) / 1e6,
        )


def _is_ours(process: psutil.Process) -> bool:
    try:
        return f"{OPTION} {os.getpid()} " in f"{' '.join(process.cmdline())} "
    except psutil.Error:
        return False
