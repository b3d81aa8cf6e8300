"""RQ1: fair baselines, and what of a gain is the second stage's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from dwell.model import NodeDisturbance
from dwell.policies import ATP
from dwell.policies.atp_thresholds import find_pairs
from dwell.sim import draw, simulate_realisation
from dwell.study.paper import Runner
from dwell.study.paper import concurrent as module
from dwell.study.paper.concurrent import (
    DTP,
    TUNED,
    atp,
    chapter,
    only,
    single_stages,
    stress_scenarios,
    verdict,
)
from dwell.study.paper.variants import with_candidates
from tests.study.paper.families import make_family
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import check_written, told

WINDOWS = 12


@pytest.mark.parametrize(
    ("against", "perception", "planning", "expected"),
    [
        (["lower", "lower"], ["lower", "lower"], ["lower", "lower"], "yes"),
        (["lower", "lower"], ["lower", "lower"], ["lower", "open"], "in part"),
        (["lower", "open"], ["lower", "lower"], ["lower", "lower"], "in part"),
        # What beats ATP is then the rule, or one stage alone, and not both together.
        (["lower", "lower"], ["lower", "lower"], ["open", "same"], "no"),
        (["lower", "open"], ["same", "lower"], ["lower", "lower"], "no"),
        (["higher", "open"], ["open", "open"], ["open", "open"], "no"),
        (["open", "open"], ["open", "open"], ["higher", "open"], "no"),
        (["open", "same"], ["open", "same"], ["lower", "lower"], "not shown"),
    ],
)
def test_the_answer_asks_for_more_than_either_stage_alone(
    against: Sequence[str], perception: Sequence[str], planning: Sequence[str], expected: str
) -> None:
    atps = {f"R{i}: {DTP}, {TUNED}": one for i, one in enumerate(against)}
    atps |= {"R0: dtp+corrected, SO": "higher", "R1: dtp+corrected, SO": "open"}
    single = {f"R{i}: {DTP}, {only(DTP, 'T2')}": one for i, one in enumerate(perception)}
    single |= {f"R{i}: {DTP}, {only(DTP, 'T3')}": one for i, one in enumerate(planning)}
    answer, sentence = told(verdict(make_family(atps), make_family(single), ("T2", "T3"), "SO"))
    assert answer == expected
    assert f"lower V_D in {against.count('lower')} of 2 stress scenarios" in sentence
    for stage, said in (("T2", perception), ("T3", planning)):
        assert f"moving {stage} alone: lower in {said.count('lower')}" in sentence
    assert f"SO, which never moves, misses less than {DTP} in 1, and more in 0" in sentence
    rest = [
        i for i in range(2) if against[i] == "lower" and not perception[i] == planning[i] == "lower"
    ]
    assert ("owed to the rule and its estimates" in sentence) == bool(rest)


def test_sizes_are_named_or_their_range_is() -> None:
    def said(count: int) -> str:
        atps = {f"R{i}: {DTP}, {TUNED}": "lower" for i in range(count)}
        single = {f"R{i}: {DTP}, {only(DTP, 'T2')}": "open" for i in range(count)}
        return told(verdict(make_family(atps), make_family(single), ("T2",), "SO"))[1]

    assert "(R0 −10.0 points, R1 −10.0 points)" in said(2)
    assert "(from −10.0 points in R0 to" in said(5)


def test_the_stages_are_those_that_the_papers_candidates_move() -> None:
    problem = make_cell()
    assert single_stages(problem) == {"T2": ("LOC", "HYB"), "T3": ("HYB", "SO")}


def test_atp_begins_on_its_own_pair() -> None:
    problem = make_cell()
    for pair in find_pairs(problem.candidates, problem.objective.tiers):
        policy = atp(problem, pair, (1.2, np.inf, 0.7, 0))
        assert isinstance(policy, ATP)
        assert policy.initial == pair.local
        assert policy.latency_ms == pytest.approx(1.2 * 33.0)
        assert policy.min_dwell == 0


def test_every_stress_is_there_steady_and_not() -> None:
    found = stress_scenarios(make_cell())
    assert len(found) == 12
    both = found["R1+R2 2 a core on-off"]
    assert all(isinstance(item, NodeDisturbance) for item in both)
    assert [(item.node, item.stress_threads) for item in both] == [("R1", 8), ("R2", 8)]  # type: ignore[union-attr]
    assert len({item.episodes.name for item in both if item.episodes}) == 1
    assert all(item.episodes is None for item in found["R1 1 a core"])


def test_fewer_candidates_play_the_same_realisation() -> None:
    whole = make_cell("robot-cpu-stress")
    part = with_candidates(whole, ("HYB", "SO"))
    assert part.initial == "HYB"
    costs = [
        simulate_realisation(
            problem,
            draw(problem, scenario="robot-cpu-stress", seed=1, windows=WINDOWS),
            policy="SO",
            estimator="profile",
        ).windows["cost"]
        for problem in (whole, part)
    ]
    assert costs[0].to_list() == costs[1].to_list()


def test_the_chapter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, values in (
        ("THREADS_A_CORE", (1,)),
        ("STRESSED", {"R2": ("R2",)}),
        ("LATENCIES", (1.0,)),
        ("ROBOTS", (0.7,)),
        ("EDGES", (0.7, np.inf)),
        ("DWELLS", (0,)),
    ):
        monkeypatch.setattr(module, name, values)
    written = chapter(make_cell(), SCALE, Runner(tmp_path, processes=1))
    check_written(written)
    tables = {table.slug: table.frame for table in written.tables}
    main = tables["concurrent"]
    # Each policy is there once in each scenario: whoever was tuned for another is not.
    assert main["scenario"].n_unique() == 2
    assert not main.select("scenario", "policy").is_duplicated().any()
    assert {"atp best here", TUNED, only(DTP, "T2"), only(DTP, "T3")} <= set(main["policy"])
    tuning = tables["concurrent-tuning"]
    assert tuning.height == 4 + 3
    assert tuning["violation_rate"].is_sorted()
    assert "for all" in tuning["chosen"].to_list()
