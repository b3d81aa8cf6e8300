"""What a page that is open costs a live cell: CPU, latency, and what it is sent."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import quantiles
from typing import NamedTuple

import psutil
from playwright.sync_api import Browser

from benchmarks.figures import Figure, Goal, Section
from benchmarks.live import cell_of, cpu_s, processes_of
from benchmarks.live_cell import LightCell, document
from benchmarks.page import CHROMIUM, browser_of
from dwell.live.host.security import Security
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role

PERIOD_MS = 1e3 / 30
PAIRS, SECONDS = 20, 60.0
#: Share of a core that the cell's processes may take more, %.
MORE = 1.0


class _Stretch(NamedTuple):
    """What was measured while a page was open, or not: shares of a core, %."""

    cell: float
    page: float
    p99_ms: float


def measure(quick: bool) -> Section:
    """See the module."""
    pairs, seconds = (3, 10.0) if quick else (PAIRS, SECONDS)
    if CHROMIUM is None:
        return Section("a page on a live cell", [], ["skipped: there is no Chromium here"])
    found = document("page", period_ms=PERIOD_MS, window_cycles=30)
    with cell_of(found, links=False) as cell, browser_of(CHROMIUM) as browser:
        time.sleep(3)
        each = []
        for _ in range(pairs):
            with _page(cell, browser) as process:
                opened = _stretch(cell, seconds, process)
            each.append((opened, _stretch(cell, seconds, None)))
        messages, kilobytes = _heard(cell, seconds)
        count = len(processes_of(cell))
    return Section(
        f"A page on a live cell at 30 Hz, {pairs} pairs of {seconds:g} s, open and closed",
        [
            Figure(
                "CPU of the cell, open less closed",
                [opened.cell - closed.cell for opened, closed in each],
                "%",
                Goal(high=MORE),
            ),
            Figure("CPU of the cell, closed", [closed.cell for _, closed in each], "%"),
            Figure("CPU of the page's process", [opened.page for opened, _ in each], "%"),
            Figure("p99 of latency, open", [opened.p99_ms for opened, _ in each], "ms"),
            Figure("p99 of latency, closed", [closed.p99_ms for _, closed in each], "ms"),
            Figure("messages of the channels that it hears", [messages], "/s"),
            Figure("their length", [kilobytes], "kB/s"),
        ],
        [f"{count} processes of the cell; CPU is of one core"],
    )


@contextmanager
def _page(cell: LightCell, browser: Browser) -> Iterator[psutil.Process]:
    """Open a page of a cell in a browser; gives the process that serves it."""
    command = [sys.executable, "-m", "dwell", "dash", str(cell.processes.file)]
    command += ["--port", "0", "--no-browser"]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    page = browser.new_page()
    try:
        assert served.stdout is not None
        page.goto(served.stdout.readline().strip())
        time.sleep(2)
        yield psutil.Process(served.pid)
    finally:
        page.close()
        served.terminate()
        served.wait()


def _stretch(cell: LightCell, seconds: float, page: psutil.Process | None) -> _Stretch:
    every = [*processes_of(cell).values(), *([] if page is None else [page])]
    applied, begin = len(cell.applied()), time.monotonic()
    before = [cpu_s(process) for process in every]
    time.sleep(seconds)
    passed_s = time.monotonic() - begin
    shares = [
        100 * (cpu_s(process) - spent_s) / passed_s
        for process, spent_s in zip(every, before, strict=True)
    ]
    paged = 0.0 if page is None else shares.pop()
    latencies = [one.at_ns - one.released_ns for one in cell.applied()[applied:]]
    return _Stretch(sum(shares), paged, quantiles(latencies, n=100)[-1] / 1e6)


def _heard(cell: LightCell, seconds: float) -> tuple[float, float]:
    """Count the messages of the channels that a page's process subscribes to, and their kB."""
    problem, lengths = cell.problem, list[int]()

    def count(sample: Arrival) -> None:
        lengths.append(len(sample.key) + len(sample.payload) + len(sample.header))

    security = Security.of(problem, Role("counts", problem.controller_node, "visitor"))
    relay = f"agent@{problem.relay_node}"
    transport = security.visit("counts", f"stamper@{problem.stamper_node}", relay)
    for key in (Keys(problem.name).of(channels.STAMPED), Keys(problem.name).of(channels.GATHERED)):
        transport.subscribe(key, count)
    time.sleep(1)
    lengths.clear()
    time.sleep(seconds)
    transport.close()
    return len(lengths) / seconds, sum(lengths) / seconds / 1e3
