"""The clairvoyant's plan: dynamic programming over 10 000 windows of 3 candidates."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, shared_core, took
from dwell.study.clairvoyant import clairvoyant

WINDOWS, CANDIDATES = 10_000, 3
DWELLS = (0, 3, 10)
GOAL = Goal(high=50)


def measure(quick: bool) -> Section:
    """Milliseconds a plan takes without a dwell and with shorter and longer ones."""
    # Costs that change all the time: a plan with as many migrations as the dwell permits.
    costs = np.random.default_rng(1).random((WINDOWS, CANDIDATES))
    switching = 0.1 * (1 - np.eye(CANDIDATES))
    variants: dict[int, Callable[[], Took]] = {
        dwell: partial(took, partial(clairvoyant, costs, switching, initial=0, min_dwell=dwell))
        for dwell in DWELLS
    }
    runs = in_turns(variants, 5 if quick else 15)
    figures = [
        Figure(f"N_min = {dwell}", [1e3 * run.cpu_s for run in runs[dwell]], "ms", GOAL)
        for dwell in DWELLS
    ]
    notes = shared_core(run for some in runs.values() for run in some)
    title = f"Planning {WINDOWS:,} windows of {CANDIDATES} candidates".replace(",", " ")
    return Section(title, figures, notes)
