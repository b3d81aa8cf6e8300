"""The page of recorded runs: from the command to the strip, what it sends, and what it keeps."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Page, sync_playwright

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.live import everywhere
from dwell.model.fleet import Fleet, FleetEntry

CYCLES, PLAYED_CYCLES = 1_000_000, 108_000
CELLS, FLEET_WINDOWS = 64, 100
STRIP_S, SENT_MB, GROWN, STATES_HZ = 2.0, 1.0, 0.05, 10.0
SPEED = 100
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
#: Parts of the time line that are looked at, as shares.
ZOOMS = ((0.0, 1.0), (0.2, 0.3), (0.5, 0.501), (0.9, 0.90001))


def measure(quick: bool) -> Section:
    """See the module."""
    if CHROMIUM is None:
        return Section("the page of a recorded run", [], ["skipped: there is no Chromium here"])
    # A browser and a server have all cores.
    everywhere()
    cycles = CYCLES // 10 if quick else CYCLES
    with tempfile.TemporaryDirectory() as folder, browser_of(CHROMIUM) as browser:
        long, played = Path(folder) / "long", Path(folder) / "played"
        misses = _recorded(long, cycles)
        _recorded(played, PLAYED_CYCLES // 10 if quick else PLAYED_CYCLES)
        strips = [_strip_s(browser, long) for _ in range(3 if quick else 5)]
        sent_mb, drawn = _sent(long)
        server, heap = _grown(browser, played)
        fleet = Path(folder) / "fleet"
        _recorded_fleet(fleet, CELLS // 4 if quick else CELLS)
        sent_mb += _fleet_sent(fleet)
        states_hz = _states_hz(browser, fleet)
    notes = [
        f"a run of {cycles:,} cycles; the browser runs already, the file cache is warm",
        f"misses in the bins of the whole line: {drawn:,}; in the table: {misses:,}",
        f"the fleet has {CELLS // 4 if quick else CELLS} cells; its server has one core",
        f"grown: in an hour at {SPEED} times its speed, the second time, from its first tenth on",
    ]
    return Section(
        "the page of a recorded run",
        [
            Figure("from the command to the strip", strips, "s", Goal(high=STRIP_S)),
            Figure("largest answer, any zoom", sent_mb, "MB", Goal(high=SENT_MB)),
            Figure("misses drawn over misses in the table", [drawn / misses], "", Goal(1.0, 1.0)),
            Figure("memory of the server, grown by", [server], "", Goal(high=GROWN)),
            Figure("heap of the page, grown by", [heap], "", Goal(high=GROWN)),
            Figure("states of a fleet, played", [states_hz], "Hz", Goal(low=STATES_HZ)),
        ],
        notes,
    )


def _recorded(folder: Path, cycles: int) -> int:
    """Record a run; returns its misses."""
    problem = dwell.load(CELL)
    run = dwell.simulate(problem, seed=1, windows=cycles // problem.window_cycles)
    run.save(folder)
    return int(run.cycles["missed"].sum())


def _recorded_fleet(folder: Path, cells: int) -> None:
    entry = FleetEntry(dwell.load(CELL), cells, scenario="robot-cpu-stress")
    fleet = Fleet("bench", (entry,), ("E",), coordination="random")
    dwell.simulate_fleet(fleet, windows=FLEET_WINDOWS).save(folder)


@contextmanager
def browser_of(path: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--js-flags=--expose-gc"]
        )
        yield browser
        browser.close()


@contextmanager
def _served(folder: Path, *before: str) -> Iterator[tuple[int, str]]:
    """Serve a run; gives the process and the address."""
    words = ["dash", str(folder), "--port", "0", "--no-browser"]
    command = [*before, sys.executable, "-m", "dwell", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.pid, process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait()


def _strip_s(browser: Browser, folder: Path) -> float:
    page = browser.new_page()
    begin = time.perf_counter()
    with _served(folder) as (_, address):
        page.goto(address)
        while not page.evaluate("document.querySelector('.latency .said')?.textContent"):
            time.sleep(0.005)
        taken_s = time.perf_counter() - begin
    page.close()
    return taken_s


def _asking(address: str) -> Callable[[str], bytes]:
    """Return what asks a page for a path."""
    parts = urlsplit(address)
    token = parts.query.removeprefix("token=")
    connection = HTTPConnection(parts.netloc)

    def get(path: str) -> bytes:
        connection.request("GET", path, headers={"Authorization": f"Bearer {token}"})
        return connection.getresponse().read()

    return get


def _sent(folder: Path) -> tuple[list[float], int]:
    """Return the length of the longest answers, MB, by zoom; and the misses that the first has."""
    sizes, drawn = [], 0
    with _served(folder) as (_, address):
        get = _asking(address)
        cell = json.loads(get("/cells"))["cells"][0]
        begin, length = cell["begin"], cell["end"] - cell["begin"]
        for low, high in ZOOMS:
            ends = f"begin={begin + low * length}&end={begin + high * length}"
            answers = [get(f"/view?{ends}&bins=1500"), get(f"/jobs?{ends}"), get("/cells")]
            sizes.append(max(map(len, answers)) / 1e6)
            if (low, high) == (0.0, 1.0):
                drawn = sum(json.loads(answers[0])["bins"]["missed"])
    return sizes, drawn


def _fleet_sent(folder: Path) -> list[float]:
    """Return the length of the longest answers about a fleet, MB, by zoom."""
    with _served(folder) as (_, address):
        get = _asking(address)
        end = json.loads(get("/cells"))["fleet"]["end"]
        return [
            max(
                len(get(f"/view?begin={low * end}&end={high * end}&bins=1500")),
                len(get(f"/state?at={low * end}")),
            )
            / 1e6
            for low, high in ZOOMS
        ]


def _states_hz(browser: Browser, folder: Path) -> float:
    """Play a fleet to its end, the server on one core; returns how many states a second came."""
    page = browser.new_page()
    states: list[str] = []
    page.on(
        "response", lambda answer: states.append(answer.url) if "/state" in answer.url else None
    )
    with _served(folder, "taskset", "--cpu-list", "0") as (_, address):
        page.goto(address)
        while not page.evaluate("Boolean(window.page)"):
            time.sleep(0.05)
        begin, count = time.perf_counter(), len(states)
        page.evaluate("window.page.play(true)")
        while page.evaluate("window.page.playing"):
            page.wait_for_timeout(200)
        taken_s = time.perf_counter() - begin
    page.close()
    return (len(states) - count) / taken_s


def _grown(browser: Browser, folder: Path) -> tuple[float, float]:
    """Play a whole run twice; returns by how much both grew from the second first tenth on.

    The first time the browser compiles what it runs.
    """
    page = browser.new_page()
    found: list[tuple[float, float]] = []
    with _served(folder) as (pid, address):
        page.goto(address)
        while not page.evaluate("Boolean(window.page)"):
            time.sleep(0.05)
        end = page.evaluate("window.page.span[1]")
        page.evaluate(f"document.getElementById('speed').value = '{SPEED}'")
        page.evaluate("window.page.zoom(0, 60)")
        page.evaluate("window.page.play(true)")
        while page.evaluate("window.page.playing"):
            time.sleep(0.2)
        page.evaluate("window.page.play(true)")
        for share in (0.1, 0.999):
            while page.evaluate("window.page.at") < share * end:
                time.sleep(0.2)
            page.evaluate("window.page.play(false)")
            time.sleep(0.5)
            found.append((_resident(pid), _heap(page)))
            page.evaluate("window.page.play(true)")
    page.close()
    ((server, server_last), (heap, heap_last)) = (pair for pair in zip(*found, strict=True))
    return server_last / server - 1, heap_last / heap - 1


def _resident(pid: int) -> float:
    return float(Path(f"/proc/{pid}/statm").read_text().split()[1])


def _heap(page: Page) -> float:
    for _ in range(3):
        page.evaluate("gc()")
        time.sleep(0.05)
    return float(page.evaluate("performance.memory.usedJSHeapSize"))
