"""Hindsight: what it tells is what every candidate alone showed, in the same cycles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from polars.testing import assert_frame_equal

from dwell.errors import SimulationError
from dwell.model import NodeDisturbance, Problem, Uniform
from dwell.policies import DTP
from dwell.record import Run
from dwell.sim import draw, simulate_realisation
from dwell.study import Contender, Point, Study, run_study
from dwell.study.hindsight import Hindsight
from dwell.study.reference import play_alone
from tests.cells.small import make_problem

PROBLEM = make_problem()
SCENARIO = "network-impairment"
WINDOWS = 12


def played(problem: Problem, policy: str, *, seed: int = 1) -> tuple[Run, dict[str, Run]]:
    """Return a run in hindsight, and the candidates' own."""
    realisation = draw(problem, scenario=SCENARIO, seed=seed, windows=WINDOWS)
    alone = play_alone(problem, realisation)
    run = simulate_realisation(problem, realisation, policy=policy, estimator=Hindsight(alone))
    return run, alone


def test_a_window_of_every_candidate_is_seen_as_its_controller_saw_it() -> None:
    run, alone = played(PROBLEM, "LOC")
    for name in ("SO", "HYB"):
        for column in ("l95_ms", "violation_rate"):
            told = run.decisions[f"est_{column}_{name}"].to_list()
            assert told == alone[name].windows[f"seen_{column}"].to_list()
    # J of both agree where they are priced against the same incumbent, utilisation included.
    run, alone = played(PROBLEM, "dtp")
    first = run.decisions.row(0, named=True)
    moved = {"SO": 0.2 * 2 / 4, "HYB": 0.2 * 1 / 4}
    for name, price in moved.items():
        expected = alone[name].windows["cost"][0] + price
        assert first[f"j_{name}"] == pytest.approx(expected, rel=1e-12)


def test_windows_that_overlap_are_seen_as_their_controller_saw_them() -> None:
    jitter = Uniform(0.0, PROBLEM.pipeline.period_ms)
    pipeline = replace(PROBLEM.pipeline, release_jitter_ms=jitter)
    run, alone = played(replace(PROBLEM, pipeline=pipeline), "LOC")
    for name in ("SO", "HYB"):
        told = [f"est_{column}_{name}" for column in ("l95_ms", "violation_rate", "u_R1", "u_E")]
        seen = ["seen_l95_ms", "seen_violation_rate", "u_R1", "u_E"]
        assert run.decisions.select(told).rows() == alone[name].windows.select(seen).rows()


@pytest.mark.parametrize("lead", [0, 3])
def test_windows_that_have_shifted_are_seen_by_their_own_cycles(lead: int) -> None:
    settings = replace(PROBLEM.controller, order_lead_cycles=lead, min_dwell=0)
    problem = replace(
        PROBLEM,
        controller=settings,
        scenarios={SCENARIO: (NodeDisturbance("R1", at_s=0.7, for_s=1.1, stress_threads=8),)},
    )
    run, alone = played(problem, "dtp")
    windows = run.windows
    assert run.decisions["migrated"].any()
    assert (windows["first_cycle"].to_numpy() % problem.window_cycles > 0).any() == bool(lead)
    for name, other in alone.items():
        cycles = other.cycles
        idle = run.decisions.filter(run.decisions["incumbent"] != name)
        for window, told in idle.select("window", f"est_violation_rate_{name}").rows():
            mine = cycles.slice(windows["first_cycle"][window], problem.window_cycles)
            late = mine["latency_ns"].fill_null(1 << 62) > 33_000_000
            # What the close finds unfinished is late as well.
            close_ns = mine["release_ns"][-1] + 33_000_000
            late |= (mine["release_ns"] + mine["latency_ns"]).fill_null(1 << 62) > close_ns
            assert told == pytest.approx(late.mean())


def test_utilisation_of_a_shifted_window_is_that_of_the_windows_it_overlaps() -> None:
    settings = replace(PROBLEM.controller, order_lead_cycles=5, min_dwell=0)
    problem = replace(PROBLEM, controller=settings)
    realisation = draw(problem, scenario=SCENARIO, seed=1, windows=WINDOWS)
    alone = play_alone(problem, realisation)
    hindsight = Hindsight(alone)
    hindsight.start(problem)

    class Evident:
        release_ns = realisation.release_ns[15:25]
        close_ns = int(realisation.release_ns[25])

    hindsight.learn(Evident())  # type: ignore[arg-type]
    told = hindsight.estimate(observed=None, incumbent="LOC", own={})  # type: ignore[arg-type]
    for name, run in alone.items():
        busy = run.windows["u_R1"].to_numpy()
        assert told[name].utilisation["R1"] == pytest.approx(np.mean(busy[1:3]), rel=1e-6)


def test_it_has_to_be_told() -> None:
    realisation = draw(PROBLEM, scenario=SCENARIO, seed=1, windows=WINDOWS)
    with pytest.raises(SimulationError, match="knows no run of LOC, SO, HYB alone"):
        simulate_realisation(PROBLEM, realisation, policy="dtp", estimator=Hindsight())


def test_a_study_tells_it_with_references_and_without() -> None:
    problem = PROBLEM
    objects = DTP(
        candidates=problem.candidates,
        initial="LOC",
        objective=problem.objective,
        min_dwell=problem.min_dwell,
    )
    study = Study(
        name="told",
        points=(Point({}, problem),),
        scenarios=(SCENARIO,),
        contenders=(
            Contender("LOC", "LOC"),
            Contender("dtp", "dtp"),
            Contender("late", "dtp", Hindsight()),
            Contender("same", objects, Hindsight()),
        ),
        seeds=(1, 2),
        windows=WINDOWS,
    )
    alone = run_study(study, processes=1).runs
    beside = run_study(replace(study, references=True), processes=1).runs
    names = ("LOC", "dtp", "late", "same")
    beside = beside.filter(beside["policy"].is_in(names))
    assert_frame_equal(alone, beside.select(alone.columns), check_exact=True)
    costs = {name: alone.filter(alone["policy"] == name)["cost"].to_list() for name in names}
    assert costs["late"] == costs["same"] != costs["dtp"]
    run, _ = played(problem, "dtp", seed=2)
    windows = run.windows.filter(~run.windows["warmup"])
    assert costs["late"][1] == pytest.approx(windows["cost"].mean())
