"""Tests of the cell and of its policy: `python test_cell.py`, or pytest."""

from __future__ import annotations

from pathlib import Path

import dwell
from dwell.policies import by_name, check_policy

CELL = Path(__file__).with_name("cell.yaml")
POLICY = "policy:Patient"  # change: the name of your class


def test_the_policy_keeps_to_the_rules() -> None:
    """Extreme windows do not make it fail, or return a name that is no candidate."""
    problem = dwell.load(CELL)
    assert check_policy(by_name(POLICY, problem), problem) == ()


def test_the_policy_runs_the_cell() -> None:
    """It runs in every scenario; the same seed gives the same run."""
    problem = dwell.load(CELL)
    windows = problem.warmup_windows + 5
    for scenario in problem.scenarios:
        run, again = (
            dwell.simulate(problem, scenario=scenario, policy=POLICY, seed=1, windows=windows)
            for _ in range(2)
        )
        assert set(run.windows["placement"]) <= set(problem.candidates)
        assert run.decisions.equals(again.decisions)
        # Change: add the bounds of your cell, as
        # assert run.windows["violation_rate"].mean() < 0.05


if __name__ == "__main__":
    test_the_policy_keeps_to_the_rules()
    test_the_policy_runs_the_cell()
    print("the cell and its policy pass")
