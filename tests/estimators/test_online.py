"""What the estimators that watch windows have in common."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import TypeAlias

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.cost import cost_error
from dwell.estimators import Corrected, Evidence, Profile, Scaling, Shadow
from dwell.estimators.online import Online
from dwell.model import (
    Constant,
    ControllerSettings,
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
from dwell.record import Run
from tests.cells.deterministic import MOVES, cell, truth
from tests.cells.generated import make_problem, random_problem, random_stamps
from tests.cells.once import once, with_windows
from tests.estimators.windows import GONE, Row, local_row, off_row, seen_window, window

CANONICAL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
#: Cells of which it is known how often, and where to, the pipeline has to move.
KNOWN_MOVES = Path(__file__).parents[1] / "cells" / "known_moves"
NO_WORK = {"R": 0.0, "E": 0.0}

Kind: TypeAlias = type[Shadow] | type[Scaling] | type[Corrected]

every = pytest.mark.parametrize("kind", [Shadow, Scaling, Corrected])


def estimate(
    estimator: Online, used: Mapping[str, float] = NO_WORK, own: Mapping[str, float] = NO_WORK
) -> dict[str, QoS]:
    return estimator.estimate(observed=QoS(1.0, 0.0, used), incumbent="LOC", own=own)


def of_price(qos: QoS) -> tuple[float, float, float]:
    # That of the price alone: nothing was measured.
    assert qos.error is not None
    return qos.l95_ms, qos.violation_rate, qos.uncut_l95_ms


def declared(profile: Profile, name: str) -> tuple[float, float, float]:
    return profile.l95_ms[name], profile.violation_rate[name], profile.uncut_l95_ms[name]


# --------------------------------------------------------------------------------- as declared


@every
@pytest.mark.parametrize("problem", [cell(), dwell.load(CANONICAL)], ids=["constants", "random"])
def test_before_any_window_prices_are_those_of_the_profile(problem: Problem, kind: Kind) -> None:
    estimator, profile = kind(problem), Profile(problem)
    idle = dict.fromkeys(problem.fabric.nodes, 0.0)
    shown = estimate(estimator, idle, idle)
    assert list(shown) == list(problem.candidates)
    for name in problem.candidates:
        assert of_price(shown[name]) == declared(profile, name)


@every
def test_what_has_nothing_that_is_otherwise_keeps_the_price_of_the_profile(
    kind: Kind,
) -> None:
    """E, and what goes there, is disturbed; LOC and TWIN have nothing of it."""
    problem = cell()
    estimator = kind(problem)
    profile = Profile(problem)
    estimator.learn(seen_window(extra_ms=7.0))
    shown = estimate(estimator, {"R": 0.0, "E": 1.0})
    for name in MOVES:
        if name in ("LOC", "TWIN"):
            assert of_price(shown[name]) == declared(profile, name)
        else:
            assert shown[name].error is not None
            assert shown[name].l95_ms > profile.l95_ms[name]


@every
def test_what_is_as_declared_is_no_news(kind: Kind) -> None:
    estimator = kind(cell())
    for _ in range(20):
        estimator.learn(seen_window(extra_ms=0.0))
        estimate(estimator)
    assert estimator.regimes == 0


@every
def test_in_an_undisturbed_cell_prices_are_those_of_the_profile(kind: Kind) -> None:
    problem = cell(scenario=())
    profile = Profile(problem)
    decisions = dwell.simulate(
        problem, policy="OFF", estimator=kind(problem), seed=1, windows=8
    ).decisions
    for name in MOVES:
        assert set(decisions[f"est_l95_ms_{name}"]) == {profile.l95_ms[name]}
        assert set(decisions[f"est_l95_error_ms_{name}"]) == {0.0}


# --------------------------------------------------------------------------------- utilisation


def test_utilisation_is_that_of_others_and_of_own_work_and_of_the_shadows_to_be_sent() -> None:
    problem = cell(candidates=("LOC", "OFF"), shadow_fraction=0.5)
    shown = estimate(Corrected(problem), {"R": 0.4, "E": 0.2}, {"R": 0.1, "E": 0.05})
    # Of 16 cores, in a period of 40 ms, 4 threads each.
    share = 4 / 16 / 40
    # `act` and `plan` differ by what they get, so that a shadow has jobs of both.
    expected = {
        "LOC": {"R": 0.3 + share * (17 + 0.5 * 6), "E": 0.15 + share * 0.5 * 3},
        "OFF": {"R": 0.3 + share * (9 + 0.5 * 14), "E": 0.15 + share * 3},
    }
    for name, utilisation in expected.items():
        assert shown[name].utilisation == pytest.approx(utilisation)


def test_without_shadows_the_utilisation_is_that_of_the_profile() -> None:
    problem = cell()
    used, own = {"R": 0.4, "E": 0.2}, {"R": 0.1, "E": 0.05}
    profile = Profile(problem).estimate(observed=QoS(1.0, 0.0, used), incumbent="LOC", own=own)
    for estimator in (Scaling(problem), Corrected(problem, 0.0), Shadow(problem, 0.0)):
        shown = estimate(estimator, used, own)
        for name in MOVES:
            assert shown[name].utilisation == profile[name].utilisation


@every
def test_the_entry_of_the_incumbent_is_made_like_the_others(kind: Kind) -> None:
    """Whatever a window has shown of it as a whole: LOC and TWIN are the same."""
    problem = cell()
    estimator = kind(problem)
    estimator.learn(seen_window(extra_ms=7.0))
    strange = QoS(99.0, 0.9, {"R": 0.3, "E": 0.4})
    for incumbent in MOVES:
        shown = estimator.estimate(observed=strange, incumbent=incumbent, own=NO_WORK)
        assert shown["LOC"] == shown["TWIN"]
        assert shown["LOC"].l95_ms == 17.0


# --------------------------------------------------------------------------------- nodes


@every
@pytest.mark.parametrize("scheduler", ["fair", "fifo", "priority"])
def test_foreign_load_slows_what_would_run_beside_it(kind: Kind, scheduler: str) -> None:
    stress = NodeDisturbance("E", at_s=4.0, for_s=4.0, stress_threads=14)
    problem = cell(scenario=[stress], scheduler=scheduler)  # type: ignore[arg-type]
    decisions = dwell.simulate(
        problem, scenario="disturbed", policy="LOC", estimator=kind(problem), seed=1, windows=7
    ).decisions
    always = replace(stress, at_s=0.0, for_s=math.inf)
    slow = truth(cell(scenario=[always], scheduler=scheduler), "FAR")[0]  # type: ignore[arg-type]
    quiet = Profile(problem).l95_ms["FAR"]
    expected = [quiet] * 2 + [slow] * 2 + [quiet] * 3
    assert slow > quiet
    assert decisions["est_l95_ms_FAR"].to_list() == pytest.approx(expected, abs=1e-6)


def lost_on_e(since: int) -> Evidence:
    """Ten cycles under OFF whose job on E never ends from one of them on."""
    rows: list[Row] = []
    for i in range(10):
        at = 40.0 * i
        ready, end, arrived = [at, at + 3], [at + 2.0, at + 6], [at + 3.0]
        if i < since:
            rows.append(
                ([*ready, at + 7, at + 13], [*end, at + 13, at + 14], [*arrived, at + 7, at + 13])
            )
        else:
            rows.append(([*ready, None, None], [end[0], None, None, None], [*arrived, None, None]))
    starts = [40.0 * i for i in range(10)]
    return window(rows, close_ms=400.0, release_ms=starts, placement=[1] * 10)


@every
def test_a_node_on_which_jobs_do_not_end_is_down_until_they_do(kind: Kind) -> None:
    problem = cell()
    estimator, profile = kind(problem), Profile(problem)
    for since, is_down in ((10, False), (3, True), (0, True), (10, False)):
        estimator.learn(lost_on_e(since))
        shown = estimator.estimate(
            observed=QoS(1.0, 0.0, NO_WORK), incumbent="OFF", own={"R": 0.0, "E": 0.0}
        )
        for name in ("OFF", "FAR", "SINK"):
            assert (shown[name].violation_rate == 1.0) == is_down
            if is_down:
                assert shown[name].l95_ms == problem.censor_ms
            else:
                assert of_price(shown[name]) == declared(profile, name)
        assert of_price(shown["LOC"]) == declared(profile, "LOC")


@every
def test_a_node_that_is_still_at_work_is_not_down(kind: Kind) -> None:
    estimator = kind(cell())
    estimator.learn(lost_on_e(3))
    shown = estimator.estimate(
        observed=QoS(1.0, 0.0, {"R": 0.0, "E": 1.0}), incumbent="OFF", own={"R": 0.0, "E": 1.0}
    )
    assert shown["OFF"].violation_rate < 1.0


@every
@pytest.mark.parametrize(("used", "is_down"), [(1.0, False), (0.1, True)])
def test_a_full_node_on_which_jobs_get_little_is_not_down(
    kind: Kind, used: float, is_down: bool
) -> None:
    """Foreign threads that leave own jobs little of a node; a node that is down has none."""
    estimator = kind(cell())
    estimator.learn(lost_on_e(2))
    load = {"R": 0.0, "E": used}
    own = {"R": 0.0, "E": 0.005}
    estimator.estimate(observed=QoS(1.0, 0.0, load), incumbent="OFF", own=own)
    assert estimator.present.down == ({"E"} if is_down else set())


def test_a_node_that_goes_down_and_comes_back() -> None:
    problem = cell(scenario=[NodeDisturbance("E", at_s=4.0, for_s=4.0, down=True)])
    settings = once(ControllerSettings(on="R"), problem.window_cycles)
    problem = replace(problem, controller=settings)
    for kind in (Shadow, Corrected):
        decisions = dwell.simulate(
            problem,
            scenario="disturbed",
            policy="LOC",
            estimator=kind(problem, 0.1),
            seed=1,
            windows=8,
        ).decisions
        rates = decisions["est_violation_rate_OFF"].to_list()
        assert rates == [0.0] * 2 + [1.0] * 2 + [0.0] * 4
        assert decisions["est_l95_ms_OFF"].to_list()[2:4] == [problem.censor_ms] * 2


# ----------------------------------------------------------------------------------- windows


@every
def test_a_window_that_is_not_learnt_from_changes_no_price(kind: Kind) -> None:
    """Without evidence the foreign load still is in the utilisation, as the profile has it."""
    problem = cell()
    estimator, profile = kind(problem), Profile(problem)
    shown = estimate(estimator, {"R": 0.0, "E": 0.9})
    assert shown["OFF"].utilisation["E"] >= 0.9
    assert of_price(shown["OFF"]) == declared(profile, "OFF")


@every
def test_estimating_twice_changes_nothing(kind: Kind) -> None:
    estimator = kind(cell())
    estimator.learn(seen_window(extra_ms=7.0))
    busy = {"R": 0.0, "E": 0.9}
    first = estimate(estimator, busy)
    assert estimate(estimator, busy) == first
    assert estimate(estimator, busy) == first


@every
def test_a_start_forgets(kind: Kind) -> None:
    problem = cell()
    estimator = kind(problem)
    before = estimate(estimator)
    estimator.learn(seen_window(extra_ms=7.0))
    assert estimate(estimator, {"R": 0.0, "E": 0.9})["OFF"] != before["OFF"]
    assert estimator.regimes > 0
    estimator.learn(lost_on_e(0))
    estimator.start(problem)
    assert estimator.regimes == 0
    assert estimate(estimator) == before


@every
def test_another_problem_has_its_own_profile(kind: Kind) -> None:
    estimator = kind(cell())
    estimator.learn(seen_window())
    estimator.start(with_windows(cell(candidates=("LOC", "OFF")), 20))
    assert estimate(estimator).keys() == {"LOC", "OFF"}


@every
def test_a_copy_goes_its_own_way_from_where_the_original_is(kind: Kind) -> None:
    estimator = kind(cell())
    estimator.learn(seen_window(extra_ms=7.0))
    busy = {"R": 0.0, "E": 1.0}
    shown = estimate(estimator, busy)
    twin, other = copy.deepcopy(estimator), copy.deepcopy(estimator)
    assert estimate(twin, busy) == shown
    other.learn(seen_window(extra_ms=3.0))
    assert estimate(other, busy)["OFF"].l95_ms < shown["OFF"].l95_ms
    for one in (estimator, twin):
        one.learn(seen_window(extra_ms=7.0))
        assert estimate(one, busy)["OFF"].l95_ms == pytest.approx(shown["OFF"].l95_ms)


@every
def test_it_is_deterministic(kind: Kind) -> None:
    problem = dwell.load(CANONICAL)
    runs = [
        dwell.simulate(
            problem,
            scenario="robot-cpu-stress",
            policy="cusum",
            estimator=kind(problem),
            seed=3,
            windows=15,
        ).decisions
        for _ in range(2)
    ]
    assert runs[0].equals(runs[1])


# ------------------------------------------------------------------------ presents at the edge


@every
def test_a_window_in_which_nothing_was_seen(kind: Kind) -> None:
    problem = cell()
    estimator, profile = kind(problem), Profile(problem)
    starts = [40.0 * i for i in range(10)]
    estimator.learn(window([GONE] * 10, close_ms=400.0, release_ms=starts))
    shown = estimate(estimator)
    for name in MOVES:
        assert of_price(shown[name]) == declared(profile, name)


@pytest.mark.parametrize("kind", [Shadow, Corrected])
def test_samples_that_come_one_by_one(kind: Kind) -> None:
    problem = with_windows(cell(), 1)
    estimator = kind(problem)
    for _ in range(6):
        estimator.learn(
            window([local_row(0.0)], close_ms=40.0, release_ms=[0.0], shadows=[off_row(0.0, 7.0)])
        )
        shown = estimate(estimator)["OFF"]
        # A single one may be chance; a few that say the same are not.
        assert shown.l95_ms in (14.0, pytest.approx(21.0))
    assert shown.l95_ms == pytest.approx(21.0)
    assert shown.error is not None


@pytest.mark.parametrize("kind", [Shadow, Corrected])
def test_where_every_shadow_is_lost_nothing_arrives(kind: Kind) -> None:
    problem = cell()
    estimator = kind(problem)
    estimator.learn(seen_window(extra_ms=0.0, lost=10))
    shown = estimate(estimator)["OFF"]
    assert (shown.violation_rate, shown.l95_ms) == (1.0, problem.censor_ms)
    assert shown.uncut_l95_ms == math.inf


@every
@pytest.mark.parametrize("retransmit_ms", [None, 5.0])
def test_a_link_with_a_loss_of_1(kind: Kind, retransmit_ms: float | None) -> None:
    one = Execution(Constant(1.0))
    links = [
        Link("R", "E", Constant(1.0), retransmit_ms=retransmit_ms),
        Link("E", "R", Constant(1.0)),
    ]
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("A", {"R": one}), Task("B", {"R": one, "E": one}), Task("C", {"R": one})],
        [Flow("A", "B"), Flow("B", "C")],
        links=links,
        candidates={"LOC": {}, "OFF": {"B": "E"}},
        window_cycles=10,
        scenario=[LinkDisturbance("R", "E", at_s=2.0, loss=1.0)],
        controller=ControllerSettings(shadow_fraction=0.5),
    )
    # Without shadows it is seen from OFF alone.
    for policy in ("OFF",) if kind is Scaling else ("LOC", "OFF"):
        decisions = dwell.simulate(
            problem,
            scenario="disturbed",
            policy=policy,
            estimator=kind(problem),
            seed=1,
            windows=8,
        ).decisions
        rates = decisions["est_violation_rate_OFF"].to_list()
        assert rates == [0.0] * 2 + [1.0] * 6
        assert set(decisions["est_violation_rate_LOC"]) == {0.0}


class Replay:
    """A policy that decides as it was told."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names

    def start(self, problem: Problem) -> None:
        self.next = iter(self.names)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(self.next)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("estimator", ["shadow", "scaling", "corrected"])
@pytest.mark.parametrize("seed", range(12))
def test_any_cell_gets_estimates_that_a_policy_can_use(seed: int, estimator: str) -> None:
    """Overloaded nodes, links and nodes that are down, orders that take time, cold migrations."""
    rng = Random(seed)
    problem = random_problem(rng, orders=True, whole_ms=seed % 3 == 0)
    windows, W = 12, rng.choice([1, 2, 5, 20])
    share = rng.choice([0.1, 0.3, 1.0]) / len(problem.candidates)
    settings = {
        **{f: getattr(problem.controller, f) for f in ("on", "migration", "order_delay_ms")},
        "shadow_fraction": share,
        "half_life_windows": rng.choice([0.01, 2.0, 50.0]),
    }
    problem = replace(problem, controller=ControllerSettings(**settings), window_cycles=W)
    names = [*random_stamps(rng, problem, 8 * windows), problem.initial]
    decisions = dwell.simulate(
        problem,
        scenario="disturbed",
        policy=Replay(names),
        estimator=estimator,
        seed=seed,
        windows=windows,
    ).decisions
    for name in problem.candidates:
        l95_ms = decisions[f"est_l95_ms_{name}"].drop_nulls().to_numpy()
        missed = decisions[f"est_violation_rate_{name}"].drop_nulls().to_numpy()
        assert np.isfinite(l95_ms).all()
        assert (l95_ms >= 0).all()
        assert (l95_ms <= problem.censor_ms + 1e-6).all()
        assert ((missed >= 0) & (missed <= 1)).all()


# ------------------------------------------------------------------------ how much is played


def beside_threads(off_ms: float, min_improvement: float) -> Run:
    """A run under LOC of one task on R or E, each of one core with a foreign thread."""
    problem = make_problem(
        [Node("R", "robot", 1), Node("E", "edge", 1)],
        [Task("work", on={"R": noisy_ms(10.0), "E": noisy_ms(off_ms)})],
        candidates={"LOC": {"work": "R"}, "OFF": {"work": "E"}},
        deadline_ms=25.0,
        window_cycles=50,
        scenario=[NodeDisturbance(name, stress_threads=1) for name in ("R", "E")],
        controller=ControllerSettings(min_improvement=min_improvement),
    )
    return run(problem, "LOC", "scaling", windows=15, scenario="disturbed")


def noisy_ms(median_ms: float) -> Execution:
    return Execution(LogNormal(median_ms, 0.3))


def errors_of_j(played: Run) -> list[float]:
    """Standard error of the difference in J, at every close but the first two."""
    estimates = played.decisions[2:]
    found = []
    for row in estimates.iter_rows(named=True):
        both = [
            cost_error(
                (row[f"est_l95_error_ms_{name}"], row[f"est_violation_error_{name}"]),
                played.problem.objective,
            )
            for name in played.problem.candidates
        ]
        found.append(math.hypot(*both))
    return found


def test_what_cannot_be_better_is_played_no_more() -> None:
    errors = errors_of_j(beside_threads(off_ms=30.0, min_improvement=0.03))
    assert errors[0] > 0.03 / 3
    assert set(errors) == {errors[0]}


def test_what_is_better_by_far_is_played_no_more() -> None:
    errors = errors_of_j(beside_threads(off_ms=1.0, min_improvement=0.03))
    assert errors[0] > 0.03 / 3
    assert set(errors) == {errors[0]}


@pytest.mark.parametrize("min_improvement", [0.4, 0.9])
def test_what_may_be_better_is_played_until_it_is_known(min_improvement: float) -> None:
    errors = errors_of_j(beside_threads(off_ms=8.5, min_improvement=min_improvement))
    assert errors[-1] <= min_improvement / 3
    known = next(i for i, error in enumerate(errors) if error <= min_improvement / 3)
    assert set(errors[known:]) == {errors[known]}


def test_where_any_gain_is_enough_all_is_played_that_ever_is() -> None:
    errors = errors_of_j(beside_threads(off_ms=9.5, min_improvement=0.0))
    assert errors[0] > errors[1] > errors[2]
    assert set(errors[2:]) == {errors[2]}


# --------------------------------------------------------------------- moves that are known


def run(
    problem: Problem,
    policy: str,
    estimator: str,
    *,
    windows: int,
    seed: int = 1,
    scenario: str = "baseline",
) -> Run:
    return dwell.simulate(
        problem,
        scenario=scenario,
        policy=policy,
        estimator=estimator,
        seed=seed,
        windows=windows,
    )


def moves(played: Run) -> list[tuple[int, str]]:
    """Windows at whose close a move was ordered, and where to."""
    made = played.decisions.filter(pl.col("migrated"))
    return list(zip(made["window"].to_list(), made["placement"].to_list(), strict=True))


@pytest.mark.parametrize("estimator", ["profile", "shadow", "scaling", "corrected"])
@pytest.mark.parametrize("policy", ["dtp", "cusum", "latency-first", "work-function"])
def test_tasks_that_wait_for_each_other_part_for_good(policy: str, estimator: str) -> None:
    """At once, or as soon as the dwell allows."""
    problem = dwell.load(KNOWN_MOVES / "parallel.yaml")
    played = run(problem, policy, estimator, windows=40)
    ((window, name),) = moves(played)
    assert name == "OFF"
    assert window in (0, problem.min_dwell)
    assert set(played.windows["violation_rate"][window + 1 :]) == {0.0}


@pytest.mark.parametrize("estimator", ["profile", "shadow", "corrected"])
@pytest.mark.parametrize("policy", ["dtp", "work-function"])
def test_between_equal_placements_nothing_moves(policy: str, estimator: str) -> None:
    """Either pays for the shadow jobs that it would send through the other."""
    problem = dwell.load(KNOWN_MOVES / "equal.yaml")
    assert moves(run(problem, policy, estimator, windows=300)) == []


@pytest.mark.parametrize("estimator", ["shadow", "corrected"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_few_samples_of_what_varies_are_no_news(seed: int, estimator: str) -> None:
    problem = dwell.load(KNOWN_MOVES / "varying-link.yaml")
    assert len(moves(run(problem, "dtp", estimator, windows=300, seed=seed))) <= 2


@pytest.mark.parametrize("policy", ["dtp", "cusum"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_queue_that_is_gone_grows_again_where_the_cell_goes_back(seed: int, policy: str) -> None:
    problem = dwell.load(KNOWN_MOVES / "growing-queue.yaml")
    assert len(moves(run(problem, policy, "corrected", windows=300, seed=seed))) <= 2


def test_what_waits_where_it_runs_need_not_wait_elsewhere() -> None:
    problem = dwell.load(KNOWN_MOVES / "growing-queue.yaml")
    (window, name), *_ = moves(run(problem, "dtp", "scaling", windows=20))
    assert name == "SO"
    assert window <= problem.min_dwell + 2


@pytest.mark.parametrize("estimator", ["shadow", "corrected"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_step_is_one_move(seed: int, estimator: str) -> None:
    problem = dwell.load(KNOWN_MOVES / "step.yaml")
    played = run(problem, "dtp", estimator, windows=120, seed=seed, scenario="step")
    assert moves(played) == [(50, "LOC")]
