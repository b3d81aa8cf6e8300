"""Moves: those of the controller and of the guard, against the cycles of a run."""

from __future__ import annotations

import numpy as np
import pytest

import dwell
from dwell.record import Run, arrays_of, moves, moves_in
from dwell.record.moves import by_guard
from tests.cells.examples import EXAMPLES


@pytest.fixture(scope="module")
def run() -> Run:
    """A run in which the guard leaves an edge that crashes, and the policy moves, too."""
    cell = dwell.load(EXAMPLES / "fan-in.yaml")
    return dwell.simulate(cell, scenario="edge-crash", policy="dtp", seed=1, windows=15, guard=True)


def test_cycles_follow_the_moves(run: Run) -> None:
    found = moves(run)
    assert [move.reason for move in found] == ["migrate", "guard", "migrate"]
    placed = run.cycles["placement"].cast(str).to_list()
    changes = [i for i in range(1, len(placed)) if placed[i] != placed[i - 1]]
    assert [(placed[i - 1], placed[i]) for i in changes] == [(m.source, m.target) for m in found]
    for move, change in zip(found, changes, strict=True):
        # An order, or the news of the guard's move, takes a cycle or two.
        assert abs(run.cycles["cycle"][change] - move.cycle) <= 3


def test_a_move_comes_after_its_window(run: Run) -> None:
    windows = run.windows
    last = dict(zip(windows["window"], windows["first_cycle"] + 99, strict=True))
    for move in moves(run):
        assert last[move.window] < move.cycle <= last[move.window + 1]


def test_rows_are_those_of_the_decisions(run: Run) -> None:
    decisions = run.decisions
    found = moves(run)
    assert [move.row for move in found] == np.flatnonzero(decisions["migrated"]).tolist()
    assert [str(decisions["reason"][move.row]) for move in found] == [one.reason for one in found]


def test_lists_of_a_journal_have_the_same_moves(run: Run) -> None:
    names = ("window", "last_cycle", "incumbent", "placement", "reason", "migrated")
    lists = {name: run.decisions[name].to_list() for name in names}
    assert moves_in(lists) == moves(run)


def test_rows_of_the_guard_are_known_without_a_frame(run: Run) -> None:
    guarded = np.flatnonzero(by_guard(arrays_of(run.decisions))).tolist()
    assert set(guarded) >= {move.row for move in moves(run) if move.by_guard}
