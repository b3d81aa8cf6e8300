"""Many cells on one controller: a real ``dwell controller``, and everybody else played over Zenoh.

This process has one session for each process that a controller is connected to, which listens for
all cells at once: every controller has all its connections. Each cell is stamped at 25 Hz; its
completions come with their hops, twice as in a real cell, beats, loads and answers beside them. It
is always bad where it is, so that the policy orders a move at every decision.

Cells begin when they like, so that their windows close all over the time that one takes; beside
that stands the worst case, in which all windows close in one instant. Cells decide once per window,
or four times.
"""

from __future__ import annotations

import heapq
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
import yaml

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.live_cell import document
from benchmarks.timing import ROOT
from dwell import __version__
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import (
    Accepted,
    Beat,
    Carried,
    Completion,
    Heard,
    Hop,
    Load,
    Order,
    Stamp,
    decode,
    encode,
)
from dwell.live.wire.wiring import Wiring, roles, wire
from dwell.model import Problem
from dwell.model.document import digests
from dwell.record import open_run

if TYPE_CHECKING:
    import zenoh

SIZES = (1, 10, 20, 30, 40, 50, 75, 100)
#: Cells whose windows all close at once.
AT_ONCE = (10, 25, 50)
PERIOD_MS = 40.0
PERIOD_NS = 40_000_000
GRACE_NS = PERIOD_NS
LATENCY_NS = 30_000_000
LOAD_NS = 250_000_000
#: Periods between two tellings of beats, as `dwell.live.host.agent` has it.
BEATS = 5
WINDOW = 25
FIRST_PORT, PORTS_PER_CELL = 10_000, 90
START_S = 120.0
#: A window may close so much earlier than this process thinks, by the error of the clocks.
EARLY_NS = 5_000_000


def measure(quick: bool) -> Section:
    """Delay of decisions and completions dropped, by the number of cells."""
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    seconds = 8.0 if quick else 20.0
    figures: list[Figure] = []
    broke: dict[tuple[bool, int], int] = {}
    cases = [
        (size, at_once, every)
        for every in (WINDOW, WINDOW // 4)
        for at_once, sizes in ((False, SIZES), (True, AT_ONCE))
        for size in ([one for one in sizes if one in (10, 50)] if quick else sizes)
    ]
    for size, at_once, every in cases:
        if broke.setdefault((at_once, every), 0):
            continue
        found = _measured(size, seconds, at_once=at_once, every=every)
        bound = size <= 50 and every == WINDOW
        figures += [
            Figure(
                f"{size} cells{_told(at_once=at_once, every=every)}: decision, p50",
                [found["p50"]],
                "ms",
            ),
            Figure("  p99", [found["p99"]], "ms", Goal(high=PERIOD_MS / 2) if bound else None),
            Figure("  longest", [found["longest"]], "ms"),
            Figure(
                "  completions dropped", [found["dropped"]], "", Goal(high=0) if bound else None
            ),
            Figure("  windows without a decision", [found["silent"]], ""),
            Figure("  controller", [found["cpu"]], "% of a core"),
            Figure("  the players' own delay, p99", [found["late"]], "ms"),
        ]
        if found["p99"] > PERIOD_MS / 2 or found["dropped"]:
            broke[at_once, every] = size
    told = [
        f"windows{_told(at_once=at_once, every=every) or ', spread over time'}: "
        + (f"breaks at {size} cells" if size else "did not break")
        for (at_once, every), size in broke.items()
    ]
    return Section(
        "Many cells at 25 Hz on one controller, from the instant a window is due to the order",
        figures,
        [*told, f"{seconds:g} s each; the processes that play the cells share this machine"],
    )


def _told(*, at_once: bool, every: int) -> str:
    often = f", a decision every {every} cycles" if every < WINDOW else ""
    return f"{', all at once' if at_once else ''}{often}"


def _problem(number: int, folder: Path, every: int) -> tuple[Problem, Path]:
    found = document(f"c{number}", period_ms=PERIOD_MS, fallbacks=())
    base = FIRST_PORT + number * PORTS_PER_CELL
    hosts = {node: {"port": base + 30 * i} for i, node in enumerate(found["nodes"])}
    found["live"]["hosts"] = hosts
    found["window_cycles"] = WINDOW
    found["controller"].update(min_dwell=0, min_improvement=0.0, decide_cycles=every)
    path = folder / f"c{number}.yaml"
    path.write_text(yaml.safe_dump(found, sort_keys=False))
    return dwell.load(path), path


class _Cell:
    """One cell, as its controller knows it from what it hears."""

    def __init__(self, number: int, problem: Problem, put: Callable[[str, str, bytes], None]):
        self.number, self.problem, self._put = number, problem, put
        self.keys = Keys(problem.name)
        self.digest = digests(problem)["wiring"]
        self.everybody = [(r.who, r.node) for r in roles(problem) if r.kind != "controller"]
        self.run = time.time_ns()
        self.cycle, self.term, self.placement = 0, 1, problem.initial
        self.begun = False
        self.first = 0  # of the term
        self.released: dict[int, int] = {}
        self.delays_ms: list[float] = []
        self.silent = 0
        self.gathered: list[tuple[str, bytes]] = []
        self.sent_done = 0

    def release(self, now_ns: int) -> Stamp:
        """Stamp a cycle."""
        stamp = Stamp(self.run, self.cycle, self.term, self.placement, now_ns)
        self.released[self.cycle] = now_ns
        self.cycle += 1
        every, age = self.problem.decide_cycles, self.cycle - self.first
        if age > 2 * every + 3 and age % every == 3 % every:
            self.silent += 1
        self._put("stamper@R1", self.keys.of(channels.STAMPED), encode(stamp))
        return stamp

    def complete(self, stamp: Stamp, now_ns: int) -> None:
        """Say that a cycle has arrived."""
        at_ns, hops, before = stamp.released_ns, [], "stamper"
        candidate = self.problem.candidates[stamp.placement].first
        placed = {"sensing": "R1", **candidate, "control": "R2"}
        for task, node in placed.items():
            hops.append(Hop(task, node, at_ns, at_ns, at_ns + 7_000_000, ((before, at_ns),)))
            at_ns, before = at_ns + 7_000_000, task
        done = Completion(stamp, "control", now_ns, "actuated", tuple(hops), "R2")
        key, payload = self.keys.of(channels.DONE, "control"), encode(done)
        self._put("sink.control@R2", key, payload)
        self.gathered.append((key, payload))
        self.sent_done += 1

    def gather(self, now_ns: int) -> None:
        """What the relay tells: copies, and now and then the last beats."""
        told, self.gathered = self.gathered, []
        if self.cycle % BEATS == self.number % BEATS:
            told += [self._beat(who, node, now_ns) for who, node in self.everybody]
        self._put("agent@E", self.keys.of(channels.GATHERED), encode(Carried(tuple(told))))

    def _beat(self, who: str, node: str, now_ns: int) -> tuple[str, bytes]:
        before_ns = now_ns - PERIOD_NS
        others = self.everybody if who.startswith("stamper") else [("stamper@R1", "R1")]
        heard = tuple(
            Heard(other, at, before_ns, before_ns + 200_000) for other, at in others if other != who
        )
        beat = Beat(who, node, 1, now_ns, True, heard, cell=self.digest, version=__version__)
        return self.keys.of(channels.BEAT, node, who), encode(beat)

    def load(self, now_ns: int) -> None:
        """What the CPUs do."""
        for node in self.problem.fabric.nodes:
            key = self.keys.of(channels.LOAD, node)
            payload = encode(Load(node, 1, now_ns, now_ns // 4, now_ns // 8, 0))
            self._put(f"agent@{node}", key, payload)
            self.gathered.append((key, payload))

    def ordered(self, order: Order, at_ns: int) -> None:
        """Answer an order; note how late it is."""
        self.begun = True
        moves = order.placement not in ("", self.placement) and order.term == self.term
        if moves:
            every = self.problem.decide_cycles
            due = [
                self.released[number] + GRACE_NS
                for number in range(self.first + every, self.cycle, every)
            ]
            past = [due_ns for due_ns in due if due_ns <= at_ns + EARLY_NS]
            if past:
                self.delays_ms.append((at_ns - past[-1]) / 1e6)
            self.term += 1
            self.placement, self.first = order.placement, self.cycle
        answer = Accepted(
            *(order.number, order.controller, "", self.run, self.term, self.placement, self.cycle)
        )
        key, payload = self.keys.of(channels.ACCEPTED), encode(answer)
        self._put("stamper@R1", key, payload)
        self.gathered.append((key, payload))


class _Players:
    """Sessions of everybody but the controllers."""

    def __init__(self, wirings: list[Wiring], stack: ExitStack) -> None:
        import zenoh

        self._sessions: dict[str, zenoh.Session] = {}
        ends: dict[str, list[str]] = {}
        for wiring in wirings:
            told = set(wiring.entry("controller@E").connect["control"])
            for who, entry in wiring.entries.items():
                listen = entry.listen.get("control")
                if listen in told:
                    ends.setdefault(who, []).append(str(listen))
        self.connections = len(ends)
        for who, at in ends.items():
            config = zenoh.Config()
            for path, value in {
                "mode": "peer",
                "scouting/multicast/enabled": False,
                "scouting/gossip/enabled": False,
                "listen/endpoints": at,
                "transport/link/tx/lease": 1_500,
                "transport/link/tx/keep_alive": 3,
                "transport/link/tx/queue/batching/enabled": False,
                "transport/shared_memory/enabled": False,
                "transport/unicast/max_sessions": 1_000,
            }.items():
                config.insert_json5(path, json.dumps(value))
            self._sessions[who] = stack.enter_context(zenoh.open(config))
        self._drop = zenoh.CongestionControl.DROP
        self._real_time = zenoh.Priority.REAL_TIME

    def put(self, who: str, key: str, payload: bytes) -> None:
        """Send a message of somebody's."""
        self._sessions[who].put(
            key, payload, congestion_control=self._drop, priority=self._real_time, express=True
        )

    def subscribe(self, who: str, key: str, receive: Callable[[zenoh.Sample], None]) -> None:
        """Hear what controllers say to somebody."""
        self._sessions[who].declare_subscriber(key, receive)


def _measured(
    size: int, seconds: float, *, at_once: bool = False, every: int = WINDOW
) -> dict[str, float]:
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    try:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            made = [_problem(number, folder, every) for number in range(size)]
            return _played(made, seconds, folder, stack, at_once=at_once)
    finally:
        sys.setswitchinterval(switch_s)


def _played(
    made: list[tuple[Problem, Path]],
    seconds: float,
    folder: Path,
    stack: ExitStack,
    *,
    at_once: bool,
) -> dict[str, float]:
    players = _Players([wire(problem) for problem, _ in made], stack)
    cells = [_Cell(i, problem, players.put) for i, (problem, _) in enumerate(made)]
    by_name = {cell.problem.name: cell for cell in cells}

    def ordered(sample: zenoh.Sample) -> None:
        now_ns = time.monotonic_ns()
        by_name[str(sample.key_expr).split("/")[1]].ordered(
            decode(sample.payload.to_bytes(), Order), now_ns
        )

    players.subscribe("stamper@R1", "dwell/*/order", ordered)
    players.subscribe("stamper@R1", "dwell/*/beat/**", lambda _: None)
    players.subscribe("agent@E", "dwell/*/relay/**", lambda _: None)
    arguments = [part for _, path in made for part in ("--cell", str(path))]
    out = folder / "runs"
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "dwell", "controller", "--out", str(out), *arguments],
            stdout=log,
            stderr=log,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
    stack.callback(process.wait)
    stack.callback(process.kill)
    until = time.monotonic() + START_S
    while not all(cell.begun for cell in cells):
        if time.monotonic() > until or process.poll() is not None:
            raise RuntimeError(f"{len(made)} cells: {(folder / 'log').read_text()[-500:]}")
        time.sleep(0.05)
    _play(cells, 3.0, at_once=at_once)
    for cell in cells:
        cell.delays_ms.clear()
        cell.silent = 0
    watched = psutil.Process(process.pid)
    before, begin = watched.cpu_times(), time.monotonic()
    late_ms = _play(cells, seconds, at_once=at_once)
    passed, after = time.monotonic() - begin, watched.cpu_times()
    process.send_signal(signal.SIGTERM)
    process.wait(60)
    delays = np.array([delay for cell in cells for delay in cell.delays_ms] or [np.inf])
    used_s = after.user + after.system - before.user - before.system
    return {
        "p50": float(np.percentile(delays, 50)),
        "p99": float(np.percentile(delays, 99)),
        "longest": float(delays.max()),
        "late": float(np.percentile(late_ms, 99)),
        "dropped": float(sum(_dropped(each) for each in out.iterdir())),
        "silent": float(sum(cell.silent for cell in cells)),
        "cpu": 100 * used_s / passed,
        "decisions": len(delays),
    }


def _play(cells: list[_Cell], seconds: float, *, at_once: bool) -> list[float]:
    """Do what is due until the time is over, and then what is under way; returns how late, ms."""
    late_ms: list[float] = []
    spread_ns = 0 if at_once else WINDOW * PERIOD_NS + PERIOD_NS
    number = count()
    begin_ns = time.monotonic_ns() + 50_000_000
    end_ns = begin_ns + round(seconds * 1e9)
    due: list[tuple[int, int, str, _Cell, Any]] = []
    for i, cell in enumerate(cells):
        phase_ns = begin_ns + spread_ns * i // len(cells)
        heapq.heappush(due, (phase_ns, next(number), "release", cell, None))
        heapq.heappush(due, (phase_ns + LOAD_NS * i // len(cells), next(number), "load", cell, 0))
    while due:
        at_ns, _, what, cell, stamp = heapq.heappop(due)
        wait_s = (at_ns - time.monotonic_ns()) / 1e9
        if wait_s > 0:
            time.sleep(wait_s)
        late_ms.append((time.monotonic_ns() - at_ns) / 1e6)
        if what == "release":
            stamp = cell.release(at_ns)
            heapq.heappush(due, (at_ns + LATENCY_NS, next(number), "complete", cell, stamp))
            if at_ns + PERIOD_NS < end_ns:
                heapq.heappush(due, (at_ns + PERIOD_NS, next(number), "release", cell, None))
        elif what == "complete":
            cell.complete(stamp, at_ns)
            cell.gather(at_ns)
        else:
            cell.load(at_ns)
            if at_ns + LOAD_NS < end_ns:
                heapq.heappush(due, (at_ns + LOAD_NS, next(number), "load", cell, 0))
    return late_ms


def _dropped(folder: Path) -> int:
    """Cycles in the record whose completion, which was sent, is missing from it."""
    cycles = open_run(folder).cycles
    return int((cycles["outcome"] != "done").sum())
