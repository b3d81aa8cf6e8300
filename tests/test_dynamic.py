"""The dynamic scenarios do what their page says: no placement is the best all the time."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from dwell.model import Problem
from dwell.sim import draw, simulate_realisation
from tests.cells.dynamic import dynamic_problem

WINDOWS, SEEDS = 300, (101, 102)
WINDOW_S = 100 / 30


@functools.cache
def problem() -> Problem:
    return dynamic_problem()


@functools.cache
def costs(scenario: str) -> Mapping[str, NDArray[np.float64]]:
    """Return J of every candidate that never moves: seeds in rows, windows in columns."""
    rows: dict[str, list[NDArray[np.float64]]] = {name: [] for name in problem().candidates}
    for seed in SEEDS:
        realisation = draw(problem(), scenario=scenario, seed=seed, windows=WINDOWS)
        for name, found in rows.items():
            run = simulate_realisation(problem(), realisation, policy=name)
            found.append(run.windows["cost"].to_numpy())
    return {name: np.array(found) for name, found in rows.items()}


@pytest.mark.parametrize(
    ("scenario", "begin_s", "end_s", "order"),
    [
        ("step", 95, 195, "SO LOC"),
        ("step", 295, 395, "LOC HYB SO"),
        ("step", 495, 595, "LOC SO"),
        ("step", 795, 895, "HYB SO LOC"),
        ("drift", 115, 220, "LOC HYB SO"),
        ("drift", 320, 490, "SO LOC"),
        ("drift", 650, 740, "SO HYB LOC"),
        ("drift", 740, 840, "LOC SO HYB"),
        ("drift", 880, 980, "SO LOC"),
    ],
)
def test_the_order_of_the_placements(
    scenario: str, begin_s: float, end_s: float, order: str
) -> None:
    windows = slice(int(np.ceil(begin_s / WINDOW_S)), int(end_s / WINDOW_S))
    means = [costs(scenario)[name][:, windows].mean() for name in order.split()]
    assert means == sorted(means)
    assert means[-1] - means[0] > 0.5


@pytest.mark.parametrize("scenario", ["bursts", "mixture"])
def test_each_placement_is_the_best_in_some_windows(scenario: str) -> None:
    found = np.stack([costs(scenario)[name] for name in ("LOC", "SO", "HYB")])
    shares = [(found.argmin(axis=0) == row).mean() for row in range(3)]
    assert min(shares[:2]) > 0.25
    assert shares[2] > 0.05


def test_flapping_turns_the_order_by_about_what_a_move_must_gain() -> None:
    settings, weights = problem().controller, problem().objective.weights
    price = settings.min_improvement + weights.switching / 2
    flap = problem().scenario("flapping")[1]
    assert flap.episodes is not None
    gaps = []
    for row, seed in enumerate(SEEDS):
        realisation = draw(problem(), scenario="flapping", seed=seed, windows=WINDOWS)
        slow = np.zeros(WINDOWS)
        instants = np.arange(0, WINDOWS * WINDOW_S, 0.05)
        parts = [part for part in realisation.link_segments if part.link == "R1->R2"]
        begins = np.array([part.at_ns for part in parts]) / 1e9
        on = np.array([bool(part.layers) for part in parts])
        state = on[np.searchsorted(begins, instants, side="right") - 1]
        np.add.at(slow, (instants / WINDOW_S).astype(int), state * 0.05 / WINDOW_S)
        gap = (costs("flapping")["LOC"] - costs("flapping")["SO"])[row]
        gaps.append([gap[slow < 0.01].mean(), gap[slow > 0.99].mean()])
    off, slower = np.mean(gaps, axis=0)
    assert -1.7 * price < off < -0.3 * price
    assert 0.6 * price < slower < 2 * price
