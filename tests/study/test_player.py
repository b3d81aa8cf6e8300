"""What a player does of an item: one realisation, played by all, each judged by the point's J."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from polars.testing import assert_frame_equal

import dwell.sim
from dwell import draw, simulate, simulate_realisation
from dwell.errors import SimulationError
from dwell.model import FrozenDict, Problem
from dwell.study import Contender, Study, run_study
from dwell.study.judged_cost import judged_cost, judged_costs
from dwell.study.parts import frame_of
from dwell.study.player import Batch, Player
from dwell.study.summary import summarise
from tests.cells.small import make_problem
from tests.study.test_study import grid, make_study

PROBLEM = make_problem()


def test_an_item_is_a_run_of_every_contender_at_every_point() -> None:
    study = make_study(points=grid(dwells=range(2), delays=range(1, 2)))
    player, item = Player(study, kept=(2,)), study.items()[2]
    played = player(batch_of(study, 2))
    for name in ("LOC", "dtp"):
        rows = [
            (point, one.row["policy"], one.row["seed"]) for point, one in played.summaries[name]
        ]
        assert rows == [(0, name, 2), (1, name, 2)]
    # Runs of a seed that is kept are kept whole.
    labels = [(0, "LOC"), (0, "dtp"), (1, "LOC"), (1, "dtp")]
    assert list(played.examples) == [(item, *label) for label in labels]
    run = simulate(study.points[1].problem, policy="dtp", seed=2, windows=6)
    assert_frame_equal(played.examples[item, 1, "dtp"].decisions, run.decisions)
    assert player(batch_of(study, 0)).examples == {}


def batch_of(study: Study, first: int, count: int = 1, *players: str) -> Batch:
    return Batch(first, study.items()[first : first + count], players or study.players)


def test_a_batch_ends_when_its_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C waits for a batch that is under way, and loses it where there is one process."""
    study = make_study()
    whole = Player(study)(batch_of(study, 1, 4))
    assert (whole.batch, whole.rest) == (batch_of(study, 1, 4), None)
    monkeypatch.setattr("dwell.study.player.BATCH_S", 0.0)
    begun = Player(study)(batch_of(study, 1, 4))
    assert (begun.batch, begun.rest) == (batch_of(study, 1), batch_of(study, 2, 3))
    assert [len(mine) for mine in begun.summaries.values()] == [1, 1]


def test_a_player_of_a_batch_plays_without_the_others() -> None:
    study = make_study(references=True)
    everything = Player(study)(batch_of(study, 0, 2)).summaries
    for name in study.players:
        alone = Player(study)(batch_of(study, 0, 2, name)).summaries
        assert list(alone) == [name]
        for (_, one), (_, other) in zip(alone[name], everything[name], strict=True):
            assert (one.row, one.compared) == (other.row, other.compared)
            assert_frame_equal(frame_of([(0, one)]), frame_of([(0, other)]))


@pytest.mark.parametrize("policy", ["dtp", "latency-first", "SO"])
@pytest.mark.parametrize("scenario", ["baseline", "network-impairment"])
def test_judging_by_the_own_objective_changes_no_bit(policy: str, scenario: str) -> None:
    run = simulate(PROBLEM, scenario=scenario, policy=policy, seed=3, windows=40)
    assert judged_costs(run, PROBLEM).tolist() == run.windows["cost"].to_list()


def test_judging_by_another_objective_is_what_its_controller_would_see() -> None:
    weights = replace(PROBLEM.objective.weights, switching=3.0, edge=0.7)
    other = replace(PROBLEM, objective=replace(PROBLEM.objective, weights=weights))
    realisation = draw(PROBLEM, scenario="network-impairment", seed=3, windows=40)
    # Latency-first looks at no weight: both controllers decide the same.
    one, two = (
        simulate_realisation(problem, realisation, policy="latency-first")
        for problem in (PROBLEM, other)
    )
    assert one.decisions["migrated"].any()
    assert judged_costs(one, other).tolist() == two.windows["cost"].to_list()


def test_windows_that_the_controller_did_not_see_are_not_judged() -> None:
    down = dwell.model.NodeDisturbance("E", at_s=3.0, for_s=2.0, down=True)
    problem = replace(PROBLEM, scenarios=FrozenDict({**PROBLEM.scenarios, "crash": (down,)}))
    run = simulate(problem, scenario="crash", policy="dtp", seed=1, windows=40)
    unseen = run.windows["cost"].is_null()
    assert unseen.any()
    assert np.isnan(judged_costs(run, problem)).tolist() == unseen.to_list()
    assert judged_cost(run, problem) == pytest.approx(summarise(run, problem, {}).row["cost"])


def test_a_run_whose_controller_saw_no_window_is_summed_up() -> None:
    down = dwell.model.NodeDisturbance("E", at_s=0.0, down=True)
    problem = replace(PROBLEM, scenarios=FrozenDict({**PROBLEM.scenarios, "crash": (down,)}))
    run = simulate(problem, scenario="crash", policy="dtp", seed=1, windows=9)
    row = summarise(run, problem, {}).row
    assert math.isnan(float(row["cost"]))
    assert math.isnan(float(row["l95_ms"]))
    assert (row["windows"], row["migrations"]) == (7, 0)
    assert run.decisions.is_empty()


def test_a_worker_with_other_software_refuses() -> None:
    study = make_study()
    player = Player(study, software={**Player(study).software, "numpy": "1.0"})
    with pytest.raises(SimulationError, match=r"numpy \d.*, not numpy 1\.0"):
        player(batch_of(study, 0))


def test_an_unknown_policy_is_found_before_the_work_begins() -> None:
    seen: list[int] = []
    study: Study = make_study(contenders=(Contender("LOC", "LOC"), Contender("dpt", "dpt")))
    with pytest.raises(dwell.errors.PolicyError, match="did you mean 'dtp'"):
        run_study(study, processes=1, progress=lambda done, _: seen.append(done))
    assert seen == []


def test_a_realisation_is_drawn_once_for_all_that_share_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = []

    def counting(problem: Problem, **request: Any) -> object:
        drawn.append((request["scenario"], request["seed"], request["windows"]))
        return draw(problem, **request)

    monkeypatch.setattr(dwell.sim, "draw", counting)
    study = make_study(points=grid(dwells=range(1, 4), delays=range(1, 2)), seeds=(1, 2))
    run_study(study, processes=1)
    whole = [request for request in drawn if request[2] == study.windows]
    assert sorted(whole) == sorted(
        (scenario, seed, 6) for scenario in study.scenarios for seed in (1, 2)
    )


ALONE = """
import pickle, sys
player, batch = pickle.load(sys.stdin.buffer)
played = player(batch)
assert {name: len(mine) for name, mine in played.summaries.items()} == {
    "LOC": 1, "dtp": 1, "clairvoyant": 4
}
print([name for name in ("polars", "typer") if name in sys.modules])
"""


def test_a_worker_plays_and_sums_up_without_tables() -> None:
    """What it loads besides, every worker of a study pays for."""
    study = make_study(references=True)
    sent = pickle.dumps((Player(study), batch_of(study, 0)))
    # A problem with traces is larger; it is sent once to a worker.
    assert len(sent) < 10_000
    done = subprocess.run(
        [sys.executable, "-c", ALONE], input=sent, stdout=subprocess.PIPE, check=True
    )
    assert done.stdout.decode().strip() == "[]"
