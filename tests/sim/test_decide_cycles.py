"""Decisions that come more often than windows close."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

import dwell
from dwell.cellfile.overrides import load_with
from dwell.cli.check import class_faults
from dwell.control import Controller
from dwell.control.windows import missed_cycles, seen_l95_ms
from dwell.cost import cost, hamming
from dwell.errors import ProblemError
from dwell.estimators import Estimator, Evidence, warnings_of
from dwell.model import FrozenDict, Problem, QoS
from dwell.model.fleet import Fleet, FleetEntry
from dwell.model.window_close import window_close_ns
from dwell.policies.atp_thresholds import find_pairs
from dwell.record import Run
from dwell.sim.engine import describe, simulate_realisation
from dwell.study.hindsight import Hindsight
from dwell.study.judged_cost import judged_costs
from dwell.study.reference import play_alone, references
from tests.cells.examples import EXAMPLES
from tests.cells.generated import random_problem
from tests.reference.algorithm_1 import price
from tests.reference.algorithm_1 import switching as moved_share

CANONICAL = dwell.load(EXAMPLES / "canonical.yaml")


def often(problem: Problem, every: int | None, **changes: Any) -> Problem:
    controller = replace(problem.controller, decide_cycles=every, **changes)
    return replace(problem, controller=controller)


class Walker:
    """A policy that moves at given calls, and keeps what it was shown."""

    def __init__(self, moves: Mapping[int, str]) -> None:
        self.moves, self.calls = dict(moves), 0
        self.incumbent = "LOC"
        self.seen: list[QoS] = []

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Move if this call is one of the given."""
        self.seen.append(observed)
        self.incumbent = self.moves.get(self.calls, self.incumbent)
        self.calls += 1
        return self.incumbent

    def adopt(self, name: str) -> None:
        """Be there."""
        self.incumbent = name


def walked(problem: Problem, moves: Mapping[int, str], windows: int = 6, seed: int = 3) -> Run:
    real = dwell.draw(problem, scenario="baseline", seed=seed, windows=windows)
    return simulate_realisation(problem, real, policy=Walker(moves), estimator="profile")


def switched(run: Run, problem: Problem) -> np.ndarray[Any, np.dtype[np.float64]]:
    """S of the move that takes effect with each cycle."""
    names = run.cycles["placement"].cast(str).to_list()
    places = problem.candidates
    moved = [0.0, *(hamming(places[b], places[a]) for a, b in pairwise(names))]
    return np.array(moved)


def begins(run: Run, row: Mapping[str, Any]) -> int:
    """Return the first cycle under the placement that a decision looks at."""
    names = run.cycles["placement"].cast(str).to_list()
    cycle: int = row["last_cycle"]
    while cycle and names[cycle - 1] == names[cycle]:
        cycle -= 1
    return cycle


def test_windows_run_on_over_moves_and_pay_for_them() -> None:
    problem = often(CANONICAL, 25)
    run = walked(problem, {1: "SO", 6: "HYB", 7: "LOC"})
    width, windows = problem.window_cycles, run.windows
    assert windows["first_cycle"].to_list() == [width * i for i in range(6)]
    assert not run.cycles["lead"].any()
    assert windows["mixed"].to_list() == [True, True, True, False, False, False]
    moved = switched(run, problem).reshape(6, width).sum(axis=1)
    assert moved[3:].tolist() == [0.0, 0.0, 0.0]
    resources, weight = problem.fabric.resources, problem.objective.weights.switching
    for row, switching in zip(windows.iter_rows(named=True), moved, strict=True):
        used = FrozenDict({name: row[f"u_{name}"] for name in resources})
        qos = QoS(row["seen_l95_ms"], row["seen_violation_rate"], used)
        alone = cost(qos, problem.candidates["LOC"], problem.candidates["LOC"], problem.objective)
        assert row["cost"] == pytest.approx(alone + weight * switching, abs=1e-12)


def test_cycles_before_an_orders_first_stamp_belong_to_windows() -> None:
    problem = often(CANONICAL, 20, order_lead_cycles=7)
    run = walked(problem, {0: "SO"})
    decision = run.decisions.row(0, named=True)
    assert (decision["last_cycle"], decision["cycles"], decision["migrated"]) == (19, 20, True)
    placed = run.cycles["placement"].cast(str).to_list()
    assert placed.index("SO") == 27
    # The next decision looks at 20 cycles from there on.
    following = run.decisions.row(1, named=True)
    assert (following["last_cycle"], following["cycles"]) == (46, 20)
    assert run.windows["violation_rate"][0] == run.cycles["missed"][:100].mean()


@pytest.mark.parametrize(("lead", "delay_ms"), [(0, 0.0), (7, 0.0), (0, 90.0)])
@pytest.mark.parametrize("scenario", ["robot-cpu-stress", "network-impairment"])
def test_j_counted_again_over_fixed_stretches(scenario: str, lead: int, delay_ms: float) -> None:
    problem = often(
        CANONICAL, 25, min_dwell=0, order_lead_cycles=lead, order_delay_ms=delay_ms, on="R2"
    )
    run = dwell.simulate(problem, scenario=scenario, policy="cusum", seed=5, windows=20)
    width, objective = problem.window_cycles, problem.objective
    cycles = list(run.cycles.iter_rows(named=True))
    moves = 0
    for i, row in enumerate(run.windows.iter_rows(named=True)):
        stretch = cycles[i * width : (i + 1) * width]
        close_ns = stretch[-1]["release_ns"] + problem.pipeline.period_ns
        ages = [(one["latency_ns"] or math.inf, close_ns - one["release_ns"]) for one in stretch]
        seen = sorted(min(latency, age) for latency, age in ages)
        l95_ms = min(seen[math.ceil(0.95 * width) - 1] / 1e6, problem.censor_ms)
        deadline_ns = problem.pipeline.deadline_ms * 1e6
        missed = sum(latency > min(age, deadline_ns) for latency, age in ages) / width
        used = FrozenDict({name: row[f"u_{name}"] for name in problem.fabric.resources})
        placed = [one["placement"] for one in cycles[max(i * width - 1, 0) : (i + 1) * width]]
        switched = [
            moved_share(problem.candidates[b], problem.candidates[a]) for a, b in pairwise(placed)
        ]
        moves += sum(share > 0 for share in switched)
        here = problem.candidates[placed[-1]]
        J = price(QoS(l95_ms, missed, used), here, here, objective)
        J += objective.weights.switching * sum(switched)
        assert row["cost"] == pytest.approx(J, rel=1e-9)
    assert moves == run.decisions["migrated"].sum() > 1
    assert len(cycles) == 20 * width


@pytest.mark.parametrize("every", [25, 30, 99])
def test_a_decision_looks_at_the_last_window_under_its_placement(every: int) -> None:
    problem = often(CANONICAL, every)
    run = walked(problem, {4: "SO"}, windows=8)
    width = problem.window_cycles
    latency, release = run.cycles["latency_ns"].to_numpy(), run.cycles["release_ns"].to_numpy()
    releases = np.append(release, release[-1] + problem.pipeline.period_ns)
    walker = Walker({4: "SO"})
    real = dwell.draw(problem, scenario="baseline", seed=3, windows=8)
    again = simulate_realisation(problem, real, policy=walker, estimator="profile")
    assert again.decisions.equals(run.decisions)
    for row in run.decisions.iter_rows(named=True):
        last, begin = row["last_cycle"], begins(run, row)
        assert last == begin + every * ((last - begin + 1) // every) - 1
        assert row["cycles"] == min(width, last + 1 - begin)
        looked = slice(last + 1 - row["cycles"], last + 1)
        close_ns = int(window_close_ns(problem, releases[last], releases[last + 1]))
        age = close_ns - release[looked]
        l95_ms, _ = seen_l95_ms(latency[looked], age, problem.censor_ms)
        missed = missed_cycles(latency[looked], age, problem.pipeline.deadline_ns)
        assert row[f"est_l95_ms_{row['incumbent']}"] == float(l95_ms)
        assert row[f"est_violation_rate_{row['incumbent']}"] == missed / row["cycles"]
        assert row["window"] == last // width


def test_only_the_first_decision_after_a_move_pays_for_it() -> None:
    problem = often(CANONICAL, 25, min_dwell=0, min_improvement=0.0)
    real = dwell.draw(problem, scenario="baseline", seed=3, windows=10)
    run = simulate_realisation(problem, real, policy="dtp", estimator="profile")
    paid = run.decisions.filter(run.decisions["migrated"].shift(1, fill_value=False))
    assert paid.height > 2
    for row in paid.iter_rows(named=True):
        # Delta J has the switching term of the incumbent's own move; J of the candidates has not.
        assert row["delta_j"] > row[f"j_{row['incumbent']}"] - min(
            row[f"j_{name}"] for name in problem.candidates
        )


@pytest.mark.parametrize("policy", ["dtp", "atp"])
@pytest.mark.parametrize("every", [7, 25, 100])
def test_a_placement_stays_for_the_dwell_and_one_decision_more(policy: str, every: int) -> None:
    for dwell_windows, dwell_cycles in ((0, 0), (1, 0), (0, 110), (2, 310)):
        problem = often(
            CANONICAL,
            every,
            min_dwell=dwell_windows,
            min_dwell_cycles=dwell_cycles,
            min_improvement=0.0,
        )
        least = max(100 * dwell_windows, dwell_cycles)
        scenario = "network-impairment"
        run = dwell.simulate(problem, scenario=scenario, policy=policy, seed=2, windows=40)
        moves = 0
        for row in run.decisions.iter_rows(named=True):
            since = row["last_cycle"] + 1 - begins(run, row)
            assert row["dwell_cycles"] == (0 if row["migrated"] else since)
            assert row["dwell"] == row["dwell_cycles"] // 100
            if row["migrated"]:
                assert since >= least + every
                moves += 1
        cycles = 40 * 100
        assert moves <= cycles // (-(-least // every) * every + every)
        assert moves > 0 or policy == "atp"


class Fickle:
    """Expects the least of every placement that is not in force, at each decision."""

    def start(self, problem: Problem) -> None:
        """Take the names."""
        self.names, self.resources = tuple(problem.candidates), tuple(problem.fabric.resources)

    def learn(self, evidence: Evidence) -> None:
        """Learn nothing."""

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Prefer all but the incumbent."""
        used = dict.fromkeys(self.resources, 0.0)
        return {name: QoS(1.0, float(name == incumbent), used) for name in self.names}


@settings(max_examples=40)
@given(st.data())
def test_windows_hold_a_bounded_number_of_moves(data: st.DataObject) -> None:
    problem = random_problem(Random(data.draw(st.integers(0, 99), "cell")), orders=True)
    width, windows = problem.window_cycles, 12
    controller = replace(
        problem.controller,
        decide_cycles=data.draw(st.integers(1, width), "decide_cycles"),
        min_dwell=data.draw(st.none() | st.integers(0, 3), "min_dwell"),
        min_dwell_cycles=data.draw(st.just(0) | st.integers(0, 3 * width), "min_dwell_cycles"),
        min_improvement=0.0,
        escape=False,
    )
    problem = replace(problem, controller=controller)
    policy = data.draw(st.sampled_from(["dtp", "atp"]), "policy")
    if policy == "atp" and not find_pairs(problem.candidates, problem.objective.tiers):
        policy = "dtp"
    run = dwell.simulate(
        problem, scenario="disturbed", policy=policy, estimator=Fickle(), seed=1, windows=windows
    )
    stated = run.problem.controller.min_dwell
    assert stated is not None
    assert stated == (3 if controller.min_dwell is None else controller.min_dwell)
    least = max(stated * width, controller.min_dwell_cycles) + problem.decide_cycles
    placed = run.cycles["placement"].cast(str).to_list()
    took_effect = [cycle for cycle in range(1, len(placed)) if placed[cycle] != placed[cycle - 1]]
    assert run.decisions["migrated"].sum() <= windows * width // least
    assert all(after - before >= least for before, after in pairwise([0, *took_effect]))


@pytest.mark.parametrize("seed", range(6))
def test_cells_at_random_are_decided_on_in_time(seed: int) -> None:
    rng = Random(seed)
    problem = random_problem(rng, orders=True)
    every = rng.randint(1, max(problem.window_cycles - 1, 1))
    problem = often(problem, every)
    run = dwell.simulate(problem, scenario="disturbed", policy="cusum", seed=seed, windows=20)
    last = run.decisions["last_cycle"].to_numpy()
    assert (np.diff(last) >= every).all()
    if problem.controller.migration == "warm" and every < problem.window_cycles:
        assert run.windows.height == 20
        stays = ~run.decisions["migrated"].to_numpy()[:-1]
        # Decisions that the controller missed, because its node was down, have no row.
        assert (np.diff(last)[stays] % every == 0).all()


def test_without_an_interval_there_are_four_decisions_per_window() -> None:
    for policy in ("dtp", "cusum", "work-function", "atp", "latency-first"):
        for estimator in ("profile", "corrected"):
            runs = [
                dwell.simulate(
                    often(CANONICAL, every),
                    scenario="edge-cpu-stress",
                    policy=policy,
                    estimator=estimator,
                    seed=4,
                    windows=12,
                )
                for every in (None, CANONICAL.window_cycles // 4)
            ]
            for table in ("cycles", "windows", "decisions"):
                one, other = (getattr(run, table) for run in runs)
                assert one.equals(other)


@pytest.mark.parametrize(
    ("estimator", "windows"), [("profile", 3), ("corrected", 0), (Fickle(), 3)]
)
def test_a_run_says_the_dwell_that_its_estimator_gives(
    estimator: Estimator | str, windows: int
) -> None:
    problem = often(CANONICAL, 25, min_dwell=None)
    for policy in ("dtp", "atp", "atp-thresholds"):
        named: dict[str, Any] = {"policy": policy, "estimator": estimator}
        run = dwell.simulate(problem, **named, seed=1, windows=2)
        assert run.problem.controller.min_dwell == windows
        assert run.meta["parameters"]["min_dwell"] == 4 * windows
        assert describe(problem, **named, seed=1, windows=2) == run.meta
        stated = often(CANONICAL, 25, min_dwell=windows)
        again = dwell.simulate(stated, **named, seed=1, windows=2)
        assert again.decisions.equals(run.decisions)


class Asks:
    """A policy that keeps the dwell of its cell."""

    def __init__(self, min_dwell: int | None) -> None:
        self.min_dwell = min_dwell

    @classmethod
    def from_problem(cls, problem: Problem) -> Asks:
        """Take the dwell that the controller states."""
        return cls(problem.controller.min_dwell)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Stay."""
        return "LOC"


def test_a_policy_of_a_users_own_gets_the_dwell_as_a_number() -> None:
    problem = often(CANONICAL, 25, min_dwell=None, policy=f"{__name__}:Asks")
    for estimator, windows in (("profile", 3), ("corrected", 0)):
        made = Controller(problem, estimator=estimator).policy
        assert isinstance(made, Asks)
        assert made.min_dwell == windows
    assert not [*class_faults(problem)]


@pytest.mark.parametrize(("width", "every"), [(1, 1), (3, 1), (4, 1), (7, 1), (8, 2), (100, 25)])
def test_the_interval_is_a_quarter_of_a_window(width: int, every: int) -> None:
    assert replace(often(CANONICAL, None), window_cycles=width).decide_cycles == every


def test_an_improvement_of_nothing_is_enough_if_none_is_asked_for() -> None:
    problem = often(CANONICAL, 25, min_dwell=None, min_improvement=0)
    for estimator in ("profile", "corrected"):
        run = dwell.simulate(problem, policy="dtp", estimator=estimator, seed=3, windows=8)
        gains = run.decisions.filter("migrated")["delta_j"]
        assert (gains > 0).all()
    assert not any("min_improvement" in fault.path for fault in warnings_of(problem))


def test_it_is_at_most_a_window() -> None:
    with pytest.raises(ProblemError, match=r"controller\.decide_cycles: 101 is not allowed.*100"):
        often(CANONICAL, 101)
    with pytest.raises(ProblemError, match=r"decide_cycles"):
        often(CANONICAL, 0)


@pytest.mark.parametrize("given", ["0", "-1", "2.5", "101", "true", "often", "[5]", ".nan"])
def test_a_cell_file_with_another_interval_is_refused(given: str) -> None:
    with pytest.raises(ProblemError) as caught:
        load_with(EXAMPLES / "canonical.yaml", [f"controller.decide_cycles={given}"])
    (fault,) = caught.value.faults
    assert "decide_cycles" in fault.path


@pytest.mark.parametrize("every", [1, 25])
def test_without_a_least_improvement_a_gain_of_nothing_moves_no_cell(every: int) -> None:
    problem = often(CANONICAL, every, min_dwell=0, min_improvement=0.0)
    run = dwell.simulate(problem, policy="dtp", estimator="profile", seed=1, windows=5)
    for row in run.decisions.filter("migrated").iter_rows(named=True):
        assert row["delta_j"] > 0
    moves = run.decisions["migrated"].sum()
    assert moves <= len(run.decisions) < 5 * 100 / every + 1


@pytest.mark.parametrize("every", [25, 100])
def test_a_judge_of_a_run_counts_the_moves_of_each_window(every: int) -> None:
    problem = often(CANONICAL, every)
    run = walked(problem, {1: "SO", 3: "HYB", 4: "LOC"})
    assert judged_costs(run, problem) == pytest.approx(run.windows["cost"].to_numpy(), abs=1e-12)


def test_hindsight_knows_the_last_window_at_each_decision() -> None:
    problem = often(CANONICAL, 25)
    real = dwell.draw(problem, scenario="baseline", seed=3, windows=4)
    alone = play_alone(problem, real)
    run = simulate_realisation(problem, real, policy="LOC", estimator=Hindsight(alone))
    for row in run.decisions.iter_rows(named=True):
        # It never moves, so it is what was seen, of the last 100 cycles or fewer.
        latency = run.cycles["latency_ns"][
            row["last_cycle"] + 1 - row["cycles"] : row["last_cycle"] + 1
        ]
        late = (latency > problem.pipeline.deadline_ns).mean()
        assert row["est_violation_rate_LOC"] == late


def test_the_oracle_decides_as_often_as_the_cell_does() -> None:
    problem = often(CANONICAL, 25)
    real = dwell.draw(problem, scenario="robot-cpu-stress", seed=3, windows=10)
    found = references(problem, real)
    assert found.runs["oracle"].decisions.height > 3 * 10
    assert found.runs["clairvoyant"].decisions.height == 10
    assert found.costs["oracle"] < found.costs["LOC"]


# ------------------------------------------------------------------------------------- fleets

TABLES = ("cycles", "windows", "decisions")


def hall(problems: list[Problem], coordination: str, scenario: str = "robot-cpu-stress") -> Fleet:
    entries = tuple(FleetEntry(problem, 1, scenario) for problem in problems)
    return Fleet("hall", entries, ("E",), phases="random", coordination=coordination)  # type: ignore[arg-type]


def named(name: str, every: int | None, **settings: Any) -> Problem:
    return replace(often(CANONICAL, every, **settings), name=name)


@pytest.mark.parametrize("guard", [False, True])
@pytest.mark.parametrize("every", [17, 25])
def test_a_fleet_of_one_decides_as_its_cell_alone(every: int, guard: bool) -> None:
    problem = often(CANONICAL, every, on="E", min_dwell=0)
    settings: dict[str, Any] = {"policy": "dtp+corrected", "seed": 3, "windows": 8, "guard": guard}
    alone = dwell.simulate(problem, scenario="edge-cpu-stress", **settings)
    fleet = replace(hall([problem], "none", "edge-cpu-stress"), phases="sync")
    (run,) = dwell.simulate_fleet(fleet, **settings).cells.values()
    for table in TABLES:
        assert_frame_equal(getattr(run, table), getattr(alone, table))


def test_cells_of_a_fleet_that_share_nothing_decide_as_alone() -> None:
    problems = [named(f"cell-{every}", every) for every in (10, 25, 60, 99)]
    fleet = replace(hall(problems, "none"), shared=(), phases="sync")
    together = dwell.simulate_fleet(fleet, policy="cusum+corrected", seed=2, windows=6)
    for problem, run in zip(problems, together.cells.values(), strict=True):
        alone = dwell.simulate(
            problem, scenario="robot-cpu-stress", policy="cusum+corrected", seed=2, windows=6
        )
        for table in TABLES:
            assert_frame_equal(getattr(run, table), getattr(alone, table))


@pytest.mark.parametrize("coordination", ["none", "random", "ledger"])
def test_each_cell_of_a_fleet_decides_at_its_own_interval(coordination: str) -> None:
    intervals = (10, 25, 60, 100)
    problems = [named(f"cell-{every}", every, min_dwell=0) for every in intervals]
    fleet = hall(problems, coordination)
    played = dwell.simulate_fleet(fleet, policy="dtp+corrected", seed=1, windows=8)
    rounds = []
    for every, run in zip(intervals, played.cells.values(), strict=True):
        if every < 100:
            assert run.windows["first_cycle"].to_list() == [100 * i for i in range(8)]
        release_ns = run.cycles["release_ns"]
        for row in run.decisions.iter_rows(named=True):
            begin = begins(run, row)
            assert (row["last_cycle"] + 1 - begin) % every == 0
            assert row["cycles"] == min(100, row["last_cycle"] + 1 - begin)
            if coordination == "ledger":
                at_ns = release_ns[row["last_cycle"]] + run.problem.pipeline.period_ns
                rounds.append((at_ns, row["round"], (row["phi_before"], row["phi_after"])))
    assert played.decisions["migrated"].sum() > 0
    # A round takes the cells that decide, in the order of their instants.
    rounds.sort()
    assert [number for _, number, _ in rounds] == sorted(number for _, number, _ in rounds)
    # Members of a set have the same round and the same Φ; all other rounds have one row.
    asked = {(number, *phi) for _, number, phi in rounds if None not in phi}
    assert len(asked) == len({number for number, *_ in asked})
