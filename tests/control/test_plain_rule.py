"""Which controllers have a plain rule, by which an engine may decide itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.control import Controller, plain_rule
from dwell.cost import hamming
from dwell.model import Targets
from dwell.policies import DTP

CELL = Path(__file__).parents[2] / "examples" / "canonical.yaml"


@pytest.mark.parametrize("policy", ["dtp", "cusum", "latency-first", "atp", "LOC"])
def test_the_examples_are_decided_by_the_kernel(policy: str) -> None:
    """None of them is silently left to Python."""
    problem = dwell.load(CELL)
    assert plain_rule(Controller(problem, policy, "profile")) is not None
    assert plain_rule(Controller(problem, policy, "scaling")) is None


def test_a_policy_that_is_not_exactly_ours_is_asked() -> None:
    class Mine(DTP):
        """A policy of a user's."""

    problem = dwell.load(CELL)
    other = replace(problem.objective, targets=Targets(1.0))
    assert plain_rule(Controller(problem, Mine.from_problem(problem), "profile")) is None
    apart = DTP(candidates=problem.candidates, objective=other)
    assert plain_rule(Controller(problem, apart, "profile")) is None


def test_numbers_are_in_the_order_of_candidates_and_nodes() -> None:
    problem = dwell.load(CELL)
    plain = plain_rule(Controller(problem, "dtp", "profile"))
    assert plain is not None
    assert plain.tiers == ("robot", "edge", "robot")
    assert plain.work.shape == (len(problem.candidates), len(problem.fabric.nodes))
    for row, before in enumerate(problem.candidates.values()):
        for column, after in enumerate(problem.candidates.values()):
            assert plain.switching[row, column] == hamming(after, before)
