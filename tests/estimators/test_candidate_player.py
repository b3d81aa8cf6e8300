"""Cells on common samples: alone, in a fleet, step by step, under measured conditions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.measured import Message, Site
from dwell.estimators.present import Present
from dwell.estimators.stepwise_player import StepwisePlayer
from dwell.kernels.random_draws import draw
from dwell.model import FrozenDict, Problem

EXAMPLES = Path(__file__).parents[2] / "examples"
CANONICAL, FAN_IN = (dwell.load(EXAMPLES / f"{name}.yaml") for name in ("canonical", "fan-in"))


def presents(problem: Problem) -> dict[str, Present]:
    rng = np.random.default_rng(3)
    site, message = Site("perception", "E"), Message("sensing", "perception", "R1->E")
    late = rng.uniform(1, 9, 70)
    late[::10] = np.inf
    return {
        "demands": Present(FrozenDict({site: rng.uniform(5, 20, 37), message: late})),
        "threads": Present(threads=FrozenDict({"R1": 2.4, "E": -0.5})),
        "down": Present(down=frozenset({"R2"})),
        "rates": Present(rates_mbps=FrozenDict({"R1->E": 20.0})),
    }


KINDS = list(presents(CANONICAL))


def seen(player: CandidatePlayer, index: int, name: str) -> list[object]:
    """Return the windows of a cell, while every other cell is on its initial candidate."""
    placed = {i: problem.initial for i, (problem, _) in enumerate(player.cells)}
    windows = player.windows(player.play({**placed, index: name}), index)
    return [windows.l95_ms.tolist(), windows.missed.tolist(), windows.shares.tolist()]


@pytest.mark.parametrize("kind", KINDS)
def test_a_cell_of_a_fleet_has_its_own_measured_conditions(kind: str) -> None:
    cells = [(one, draw(one, seed=1, windows=4)) for one in (FAN_IN, CANONICAL)]
    present = presents(CANONICAL)[kind]
    fleet, alone = (CandidatePlayer(some, measures=True) for some in (cells, cells[1:]))
    plain, name = CandidatePlayer(cells), CANONICAL.initial
    fleet.begin({1: present})
    alone.begin({0: present})
    for candidate in CANONICAL.candidates:
        assert seen(fleet, 1, candidate) == seen(alone, 0, candidate)
    assert any(seen(fleet, 1, one) != seen(plain, 1, one) for one in CANONICAL.candidates)
    assert seen(fleet, 0, FAN_IN.initial) == seen(plain, 0, FAN_IN.initial)
    fleet.begin({1: Present()})
    assert seen(fleet, 1, name) == seen(plain, 1, name)


@pytest.mark.parametrize("kind", KINDS)
def test_steps_are_windows_of_a_cell_played_at_once(kind: str) -> None:
    present, stepwise = presents(CANONICAL)[kind], StepwisePlayer(CANONICAL)
    stepwise.begin(present)
    stepwise.go_on(present, list(CANONICAL.candidates), steps=4)
    player = CandidatePlayer([(CANONICAL, stepwise.declared.realisation)], measures=True)
    player.begin({0: present})
    for candidate in CANONICAL.candidates:
        windows = player.windows(player.play({0: candidate}), 0, 1, 4)
        twin = player.windows(stepwise._twins[candidate].arrays, 0, 1, 4)
        assert windows.l95_ms.tolist() == twin.l95_ms.tolist()
        assert windows.missed.tolist() == twin.missed.tolist()


def test_cells_that_are_not_placed_are_left_out() -> None:
    cells = [(one, draw(one, seed=1, windows=2)) for one in (CANONICAL, CANONICAL)]
    player, alone = CandidatePlayer(cells, ["E"]), CandidatePlayer(cells[:1])
    windows = player.windows(player.play({0: "SO"}), 0)
    assert windows.l95_ms.tolist() == alone.windows(alone.play({0: "SO"})).l95_ms.tolist()
