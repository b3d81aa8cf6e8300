"""The Controller: what it takes from an estimator, and what it writes down of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.control import ClosedWindow, Controller, Evidence, LookedAt
from dwell.errors import DwellError, MetricError, ProblemError
from dwell.estimators import Corrected, Learner, Shadow, Support
from dwell.model import Problem, QoS
from dwell.model.fleet import Fleet, FleetEntry
from dwell.policies import DTP, LatencyFirst, MinimalPolicy, Static
from tests.cells.deterministic import MOVES, cell
from tests.cells.many import many

SETTINGS = {"profile": 0.0, "shadow": 0.1, "scaling": 0.0, "corrected": 0.1}


class Copycat:
    """A learner that expects of every candidate what it saw, and says what stands behind it."""

    def __init__(self, shadow_fraction: float = 0.0, supported: tuple[str, ...] = tuple(MOVES)):
        self.shadow_fraction = shadow_fraction
        self.supported = supported

    def start(self, problem: Problem) -> None:
        """Begin with nothing seen."""
        self.windows = 0

    def learn(self, evidence: Evidence) -> None:
        """Count the windows."""
        self.windows += 1

    def support(self) -> Mapping[str, Support]:
        """As many samples as windows."""
        return {name: Support(self.windows, float(i)) for i, name in enumerate(self.supported)}

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Expect the same of all."""
        return dict.fromkeys(MOVES, observed)


def fractions_of(controller: Controller) -> set[float]:
    """Return the shares that the alternatives get, whatever the placement."""
    return set(controller.shadow_fractions.values())


@pytest.mark.parametrize(("name", "fraction"), SETTINGS.items())
def test_who_learns_and_who_wants_shadows(name: str, fraction: float) -> None:
    controller = Controller(cell(estimator=name))
    assert controller.learns == (name != "profile")
    assert controller.supports == controller.learns
    assert fractions_of(controller) == {fraction}


def test_a_policys_name_may_bring_its_estimator() -> None:
    problem = cell(estimator="profile")
    named = Controller(problem, "cusum+corrected")
    apart = Controller(problem, "cusum", "corrected")
    assert named.described() == apart.described()
    assert named.described()["estimator"] == "Corrected"
    assert Controller(problem, "cusum").described()["estimator"] == "Profile"
    assert Controller(problem, "dtp+shadow", "shadow").described()["estimator"] == "Shadow"


def test_a_candidate_may_have_a_plus_in_its_name() -> None:
    problem = cell()
    name = next(iter(problem.candidates))
    both = replace(problem, candidates={**problem.candidates, "a+b": problem.candidates[name]})
    assert Controller(both, "a+b").course.placement == "a+b"


@pytest.mark.parametrize(
    ("policy", "estimator", "message"),
    [
        ("cusum+corrected", "shadow", "'cusum\\+corrected' names its estimator"),
        ("cusum+corected", None, "unknown estimator 'corected'"),
        ("cusumm+corrected", None, "unknown policy 'cusumm'"),
    ],
)
def test_a_wrong_name_with_an_estimator_is_refused(
    policy: str, estimator: str | None, message: str
) -> None:
    with pytest.raises(DwellError, match=message):
        Controller(cell(), policy, estimator)


@pytest.mark.parametrize("estimator", [Shadow, Corrected])
def test_what_an_estimator_was_made_with_goes_before_the_cell_file(
    estimator: type[Shadow] | type[Corrected],
) -> None:
    problem = cell(shadow_fraction=0.1)
    assert fractions_of(Controller(problem, estimator=estimator(problem, 0.2))) == {0.2}
    assert fractions_of(Controller(problem, estimator=estimator(problem, 0.0))) == {0.0}


@pytest.mark.parametrize(
    ("fraction", "message"),
    [
        (0.3, "shadow_fraction of Copycat: 0.3 of the cycles through each of 4 alternatives is"),
        (-0.1, "shadow_fraction of Copycat: -0.1 is not allowed; it must be a number from 0 to 1"),
        (float("nan"), "shadow_fraction of Copycat: nan is not allowed"),
        ("0.1", "shadow_fraction of Copycat: '0.1' is not allowed"),
    ],
)
def test_more_shadows_than_cycles_are_refused(fraction: float, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        Controller(cell(), estimator=Copycat(fraction))


def test_every_alternative_may_have_its_even_share() -> None:
    assert fractions_of(Controller(cell(), estimator=Copycat(0.25))) == {0.25}
    problem = cell(candidates=("LOC", "FAR", "OFF", "SINK"))
    assert fractions_of(Controller(problem, estimator=Copycat(1 / 3))) == {1 / 3}
    assert fractions_of(Controller(cell(candidates=("LOC",)), estimator=Copycat(1.0))) == {1.0}


def test_a_learner_is_started_on_a_copy_and_sees_every_window() -> None:
    mine = Copycat()
    assert isinstance(mine, Learner)
    run = dwell.simulate(cell(), policy="LOC", estimator=mine, seed=1, windows=4)
    assert not hasattr(mine, "windows")
    for i, name in enumerate(MOVES):
        assert run.decisions[f"est_samples_{name}"].to_list() == [1.0, 2.0, 3.0, 4.0]
        assert run.decisions[f"est_age_windows_{name}"].to_list() == [float(i)] * 4


def test_an_estimator_without_support_has_no_columns_of_it() -> None:
    run = dwell.simulate(cell(), policy="LOC", estimator="profile", seed=1, windows=2)
    assert not [name for name in run.decisions.columns if name.startswith("est_samples")]
    assert [name for name in run.decisions.columns if name.startswith("est_l95_ms")]


def test_a_support_that_leaves_a_candidate_out_is_named() -> None:
    with pytest.raises(MetricError, match=r"Copycat.support says something of LOC, OFF; it must"):
        dwell.simulate(
            cell(), policy="LOC", estimator=Copycat(supported=("LOC", "OFF")), seed=1, windows=2
        )


def test_neither_own_jobs_nor_shadow_jobs_are_foreign() -> None:
    seen: list[Mapping[str, float]] = []

    class Listener(Copycat):
        def __deepcopy__(self, memo: object) -> Listener:
            return self

        def estimate(
            self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
        ) -> Mapping[str, QoS]:
            seen.append(own)
            return super().estimate(observed=observed, incumbent=incumbent, own=own)

    controller = Controller(cell(), policy="LOC", estimator=Listener())
    core_ns = np.array([[8.0, 4.0], [3.0, 0.0], [1.0, 4.0]]) * 1e6
    controller.propose(
        ClosedWindow(
            latency_ns=np.array([10_000_000, 20_000_000]),
            release_ns=np.array([0, 40_000_000]),
            close_ns=80_000_000,
            open_ns=0,
            core_ns=core_ns * 16,
            looked=LookedAt(0, 1, 2),
        )
    )
    assert seen == [{"R": 4 / 80, "E": 4 / 80}]


class Stubborn(Copycat):
    """A learner that expects the same of every candidate, whatever it sees."""

    QOS = QoS(33.0, 0.25, {"R": 0.5, "E": 0.125}, error=(2.5, 0.0625))

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Expect it."""
        return dict.fromkeys(MOVES, self.QOS)


class Keeper:
    """A policy of a user's that stays, and keeps what it was shown."""

    initial = "OFF"

    def __init__(self) -> None:
        self.shown: list[tuple[QoS, QoS]] = []

    def __deepcopy__(self, memo: object) -> Keeper:
        return self

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Stay."""
        self.shown.append((observed, estimates["OFF"]))
        return "OFF"


ERRORS = ("est_l95_error_ms", "est_violation_error")


def in_windows(problem: Problem, cycles: int) -> Problem:
    """Return the problem with other windows, each of which ends with a decision."""
    controller = replace(problem.controller, decide_cycles=cycles)
    return replace(problem, window_cycles=cycles, controller=controller)


@pytest.mark.parametrize("policy", ["OFF", "keeper"])
def test_without_learning_the_incumbents_estimate_is_what_was_observed(policy: str) -> None:
    """The kernel decides for the one, the controller for the other."""
    keeper = Keeper()
    problem = in_windows(cell(estimator="profile"), 20)
    run = dwell.simulate(
        problem,
        scenario="disturbed",
        policy=keeper if policy == "keeper" else policy,
        seed=1,
        windows=3,
    )
    shown = run.decisions.select("est_l95_ms_OFF", "est_violation_rate_OFF").rows()
    assert shown == run.windows.select("seen_l95_ms", "seen_violation_rate").rows()
    assert all(observed is estimate for observed, estimate in keeper.shown)
    for name in MOVES:
        assert all(run.decisions[f"{column}_{name}"].to_list() == [0.0] * 3 for column in ERRORS)


def test_a_learners_estimate_of_the_incumbent_is_its_own() -> None:
    keeper = Keeper()
    problem = in_windows(cell(), 20)
    run = dwell.simulate(
        problem, scenario="disturbed", policy=keeper, estimator=Stubborn(), seed=1, windows=3
    )
    assert [estimate for _, estimate in keeper.shown] == [Stubborn.QOS] * 3
    seen = [(observed.l95_ms, observed.violation_rate) for observed, _ in keeper.shown]
    assert run.windows.select("seen_l95_ms", "seen_violation_rate").rows() == seen
    for name in MOVES:
        columns = ("est_l95_ms", "est_violation_rate", *ERRORS)
        shown = run.decisions.select([f"{column}_{name}" for column in columns]).rows()
        assert shown == [(33.0, 0.25, 2.5, 0.0625)] * 3


@pytest.mark.parametrize("policy", ["dtp", "cusum", "work-function", "latency-first", "atp"])
def test_what_is_observed_moves_nothing_where_the_estimator_learns(policy: str) -> None:
    """The same is expected everywhere: whatever the incumbent shows, it is no reason to leave."""
    problem = dwell.load("examples/canonical.yaml")

    class Even(Copycat):
        def estimate(
            self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
        ) -> Mapping[str, QoS]:
            used = dict.fromkeys(problem.fabric.nodes, 0.3)
            return dict.fromkeys(problem.candidates, QoS(30.0, 0.0, used))

        def support(self) -> Mapping[str, Support]:
            return dict.fromkeys(problem.candidates, Support(1.0, 0.0))

    run = dwell.simulate(
        problem,
        scenario="robot-cpu-stress",
        policy=policy,
        estimator=Even(),
        seed=1,
        windows=20,
    )
    assert run.windows["seen_l95_ms"].max() > 60.0  # type: ignore[operator]
    assert not run.decisions["migrated"].any()


@pytest.mark.parametrize("estimator", [Shadow, Corrected])
def test_of_many_candidates_only_a_fraction_that_is_given_is_refused(
    estimator: type[Shadow] | type[Corrected],
) -> None:
    problem = many(22)
    assert fractions_of(Controller(problem, estimator=estimator(problem))) == {1 / 21}
    with pytest.raises(ProblemError, match="each of 21 alternatives is more than all cycles"):
        Controller(problem, estimator=estimator(problem, 0.05))


@pytest.mark.parametrize(
    ("policy", "estimator"),
    [
        (None, "Corrected"),
        ("dtp", "Corrected"),
        ("cusum", "Corrected"),
        ("atp", "Corrected"),
        ("work-function", "Corrected"),
        ("LOC", "Profile"),
        ("latency-first", "Profile"),
        ("atp-thresholds", "Profile"),
        ("LOC+corrected", "Corrected"),
        ("latency-first+corrected", "Corrected"),
        (Keeper(), "Corrected"),
    ],
)
def test_each_policy_has_its_usual_estimator(
    policy: MinimalPolicy | str | None, estimator: str
) -> None:
    problem = dwell.load("examples/first.yaml")
    controller = Controller(problem, policy)
    assert type(controller.estimator).__name__ == estimator
    assert controller.sends_shadows == (estimator == "Corrected")
    named = replace(problem, controller=replace(problem.controller, estimator="scaling"))
    if policy is None or not isinstance(policy, str) or "+" not in policy:
        assert type(Controller(named, policy).estimator).__name__ == "Scaling"


def test_an_object_of_our_policies_has_its_usual_estimator() -> None:
    problem = dwell.load("examples/first.yaml")
    static = Static(candidates=problem.candidates, initial="SO", objective=problem.objective)
    first = LatencyFirst(candidates=problem.candidates)
    moving = DTP(candidates=problem.candidates, objective=problem.objective)
    found = [type(Controller(problem, one).estimator) for one in (static, first, moving)]
    assert [kind.__name__ for kind in found] == ["Profile", "Profile", "Corrected"]


def test_cells_of_a_fleet_that_stay_send_no_shadows() -> None:
    cell = dwell.load("examples/first.yaml")
    fleet = Fleet("two", (FleetEntry(cell, count=2),), ("E",))
    for policy, estimator in (("SO", "Profile"), ("dtp", "Corrected")):
        run = dwell.simulate_fleet(fleet, seed=1, windows=6, policy=policy)
        assert {one.meta["estimator"] for one in run.cells.values()} == {estimator}
        assert {one.problem.controller.min_dwell for one in run.cells.values()} == {
            3 if estimator == "Profile" else 0
        }
