"""What a live cell of real processes takes and does: orders, moves, and its share of a core.

All processes run on this machine and read one clock; links between nodes are emulated.
"""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import mean
from typing import Any

import psutil

from benchmarks.figures import Figure, Goal, Section
from benchmarks.live_cell import ARRIVED, NUMBER, LightCell, document
from dwell.record import open_run

PERIOD_MS = 40.0
DELAY_MS = 5.0
#: Controllers of one cell at 25 Hz are meant to take less of a core.
CONTROLLER_SHARE = 2.0
MOVES = 21


def everywhere() -> None:
    """Undo the pinning of the parent: a cell's processes take what cores there are."""
    os.sched_setaffinity(0, range(os.cpu_count() or 1))


@contextmanager
def cell_of(found: dict[str, Any], *, links: bool) -> Iterator[LightCell]:
    everywhere()
    with (
        tempfile.TemporaryDirectory() as folder,
        LightCell(found, Path(folder) / "cell", links=links) as cell,
    ):
        yield cell


# ------------------------------------------------------------------------------ decision


def decision(quick: bool) -> Section:
    """From a person's order, at any phase of the period, to the first cycle that follows it."""
    count = 10 if quick else 40
    draw = random.Random(1)
    asked: list[tuple[int, str]] = []
    # Short windows: what is in none is recorded with the next.
    found = document("decision", period_ms=PERIOD_MS, delay_ms=DELAY_MS, window_cycles=3)
    with cell_of(found, links=True) as cell:
        for number in range(count):
            target = ("SO", "LOC")[number % 2]
            time.sleep(draw.uniform(0.36, 0.40))
            asked.append((time.monotonic_ns(), target))
            cell.client.ask("pin", target)
            cell.wait_until_at(target)
        cell.processes.stop_controller()
        run = open_run(next((cell.folder / "runs").iterdir()))
        origin_ns = run.meta["origin_ns"]
        rows = run.cycles.select("release_ns", "placement").rows()
    starts = [
        (origin_ns + release_ns, placement)
        for (_, before), (release_ns, placement) in pairwise(rows)
        if placement != before
    ]
    waits = []
    for asked_ns, target in asked:
        after = (at_ns for at_ns, to in starts if to == target and at_ns > asked_ns)
        if (first_ns := next(after, None)) is not None:
            waits.append((first_ns - asked_ns) / 1e6)
    bound_ms = PERIOD_MS + DELAY_MS
    late = 100 * mean(wait > bound_ms for wait in waits)
    return Section(
        f"From an order to the release of the first cycle that follows it, P = {PERIOD_MS:g} ms",
        [
            Figure("order to first cycle", waits, "ms", Goal(high=bound_ms)),
            Figure("longer than one period + one delay", [late], "%"),
        ],
        [
            f"{len(waits)} of {count} orders at random phases; the way to the stamper takes "
            f"{DELAY_MS:g} ms",
            "from the question of a person, so that its way to the controller is in it",
        ],
    )


# ---------------------------------------------------------------------------------- moves


def moves(quick: bool) -> Section:
    """A stage moved between two nodes at 100 Hz over links of 25 ± 5 ms."""
    found = [_moved(seed) for seed in range(1 if quick else 2)]
    none = Goal(high=0)
    goals = {"lost": none, "doubled": none, "applied twice": none, "applied out of order": none}
    figures = [
        Figure(what, [one[what] for one in found], "", goals.get(what))
        for what in found[0]
        if what != "longest gap"
    ]
    figures.append(Figure("longest gap at the actuator", [o["longest gap"] for o in found], "ms"))
    return Section(
        f"{MOVES} moves of a stage, 100 Hz, 25 ± 5 ms each way",
        figures,
        [
            "lost and doubled: where messages arrive, before the last worker takes the newest",
            "overtaken: it arrived after a later one and was not applied",
            "replacing a node in dora-rs 1.1 on one machine: 53 lost, 686 ms",
        ],
    )


def _moved(seed: int) -> dict[str, float]:
    cell_file = document(
        f"moves{seed}",
        period_ms=10,
        tasks={"first": ["R1"], "second": ["E", "R2"], "last": ["R1"]},
        candidates={"EDGE": {"second": "E"}, "OTHER": {"second": "R2"}},
        flows=(("first", "second"), ("second", "last")),
        delay_ms={"normal": {"mean": 25, "std": 5, "min": 0}},
        fallbacks=(),
    )
    cell_file["tasks"]["last"]["run"] = "benchmarks.live_cell:Counting"
    draw = random.Random(seed)
    with cell_of(cell_file, links=True) as cell:
        begin = cell.applied()[-1].cycle
        for number in range(MOVES):
            target = ("OTHER", "EDGE")[number % 2]
            time.sleep(draw.uniform(0.2, 0.3))
            cell.client.ask("pin", target)
            cell.wait_until_at(target)
        time.sleep(0.5)
        applied = [one for one in cell.applied() if one.cycle >= begin]
        end = applied[-1].cycle
        arrived = [n for (n,) in NUMBER.iter_unpack((cell.folder / ARRIVED).read_bytes())]
    arrived = [number for number in arrived if begin <= number <= end]
    numbers = [one.cycle for one in applied]
    return {
        "cycles": end - begin + 1,
        "lost": end - begin + 1 - len(set(arrived)),
        "doubled": sum(count - 1 for count in Counter(arrived).values()),
        "arrived out of order": sum(b < a for a, b in pairwise(arrived)),
        "applied twice": len(numbers) - len(set(numbers)),
        "applied out of order": sum(b <= a for a, b in pairwise(numbers)),
        "overtaken": end - begin + 1 - len(set(numbers)),
        "longest gap": max(b.at_ns - a.at_ns for a, b in pairwise(applied)) / 1e6,
    }


# ---------------------------------------------------------------------------------- share


def share(quick: bool) -> Section:
    """CPU time of every kind of process of a cell at 25 Hz whose stages do nothing."""
    runs, seconds = (1, 8.0) if quick else (3, 10.0)
    found: dict[str, list[float]] = {}
    with cell_of(document("share", period_ms=PERIOD_MS), links=False) as cell:
        time.sleep(3)
        processes = processes_of(cell)
        for _ in range(runs):
            begin = time.monotonic()
            before = {who: cpu_s(each) for who, each in processes.items()}
            time.sleep(seconds)
            passed = time.monotonic() - begin
            kinds: dict[str, list[float]] = {}
            for who, each in processes.items():
                kinds.setdefault(_kind(who, cell), []).append(
                    100 * (cpu_s(each) - before[who]) / passed
                )
            for kind, shares in kinds.items():
                found.setdefault(kind, []).append(mean(shares))
            found.setdefault("all together", []).append(sum(map(sum, kinds.values())))
    goals = {"controller": Goal(high=CONTROLLER_SHARE)}
    return Section(
        f"Share of a core, cell at {1e3 / PERIOD_MS:g} Hz, {len(processes)} processes",
        [Figure(kind, found[kind], "%", goals.get(kind)) for kind in sorted(found)],
        [f"CPU time, user and kernel, over {seconds:g} s; mean of the processes of a kind"],
    )


def cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def processes_of(cell: LightCell) -> dict[str, psutil.Process]:
    found = {who: psutil.Process(pid) for who, pid in cell.pids().items()}
    for who, top in cell.processes.running.items():
        found[who] = psutil.Process(top.pid)
    return found


def _kind(who: str, cell: LightCell) -> str:
    name, _, node = who.partition("@")
    if node.endswith(".shadow"):
        return "shadow worker"
    if name == "agent":
        return "agent of the relay" if node == cell.problem.controller_node else "agent"
    if name in ("stamper", "controller"):
        return name
    if name.startswith("sink."):
        return "sink"
    placed = cell.problem.candidates[cell.problem.initial][name]
    return "worker" if placed == node else "worker without cycles"
