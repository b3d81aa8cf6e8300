"""Planning a campaign, and going on with one."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from dwell.errors import LiveError, PolicyError, ProblemError, RunError
from dwell.record import open_run
from dwell_lab.testbed.campaign import (
    Campaign,
    Planned,
    default_entrants,
    default_scenarios,
    entrant,
)
from dwell_lab.testbed.campaign_folder import read_campaign
from dwell_lab.testbed.execution import State, run_campaign
from lab.tests.testbed.simulated_runs import ALWAYS_IDLE, SimulatedRuns
from tests.cells.small import make_problem

PROBLEM = make_problem()
WINDOW_S = PROBLEM.window_cycles * PROBLEM.pipeline.period_ms / 1e3


def campaign(repetitions: int = 2, policies: Sequence[str] = ("LOC", "atp", "dtp")) -> Campaign:
    return Campaign(
        PROBLEM,
        tuple(PROBLEM.scenarios)[:2],
        tuple(entrant(PROBLEM, name) for name in policies),
        repetitions,
        seconds=(PROBLEM.warmup_windows + 3) * WINDOW_S,
        seed=5,
    )


def asked_for(one: Planned) -> str:
    return f"{one.scenario}-{one.policy}-{one.seed}"


def run(
    asked: Campaign, folder: Path, play: SimulatedRuns, *, minutes: float | None = None
) -> tuple[State, list[str]]:
    told: list[str] = []
    state = run_campaign(
        asked, folder, play, minutes=minutes, tell=told.append, wait=ALWAYS_IDLE, clock=_ticking()
    )
    return state, told


def _ticking() -> Callable[[], float]:
    """Return a clock on which everything between two looks takes a minute."""
    minutes = itertools.count()
    return lambda: 60.0 * next(minutes)


def test_every_repetition_is_a_complete_order_of_its_own() -> None:
    plan = campaign(4).plan()
    blocks = [list(block) for _, block in itertools.groupby(plan, lambda one: one.repetition)]
    assert len(blocks) == 4
    pairs = [[(one.scenario, one.policy) for one in block] for block in blocks]
    everything = set(itertools.product(tuple(PROBLEM.scenarios)[:2], ("LOC", "atp", "dtp")))
    assert all(len(block) == 6 and set(block) == everything for block in pairs)
    assert len({tuple(block) for block in pairs}) > 1
    assert [one.place for one in plan] == list(range(1, 25))


def test_policies_of_a_scenario_and_repetition_share_their_seed() -> None:
    seeds = {(one.scenario, one.repetition): set[int]() for one in campaign(3).plan()}
    for one in campaign(3).plan():
        seeds[one.scenario, one.repetition].add(one.seed)
    assert all(len(found) == 1 for found in seeds.values())
    assert {seed for found in seeds.values() for seed in found} == {5, 6, 7}


def test_the_order_is_the_seeds() -> None:
    assert campaign().plan() == campaign().plan()
    assert replace(campaign(), seed=6).plan() != campaign().plan()
    # More repetitions leave the earlier ones as they are.
    assert campaign(3).plan()[:12] == campaign(2).plan()


def test_what_estimates_nothing_has_no_shadow_jobs() -> None:
    believing = replace(
        PROBLEM, controller=replace(PROBLEM.controller, estimator="corrected", shadow_fraction=0.1)
    )
    found = {one.name: one.estimator for one in default_entrants(believing)}
    assert entrant(believing, "atp-thresholds").estimator == "profile"
    assert found == {
        **dict.fromkeys(PROBLEM.candidates, "profile"),
        "atp": "corrected",
        "dtp": "corrected",
        "cusum+corrected": "corrected",
    }
    seen = entrant(PROBLEM, "cusum+corrected").problem(PROBLEM)
    assert seen.controller.estimator == "corrected"
    assert seen.controller.policy == "cusum"


def test_the_papers_scenarios_are_played_where_the_cell_has_them() -> None:
    found = default_scenarios(PROBLEM)
    assert set(found) <= set(PROBLEM.scenarios)
    assert found


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"scenarios": ("nowhere",)}, ProblemError, "nowhere"),
        ({"scenarios": ()}, LiveError, "scenarios is empty"),
        ({"seconds": WINDOW_S}, ProblemError, "too short"),
        ({"repetitions": 0}, LiveError, "repetitions is 0"),
        ({"entrants": (entrant(PROBLEM, "dtp"),) * 2}, LiveError, "'dtp' twice"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    change: dict[str, object], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        replace(campaign(), **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["nobody", "dtp+nothing"])
def test_unknown_policies_are_refused(name: str) -> None:
    with pytest.raises(PolicyError, match=name.partition("+")[0]):
        entrant(PROBLEM, name)


def test_a_campaign_leaves_a_run_folder_for_every_run(tmp_path: Path) -> None:
    asked, play = campaign(), SimulatedRuns()
    state, told = run(asked, tmp_path / "there", play)
    assert state == State(12, 12, (), 0)
    assert len(told) == 12
    plan = asked.plan()
    assert play.names == [asked_for(one) for one in plan]
    kept = read_campaign(tmp_path / "there")
    assert [folder.name for folder in kept.done] == [one.name for one in plan]
    for one, (folder, record) in zip(plan, kept.done.items(), strict=True):
        found = open_run(folder)
        assert found.meta["scenario"] == record["scenario"] == one.scenario
        assert found.meta["seed"] == one.seed
        assert found.has_jobs
        assert record["idle"]["idle"]
        assert record["excluded"] == 1
    assert not list((tmp_path / "there").glob(".work"))


def test_an_interrupted_run_is_repeated_and_nothing_else(tmp_path: Path) -> None:
    asked, folder = campaign(), tmp_path / "there"
    stopped = SimulatedRuns(lambda names: "stop" if len(names) == 5 else "")
    with pytest.raises(KeyboardInterrupt):
        run(asked, folder, stopped)
    before = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/run.json")}
    assert len(before) == 4
    going_on = SimulatedRuns()
    state, _ = run(asked, folder, going_on)
    assert state.done == 12
    assert going_on.names == [asked_for(one) for one in asked.plan()[4:]]
    assert (
        before.items()
        <= {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/run.json")}.items()
    )


def test_failed_runs_are_repeated_at_the_end_and_counted(tmp_path: Path) -> None:
    asked = campaign(1)
    planned = asked.plan()[2:4]
    third, fourth = map(asked_for, planned)

    def broken(names: Sequence[str]) -> str:
        if names[-1] == third:
            return "pressure"
        return "error" if names[-1] == fourth and names.count(fourth) == 1 else ""

    play = SimulatedRuns(broken)
    state, told = run(asked, tmp_path / "there", play)
    assert play.names[6:] == [third, fourth, third]
    assert state == State(6, 5, (planned[0].name,), 4)
    assert any("windows after the warm-up were measured under pressure" in line for line in told)
    kept = read_campaign(tmp_path / "there")
    assert sorted(one["outcome"] for one in kept.failed) == ["error", "failed", "failed", "failed"]
    # What a failed attempt left is there to be looked at.
    assert (tmp_path / "there" / "failed" / f"{planned[1].name}.1" / "agent.log").is_file()
    # Given up is given up, also when the campaign is gone on with.
    again = SimulatedRuns()
    assert run(asked, tmp_path / "there", again)[0] == state
    assert again.names == []


def test_a_cell_that_never_comes_up_ends_the_campaign(tmp_path: Path) -> None:
    play = SimulatedRuns(lambda names: "error")
    with pytest.raises(LiveError, match=r"first 3 runs .* the cell is not complete"):
        run(campaign(), tmp_path / "there", play)
    assert len(play.names) == 3


def test_no_run_is_begun_that_would_end_after_the_minutes(tmp_path: Path) -> None:
    play = SimulatedRuns()
    state, told = run(campaign(), tmp_path / "there", play, minutes=5.5)
    assert 1 <= state.done < 12
    assert state.left == 12 - state.done
    assert told[-1].startswith("stopped")
    assert run(campaign(), tmp_path / "there", SimulatedRuns())[0].done == 12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"repetitions": 3}, "repetitions: 2 there, 3 now"),
        ({"seed": 9}, "seed: 5 there, 9 now"),
        ({"problem": replace(PROBLEM, warmup_windows=1)}, "warmup_windows"),
    ],
)
def test_a_folder_belongs_to_one_campaign(
    tmp_path: Path, change: dict[str, object], said: str
) -> None:
    run(campaign(), tmp_path / "there", SimulatedRuns(), minutes=2.5)
    play = SimulatedRuns()
    with pytest.raises(RunError, match=said):
        run(replace(campaign(), **change), tmp_path / "there", play)  # type: ignore[arg-type]
    assert play.names == []


def test_other_software_is_refused(tmp_path: Path) -> None:
    run(campaign(), tmp_path / "there", SimulatedRuns(), minutes=2.5)
    file = tmp_path / "there" / "campaign.json"
    told = json.loads(file.read_text())
    told["software"]["sources"] = "0" * 16
    told["digest"] = ""
    file.write_text(json.dumps(told))
    with pytest.raises(RunError, match=r"software\.sources"):
        run(campaign(), tmp_path / "there", SimulatedRuns())


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match="no campaign"):
        run(campaign(), tmp_path, SimulatedRuns())
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
