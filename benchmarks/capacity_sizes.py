"""Capacity of a candidate at random phases: time to simulate all sizes up to 64 robots."""

from __future__ import annotations

from dataclasses import replace

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import in_turns, shared_core, took
from dwell.model.fleet import Fleet, FleetEntry
from dwell.study.capacity import DRAWS, capacity_of

SIZES, CORES = 64, 2
GOAL = Goal(high=60.0)


def measure(quick: bool) -> Section:
    """Return the time of a study with default draws, from fewer draws in one process."""
    draws, rounds = (1, 2) if quick else (4, 3)
    cell = dwell.load(CELL)
    edge = cell.fabric.nodes["E"]
    # All sizes are simulated, because none exceeds the limit.
    nodes = {**cell.fabric.nodes, "E": replace(edge, cores=edge.cores * SIZES)}
    big = replace(cell, fabric=replace(cell.fabric, nodes=nodes))
    fleet = Fleet("hall", (FleetEntry(big, 1),), ("E",), "random", "none", policy="SO")

    def play() -> None:
        found = capacity_of(fleet, most=SIZES, limit=0.99, seeds=DRAWS[:draws], processes=1)
        if len(found.curve) != SIZES:
            raise RuntimeError(f"{len(found.curve)} sizes were simulated instead of {SIZES}")

    play()  # loads modules and computes prices
    runs = in_turns({"capacity": lambda: took(play)}, rounds)["capacity"]
    seconds = [run.cpu_s * len(DRAWS) / draws / CORES for run in runs]
    figure = Figure(f"{SIZES} sizes on {CORES} cores", seconds, "s", GOAL)
    note = f"CPU time of {draws} of {len(DRAWS)} draws, extrapolated"
    return Section("Capacity of a candidate", [figure], [note, *shared_core(runs)])
