"""The results of every placement on the draws of a run."""

from __future__ import annotations

import pytest

import dwell
from dwell.study.other_placements import other_placements
from dwell.study.summary import summarise


def test_they_are_the_numbers_of_runs_of_these_placements() -> None:
    problem = dwell.load("examples/canonical.yaml")
    drawn = dwell.draw(problem, scenario="edge-cpu-stress", seed=3, windows=20)
    found = other_placements(problem, drawn)
    assert list(found) == ["LOC", "SO", "HYB"]
    for name, numbers in found.items():
        run = dwell.simulate_realisation(problem, drawn, policy=name)
        row = summarise(run, problem, {}).row
        assert numbers == {key: pytest.approx(row[key], rel=0, abs=0) for key in numbers}
    assert set(found["LOC"]) == {"violation_rate", "l95_ms", "cost"}


def test_the_initial_placement_is_first_and_some_are_left_out() -> None:
    problem = dwell.load("examples/canonical.yaml").under("HYB")
    assert problem.initial == "HYB"
    drawn = dwell.draw(problem, seed=1, windows=8)
    assert list(other_placements(problem, drawn, most=2)) == ["HYB", "LOC"]


def test_a_known_run_is_not_simulated_again() -> None:
    problem = dwell.load("examples/canonical.yaml")
    drawn, other = (dwell.draw(problem, seed=seed, windows=8) for seed in (1, 2))
    known = {"SO": dwell.simulate_realisation(problem, other, policy="SO")}
    found = other_placements(problem, drawn, known=known)
    assert found["SO"] == other_placements(problem, other)["SO"]
    assert found["LOC"] == other_placements(problem, drawn)["LOC"]
