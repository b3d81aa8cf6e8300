"""Corrected against cells in which what disturbs a node or link is known exactly."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.estimators import Corrected, Learner, Profile
from dwell.estimators.measured import Message, Site
from dwell.model import (
    Constant,
    ControllerSettings,
    Disturbance,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Problem,
    QoS,
    Task,
)
from dwell.model.fabric import Scheduler
from tests.cells.deterministic import cell, truth
from tests.cells.generated import make_problem
from tests.estimators.windows import Row, seen_window, window

SEEN = QoS(1.0, 0.0, {"R": 0.0, "E": 0.0})
NO_WORK = {"R": 0.0, "E": 0.0}


def decide(
    problem: Problem, policy: str, windows: int, estimator: Learner | None = None
) -> pl.DataFrame:
    """Return what was estimated in the windows of a run that never moves."""
    return dwell.simulate(
        problem,
        scenario="disturbed",
        policy=policy,
        estimator=estimator,
        seed=1,
        windows=windows,
    ).decisions


def mean(values: pl.Series) -> float:
    return float(values.to_numpy().mean())


def alone(problem: Problem) -> Corrected:
    """An estimator that has to do without shadows."""
    return Corrected(problem, shadow_fraction=0.0)


def estimate(corrected: Corrected, foreign: Mapping[str, float] | None = None) -> dict[str, QoS]:
    seen = QoS(1.0, 0.0, foreign or NO_WORK)
    return corrected.estimate(observed=seen, incumbent="LOC", own=NO_WORK)


# --------------------------------------------------------------------------- constructed truth


@pytest.mark.parametrize("scheduler", ["fair", "fifo"])
def test_a_slow_node_and_a_slow_link_seen_by_shadows_alone(scheduler: Scheduler) -> None:
    problem = cell(estimator="corrected", scheduler=scheduler)
    shown = decide(problem, "LOC", 6)
    for name in ("OFF", "FAR", "TWIN"):
        l95_ms, missed = truth(problem, name)
        assert shown[f"est_l95_ms_{name}"].to_list() == pytest.approx([l95_ms] * 6, abs=1e-6)
        assert set(shown[f"est_violation_rate_{name}"]) == {missed}
    assert shown["est_samples_OFF"].to_list() == sorted(shown["est_samples_OFF"])
    assert set(shown["est_age_windows_OFF"]) == {0.0}


def test_a_sink_that_no_shadow_runs_is_corrected_with_its_node() -> None:
    problem = cell(estimator="corrected")
    shown = decide(problem, "LOC", 4)
    assert truth(problem, "SINK")[0] == 2 + 8 + 6 + 1 + 7 + 0.75
    assert shown["est_l95_ms_SINK"].to_list() == pytest.approx([24.75] * 4, abs=1e-6)
    assert shown["est_samples_SINK"].to_list() == [0.0] * 4
    assert shown["est_age_windows_SINK"].to_list() == [1.0, 2.0, 3.0, 4.0]


def test_what_comes_and_goes_is_followed_and_counted() -> None:
    # Windows last 2 s.
    scenario: list[Disturbance] = [
        NodeDisturbance("E", at_s=6.0, for_s=8.0, stress_threads=20),
        LinkDisturbance("R", "E", at_s=6.0, for_s=8.0, add_delay_ms=Constant(7.0)),
    ]
    quiet = truth(cell(scenario=()), "OFF")[0]
    disturbed = truth(cell(), "OFF")[0]
    shown = decide(cell(estimator="corrected", scenario=scenario), "LOC", 12)
    l95_ms = shown["est_l95_ms_OFF"].to_list()
    assert l95_ms[:3] == pytest.approx([quiet] * 3, abs=1e-6)
    assert l95_ms[3:7] == pytest.approx([disturbed] * 4, abs=1e-6)
    assert l95_ms[7:] == pytest.approx([quiet] * 5, abs=1e-6)
    # What comes does away with what was measured of the link and of `act` on E before; so does what
    # goes, and of its window nothing is held.
    samples = shown["est_samples_OFF"].to_list()
    assert samples[2] > 12 > samples[3] > 0
    assert samples[6] > 12
    assert samples[7] == 0
    assert samples[8] > 0


def test_losses_are_a_share_and_age() -> None:
    lossy = cell(
        estimator="corrected",
        scenario=[LinkDisturbance("R", "E", loss=0.3)],
        shadow_fraction=0.2,
        deadline_ms=25.0,
    )
    shown = decide(lossy, "LOC", 60)
    assert mean(shown["est_violation_rate_OFF"][20:]) == pytest.approx(0.3, abs=0.06)
    bound_ms = lossy.censor_ms
    assert mean(shown["est_l95_ms_OFF"][20:]) == pytest.approx(truth_of_losses(bound_ms), rel=0.05)
    assert set(shown["est_violation_rate_LOC"]) == {0.0}


def over_wifi(loss: float, window_cycles: int = 100) -> Problem:
    """Return a cell whose link keeps order, and loses more than the 2 % that it declares."""
    nothing = Execution(Constant(0.0))
    link = Link("R", "E", Constant(5.0), loss=0.02, retransmit_ms=200.0, in_order=True)
    return make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("a", {"R": nothing}), Task("b", {"R": nothing, "E": nothing})],
        [Flow("a", "b")],
        links=[link],
        candidates={"LOC": {}, "SO": {"b": "E"}},
        period_ms=100 / 3,
        window_cycles=window_cycles,
        scenario=[LinkDisturbance("R", "E", loss=loss)],
        controller=ControllerSettings(shadow_fraction=0.2),
    )


def test_what_waits_for_a_repeated_message_takes_no_longer() -> None:
    delays = Corrected(over_wifi(0.0))._pools[Message("a", "b", "R->E")].reference.values
    assert set(delays) <= {5.0 + 200.0 * lost for lost in range(4)}
    assert (delays > 5.0).mean() == pytest.approx(0.02, abs=0.005)


@pytest.mark.parametrize(
    ("active", "window_cycles", "within"),
    [("SO", 100, 0.05), ("SO", 1000, 0.12), ("LOC", 100, 0.1)],
)
def test_a_price_has_the_wait_for_repeated_messages_once(
    active: str, window_cycles: int, within: float
) -> None:
    # Measured are all messages, or every fifth one, or shadows in every fifth cycle.
    problem = over_wifi(0.2, window_cycles)
    windows = 20_000 // window_cycles
    played = dwell.simulate(problem, scenario="disturbed", policy="SO", seed=1, windows=windows)
    missed = mean(played.windows["violation_rate"])
    assert missed > 0.8
    shown = decide(problem, active, windows, Corrected(problem))
    assert mean(shown["est_violation_rate_SO"][windows // 2 :]) == pytest.approx(missed, abs=within)


def truth_of_losses(bound_ms: float) -> float:
    """Expected 48th of 50 where each is lost with 0.3 and counts with its age, 1 to 50 periods.

    No cycle counts for more than the bound.
    """
    rng = np.random.default_rng(1)
    lost = rng.random((20_000, 50)) < 0.3
    seen = np.where(lost, 40.0 * np.arange(50, 0, -1), 13.0)
    return float(np.minimum(np.sort(seen, axis=1)[:, 47], bound_ms).mean())


@pytest.mark.parametrize("down", ["R->E", "E->R"])
def test_a_link_that_is_down_loses_everything_until_it_is_up(down: str) -> None:
    source, target = down.split("->")
    problem = cell(
        estimator="corrected",
        scenario=[LinkDisturbance(source, target, at_s=4.0, for_s=8.0, down=True)],
        deadline_ms=25.0,
    )
    shown = decide(problem, "LOC", 10)
    assert shown["est_violation_rate_OFF"].to_list() == [0.0] * 2 + [1.0] * 4 + [0.0] * 4
    assert shown["est_l95_ms_OFF"][3] == problem.censor_ms
    assert shown["est_l95_ms_OFF"][7:].to_list() == pytest.approx([2 + 3 + 6 + 1 + 2] * 3)


def test_random_processes_get_the_profile_when_nothing_is_wrong() -> None:
    """With variation, the estimate agrees with what the candidate shows within a few percent."""
    problem = dwell.load("examples/canonical.yaml")
    shown = dwell.simulate(
        problem, policy="LOC", estimator="corrected", seed=1, windows=60
    ).decisions
    for name in ("SO", "HYB"):
        real = dwell.simulate(problem, policy=name, seed=1, windows=60).windows
        assert mean(shown[f"est_l95_ms_{name}"][10:]) == pytest.approx(
            mean(real["seen_l95_ms"]), rel=0.08
        )


# ------------------------------------------------------------------- what nobody measured


@pytest.mark.parametrize("scheduler", ["fair", "fifo", "priority"])
@pytest.mark.parametrize("threads", [{}, {"plan": 1, "act": 8}, {"sense": 16, "plan": 2}])
def test_jobs_of_a_node_are_slowed_by_what_slows_the_one_that_was_measured(
    scheduler: Scheduler, threads: Mapping[str, int]
) -> None:
    problem = cell(
        estimator="corrected",
        scenario=[NodeDisturbance("R", at_s=2.0, stress_threads=20)],
        scheduler=scheduler,
        threads=threads,
    )
    shown = decide(problem, "FAR", 4, alone(problem))
    slowed = truth(
        cell(
            scenario=[NodeDisturbance("R", stress_threads=20)],
            scheduler=scheduler,
            threads=threads,
        ),
        "LOC",
    )[0]
    # FAR has `sense` and `control` on R; LOC `act` and `plan` as well.
    assert shown["est_l95_ms_LOC"].to_list() == pytest.approx([17.0] + [slowed] * 3, abs=1e-6)


def test_a_job_that_was_measured_is_not_corrected_by_others() -> None:
    """One shadow through OFF runs `plan` on R, where the cycles' own jobs take twice as long."""
    corrected = Corrected(cell(candidates=("LOC", "OFF", "FAR")))
    rows: list[Row] = []
    for i in range(10):
        sensed, acted, planned = (40.0 * i + ms for ms in (4.0, 8.0, 10.0))
        rows.append(
            (
                [40.0 * i, sensed + 1, acted, planned + 1],
                [sensed, acted, planned, planned + 3],
                [sensed + 1, acted, planned + 1],
            )
        )
    off: Row = ([None, None, 9.0, None], [None, None, 15.0, None], [None, 9.0, 15.0])
    sent: list[Row | None] = [off, *[None] * 9]
    corrected.learn(
        window(rows, close_ms=400.0, placement=[2] * 10, shadows=sent, through=[1] * 10)
    )
    # `act` was not measured, and takes twice as long as well.
    assert estimate(corrected)["LOC"].l95_ms == pytest.approx(4.0 + 16.0 + 6.0 + 2.0)


def test_messages_of_a_link_get_the_delay_and_the_losses_of_the_one_that_was_measured() -> None:
    # FAR sends plan -> control over E -> R, OFF would send act -> plan.
    scenario = [LinkDisturbance("E", "R", at_s=2.0, add_delay_ms=Constant(5.0), loss=0.4)]
    problem = cell(estimator="corrected", scenario=scenario, deadline_ms=25.0)
    shown = decide(problem, "FAR", 3, alone(problem))
    assert shown["est_violation_rate_OFF"][0] == 0.0
    assert shown["est_violation_rate_OFF"][2] == pytest.approx(0.4, abs=0.15)
    finite = decide(
        cell(
            estimator="corrected",
            scenario=[LinkDisturbance("E", "R", at_s=2.0, add_delay_ms=Constant(5.0))],
        ),
        "FAR",
        3,
        alone(problem),
    )
    assert finite["est_l95_ms_OFF"].to_list() == pytest.approx([14.0, 19.0, 19.0], abs=1e-6)


def test_a_node_of_which_nothing_is_measured_is_judged_by_its_load() -> None:
    stress = [NodeDisturbance("E", at_s=4.0, for_s=4.0, stress_threads=8)]
    # 12 threads beside 8 on 16 cores: 1.25 times as long.
    problem = cell(estimator="corrected", scenario=stress, threads={"act": 12})
    shown = decide(problem, "LOC", 6, alone(problem))
    quiet = 2 + 3 + 6 + 1 + 2
    expected = [quiet] * 2 + [quiet + 0.75] * 2 + [quiet] * 2
    assert shown["est_l95_ms_OFF"].to_list() == pytest.approx(expected, abs=1e-6)


def test_a_saturated_node_hides_how_much_there_is() -> None:
    problem = cell(
        estimator="corrected",
        scenario=[NodeDisturbance("E", stress_threads=40)],
        threads={"act": 12},
    )
    shown = decide(problem, "LOC", 3, alone(problem))
    # It can only be said that there is a thread for each core.
    assert shown["est_l95_ms_OFF"][-1] == pytest.approx(2 + 3 * 28 / 16 + 6 + 1 + 2)
    assert truth(problem, "OFF")[0] == pytest.approx(2 + 3 * 52 / 16 + 6 + 1 + 2)


@pytest.mark.parametrize("load", [0.7, 0.9])
def test_load_slows_nothing_beyond_what_jobs_were_measured_to_take(load: float) -> None:
    """4 threads beside 11.2 on 16 cores, or beside 14.4, in which time the job needs less."""
    corrected = Corrected(cell(estimator="corrected"))
    for _ in range(3):
        corrected.learn(seen_window(extra_ms=0.0))
        l95_ms = estimate(corrected, {"R": 0.0, "E": load})["OFF"].l95_ms
        assert l95_ms == pytest.approx(14.0, rel=0.01)


def test_what_waits_is_no_slow_node() -> None:
    """On one core a short job waits for a long one, and says nothing about the node's speed."""
    tasks = [
        Task("long", {"R": Execution(Constant(20.0))}),
        Task("short", {"R": Execution(Constant(0.1))}),
        Task("other", {"R": Execution(Constant(5.0)), "E": Execution(Constant(5.0))}),
        Task("last", {"R": Execution(Constant(0.1))}),
    ]
    problem = make_problem(
        [Node("R", "robot", 1, "fifo"), Node("E", "edge", 1, "fifo")],
        tasks,
        [Flow("short", "last"), Flow("long", "last"), Flow("other", "last")],
        links=[Link("E", "R", Constant(1.0))],
        candidates={"AWAY": {"other": "E"}, "HERE": {}},
        window_cycles=20,
    )
    shown = decide(problem, "AWAY", 3, alone(problem))
    # `short` takes 20.1 ms instead of 0.1; were R 200 times slower, `other` would take a second.
    assert shown["est_l95_ms_HERE"].to_numpy().max() < 100.0


def test_load_outlives_what_was_measured_beside_it() -> None:
    corrected = Corrected(cell(half_life_windows=0.2, threads={"act": 12}))
    corrected.learn(seen_window(extra_ms=7.0))
    estimate(corrected)
    for age in range(1, 15):
        corrected.learn(seen_window())
        # 12 threads beside 8; after 12 windows the delay of the link is forgotten.
        expected = 11.0 + 3.0 * 20 / 16 + (7.0 if age < 12 else 0.0)
        shown = estimate(corrected, {"R": 0.0, "E": 0.5})["OFF"].l95_ms
        assert shown == pytest.approx(expected)


def test_it_learns_from_the_active_placement_alone() -> None:
    problem = dwell.load("examples/canonical.yaml")
    for policy, others in (("HYB", ("SO", "LOC")), ("LOC", ("SO", "HYB"))):
        run = dwell.simulate(
            problem,
            scenario="network-impairment",
            policy=policy,
            estimator=alone(problem),
            seed=1,
            windows=20,
        )
        shown = run.decisions
        assert "shadow_R1" not in run.windows.columns
        usual = Profile(problem)
        for name in others:
            learnt = shown[f"est_l95_ms_{name}"][-1] > usual.l95_ms[name] + 20
            # From LOC the links to E are out of sight.
            assert learnt == (policy == "HYB" and name == "SO")


# ----------------------------------------------------------------------------- awkward cells


def test_a_cell_in_which_nothing_takes_time() -> None:
    nothing = Execution(Constant(0.0))
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("A", {"R": nothing}), Task("B", {"R": nothing, "E": nothing})],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(0.0))],
        candidates={"LOC": {}, "OFF": {"B": "E"}},
        window_cycles=10,
        scenario=[
            LinkDisturbance("R", "E", at_s=2.0, add_delay_ms=Constant(3.0)),
            NodeDisturbance("R", stress_threads=9),
        ],
        controller=ControllerSettings(estimator="corrected", shadow_fraction=0.5),
    )
    shown = decide(problem, "LOC", 5)
    assert shown["est_l95_ms_LOC"].to_list() == [0.0] * 5
    assert shown["est_l95_ms_OFF"].to_list() == pytest.approx([0.0] * 2 + [3.0] * 3)


def test_a_latency_equal_to_the_deadline_is_met() -> None:
    # In binary floating point 0.1 + 0.2 is more than 0.3.
    def made(ms: float) -> Execution:
        return Execution(Constant(ms))

    problem = make_problem(
        [Node("R", "robot")],
        [Task("A", {"R": made(0.1)}), Task("B", {"R": made(0.2)})],
        [Flow("A", "B")],
        period_ms=1.0,
        deadline_ms=0.3,
    )
    corrected = Corrected(problem)
    shown = corrected.estimate(observed=QoS(1.0, 0.0, {"R": 0.0}), incumbent="LOC", own={"R": 0.0})
    assert shown["LOC"].violation_rate == 0.0


def test_a_link_that_loses_nearly_everything() -> None:
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [
            Task("A", {"R": Execution(Constant(1.0))}),
            Task("B", {"R": Execution(Constant(1.0)), "E": Execution(Constant(1.0))}),
        ],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(1.0), loss=0.9999)],
        candidates={"LOC": {}, "OFF": {"B": "E"}},
        window_cycles=10,
        controller=ControllerSettings(estimator="corrected", shadow_fraction=0.5),
    )
    for estimator in (None, alone(problem)):
        shown = decide(problem, "LOC", 3, estimator)
        assert shown["est_violation_rate_OFF"].to_list() == [1.0] * 3
        assert shown["est_l95_ms_OFF"].to_list() == pytest.approx([4 * 100.0] * 3)
    shown = decide(problem, "OFF", 15, alone(problem))
    assert set(shown["est_violation_rate_LOC"]) == {0.0}


@pytest.mark.parametrize("window_cycles", [1, 2, 7, 20_000])
def test_windows_of_any_length(window_cycles: int) -> None:
    problem = cell(estimator="corrected", window_cycles=window_cycles, shadow_fraction=0.2)
    shown = decide(problem, "LOC", max(2, 60 // window_cycles))
    # In the shortest windows the jobs of several tell how many threads a full node has.
    l95_ms = 2.0 + 8.0 + 3.0 * (4 + 20) / 16 + 1.0 + 6.0 + 1.0
    assert shown["est_l95_ms_OFF"][-1] == pytest.approx(l95_ms)
    assert shown["est_violation_rate_OFF"][-1] == float(l95_ms > 22.0)


# ---------------------------------------------------------------------------------- the rest


def test_a_flow_of_two_candidates_on_one_link_is_one_part() -> None:
    corrected = Corrected(cell(estimator="corrected"))
    parts = set(corrected._pools)
    assert Message("sense", "act", "R->E") in parts
    assert {p for p in parts if isinstance(p, Message) and p.link == "E->R"} == {
        Message("act", "plan", "E->R"),
        Message("plan", "control", "E->R"),
    }
    assert {p for p in parts if isinstance(p, Site)} == {
        *(Site(name, "R") for name in ("sense", "act", "plan", "control")),
        *(Site(name, "E") for name in ("act", "plan", "control")),
    }


def test_variation_is_kept() -> None:
    """L95 is that of the pool's spread, not of its median."""
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [
            Task("A", {"R": Execution(Constant(1.0))}),
            Task("B", {"R": Execution(LogNormal(10.0, 0.5)), "E": Execution(LogNormal(5.0, 0.5))}),
        ],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(0.0))],
        candidates={"OFF": {"B": "E"}, "LOC": {}},
        window_cycles=100,
        scenario=[NodeDisturbance("E", stress_threads=1)],
    )
    shown = decide(problem, "OFF", 30, Corrected(problem))
    real = dwell.simulate(problem, scenario="disturbed", policy="OFF", seed=1, windows=30).windows
    # E has one core: everything takes twice as long. The 95th percentile is 1.94 times the mean.
    assert mean(real["seen_l95_ms"]) == pytest.approx(1 + 2 * 5 * 1.94, rel=0.1)
    assert mean(shown["est_l95_ms_LOC"]) == pytest.approx(1 + 10 * 1.94, rel=0.2)
