"""Cells whose candidates come from a search."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.estimators import searched
from dwell.model import ControllerSettings, NodeDisturbance, Placement, Problem, QoS
from dwell.model.every_placement import EveryPlacement
from dwell.study import compare
from tests.cells.random_dags import random_dag

CANONICAL = dwell.load(Path(__file__).parents[2] / "examples" / "canonical.yaml")


def with_search(
    problem: Problem, keep: int = 8, named: Mapping[str, Placement] | None = None
) -> Problem:
    """Return the problem with a search in addition to the named candidates."""
    controller = ControllerSettings(policy="dtp", estimator="corrected")
    return replace(
        problem,
        candidates=named or {},
        controller=controller,
        every_placement=EveryPlacement(keep),
    )


def test_the_candidates_are_the_cheapest_without_each_node_and_the_next_cheapest() -> None:
    problem = with_search(CANONICAL, keep=4)
    found = searched(problem).candidates
    ranked = [placement for placement, _, _ in dwell.search(problem, top=4)]
    tasks = [name for name, task in problem.pipeline.tasks.items() if not task.anchored]

    def cheapest_without(node: str) -> Placement:
        return next(one for one in ranked if node not in {one[name] for name in tasks})

    first = ranked[0]
    others = [cheapest_without(node) for node in dict.fromkeys(first.first[name] for name in tasks)]
    expected = list(dict.fromkeys((first, *others, *ranked)))
    assert found == dict(zip(["A1", "A2", "A3", "A4"], expected, strict=True))
    assert list(found.values()) != ranked


def test_named_candidates_are_first_and_not_found_again() -> None:
    problem = with_search(CANONICAL, keep=4)
    free = list(searched(problem).candidates.values())
    named = {"A2": free[1], "mine": free[2]}
    found = searched(with_search(CANONICAL, 4, named)).candidates
    assert list(found.items()) == [*named.items(), ("A1", free[0]), ("A3", free[3])]


def test_all_shadows_together_are_as_many_as_with_three_candidates() -> None:
    assert searched(with_search(CANONICAL, keep=2)).shadow_fraction == 0.05
    assert searched(with_search(CANONICAL, keep=4)).shadow_fraction == 0.1 / 3


def test_a_cell_is_searched_once() -> None:
    problem = searched(with_search(CANONICAL, keep=2))
    assert searched(problem) is problem
    assert searched(CANONICAL) is CANONICAL


def test_a_cell_without_a_feasible_placement_says_why() -> None:
    problem = with_search(CANONICAL)
    lonely = replace(problem, fabric=replace(problem.fabric, links={}), scenarios={})
    with pytest.raises(ProblemError, match=r"candidates\.all: no placement .* without a link"):
        searched(lonely)


def test_a_cell_without_enough_cores_says_so() -> None:
    problem = with_search(random_dag(3))
    quick = replace(problem.pipeline, period_ms=0.1, deadline_ms=0.1)
    with pytest.raises(ProblemError, match="over the capacity of R"):
        searched(replace(problem, pipeline=quick))


def test_a_run_keeps_its_candidates(tmp_path: Path) -> None:
    problem = with_search(CANONICAL, keep=2)
    run = dwell.simulate(problem, seed=1, windows=6)
    run.save(tmp_path / "run")
    kept = dwell.open_run(tmp_path / "run").problem
    assert kept.candidates == searched(problem).candidates
    assert not kept.is_searched
    realisation = dwell.draw(kept, seed=1, windows=6)
    again = dwell.simulate_realisation(problem, realisation)
    assert again.cycles.equals(run.cycles)


def test_a_realisation_needs_candidates() -> None:
    with pytest.raises(ProblemError, match="search first"):
        dwell.draw(with_search(CANONICAL), seed=1, windows=1)


def test_studies_search() -> None:
    found = compare(
        with_search(CANONICAL, keep=2),
        scenarios=["baseline"],
        policies=["A1", "A2"],
        seeds=[1],
        windows=6,
        processes=1,
    )
    assert set(found.runs["policy"]) == {"A1", "A2"}


class Watcher:
    """A policy that stays, and keeps the estimates."""

    initial = "A1"
    seen: ClassVar[list[Mapping[str, QoS]]] = []

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        Watcher.seen.append(estimates)
        return self.initial


def last_estimates(problem: Problem) -> Mapping[str, QoS]:
    """Return the estimates after some windows in which two nodes are stressed."""
    stressed = {
        "stress": (NodeDisturbance("E", stress_threads=6), NodeDisturbance("R1", stress_threads=3))
    }
    problem = replace(problem, scenarios=stressed)
    dwell.simulate(
        problem, scenario="stress", policy=Watcher(), estimator="corrected", seed=1, windows=8
    )
    return Watcher.seen[-1]


def test_errors_of_differences_are_from_common_samples() -> None:
    problem = searched(with_search(CANONICAL, keep=4))
    estimates = last_estimates(problem)
    here = estimates["A1"]
    assert here.paired == (0.0, 0.0)
    for qos in (qos for name, qos in estimates.items() if name != "A1"):
        assert qos.error is not None
        assert here.error is not None
        assert qos.paired is not None
        assert 0.0 < qos.paired[0] <= math.hypot(qos.error[0], here.error[0])
    # Both detect on R1, so their errors are mostly those of the same cycles.
    (alike,) = (
        estimates[name]
        for name, placement in problem.candidates.items()
        if name != "A1" and placement["perception"] == problem.candidates["A1"]["perception"]
    )
    assert alike.error is not None
    assert alike.paired is not None
    assert alike.paired[0] < 0.5 * alike.error[0]


def test_other_cells_have_no_errors_of_differences() -> None:
    problem = replace(searched(with_search(CANONICAL, keep=4)), every_placement=None)
    assert {qos.paired for qos in last_estimates(problem).values()} == {None}
