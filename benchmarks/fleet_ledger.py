"""A fleet under its ledger, beside single cells: cell-cycles a second, a round, a quiet close."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from statistics import median

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, shared_core, took
from dwell.control.coordination import Verdict, Wish
from dwell.control.ledger import Seat
from dwell.estimators.candidate_player import CandidatePlayer
from dwell.kernels.arrays import Arrays
from dwell.model.fleet import Fleet, FleetEntry

#: Share of the single cell's rate, by estimator and coordination.
GOALS = {
    ("profile", "ledger"): Goal(low=0.3),
    ("corrected", "ledger"): Goal(low=0.4),
    ("profile", "none"): Goal(low=0.5),
}
#: Closes at which the ledger simulates nothing, and those at which it simulates the fleet.
NOTHING, ROUND = "a close that proposes nothing", "a round"


def measure(quick: bool) -> Section:
    """Share of the single cell's rate, and what the ledger takes at closes."""
    size, windows, rounds = (16, 30, 2) if quick else (64, 100, 3)
    cell = dwell.load(CELL)
    edge = cell.fabric.nodes["E"]
    nodes = {**cell.fabric.nodes, "E": replace(edge, cores=edge.cores * size)}
    big = replace(cell, fabric=replace(cell.fabric, nodes=nodes))
    fleet = Fleet("hall", (FleetEntry(big, size),), ("E",), "random", "ledger")
    spent: dict[str, list[float]] = {NOTHING: [], ROUND: []}
    figures, notes = [], []
    for (estimator, coordination), goal in GOALS.items():
        given = fleet.changed(estimator=estimator, coordination=coordination)
        dwell.simulate_fleet(given, windows=1)  # makes the table of loads
        variants: dict[str, Callable[[], Took]] = {
            "cells": partial(_cells, size, estimator, windows),
            "fleet": partial(_fleet, given, windows),
        }
        with _timed(spent):
            runs = in_turns(variants, rounds)
        pairs = zip(runs["cells"], runs["fleet"], strict=True)
        rates = [alone.cpu_s / together.cpu_s for alone, together in pairs]
        name = f"{size} cells, {estimator}, {coordination}, over single ones"
        figures.append(Figure(name, rates, "", goal))
        notes += shared_core(run for some in runs.values() for run in some)
    goals = Goal(high=10.0), Goal(high=20_000.0)
    for (what, times), goal in zip(spent.items(), goals, strict=True):
        figures.append(Figure(f"{what}, {size} cells", [median(times)], "µs", goal))
    return Section("A fleet under its ledger", figures, list(dict.fromkeys(notes)))


def _cells(size: int, estimator: str, windows: int) -> Took:
    """Play as many cells, one after another."""
    cell = dwell.load(CELL)
    return took(
        lambda: [
            dwell.simulate(cell, seed=seed, windows=windows, estimator=estimator)
            for seed in range(size)
        ]
    )


def _fleet(fleet: Fleet, windows: int) -> Took:
    return took(lambda: dwell.simulate_fleet(fleet, windows=windows))


@contextmanager
def _timed(spent: dict[str, list[float]]) -> Iterator[None]:
    """Time what every seat of a ledger takes to consider a decision, by whether it is played."""
    consider, play, plays = Seat.consider, CandidatePlayer.play, 0

    def counted(self: CandidatePlayer, placed: Mapping[int, str]) -> Arrays:
        nonlocal plays
        plays += 1
        return play(self, placed)

    def timed(self: Seat, wish: Wish) -> Verdict:
        before, begin = plays, time.perf_counter()
        verdict = consider(self, wish)
        took_us = 1e6 * (time.perf_counter() - begin)
        spent[NOTHING if plays == before else ROUND].append(took_us)
        return verdict

    Seat.consider, CandidatePlayer.play = timed, counted  # type: ignore[method-assign]
    try:
        yield
    finally:
        Seat.consider, CandidatePlayer.play = consider, play  # type: ignore[method-assign]
