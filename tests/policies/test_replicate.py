"""Replicate: a second copy of each cycle, while it saves more than it costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import PolicyError, ProblemError
from dwell.model import ControllerSettings, Decision, Problem, QoS, Replicas
from dwell.model.controller_settings import ReplicateSettings
from dwell.model.document import to_document
from dwell.model.evolve import evolve
from dwell.policies import DTP, Static, by_name, check_policy, parameters_of
from dwell.policies.replicate import Replicate
from tests.cells.paper import CANDIDATES, problem, qos

#: LOC and SO differ in two of four tasks: a move costs 0.5 * 0.5.
BOTH = {**CANDIDATES, "BOTH": Replicas({name: CANDIDATES[name] for name in ("LOC", "SO")})}
MOVE = 0.25
SETTINGS = ControllerSettings(min_dwell=2, min_improvement=0.05)
BAD = qos(l95_ms=110.0)


def policy(base: str = "dtp", **settings: Any) -> Replicate:
    given = replace(SETTINGS, replicate=ReplicateSettings(base), **settings)
    made = by_name("replicate", problem(BOTH, controller=given))
    assert isinstance(made, Replicate)
    return made


def estimates(loc: QoS, so: QoS, hyb: QoS, both: QoS) -> dict[str, QoS]:
    return {"LOC": loc, "SO": so, "HYB": hyb, "BOTH": both}


def decided(made: Replicate, known: Mapping[str, QoS], times: int = 1) -> Decision:
    """Return the last of some decisions on equal windows."""
    for _ in range(times):
        decision = made.decide(observed=known[made.incumbent], estimates=known)
    return decision


def in_force(**settings: Any) -> Replicate:
    """Return a policy that has put BOTH into force two decisions ago."""
    made = policy(initial="LOC", **settings)
    missed = qos(violation_rate=0.5)
    assert decided(made, estimates(missed, BAD, BAD, qos()), 3).name == "BOTH"
    decided(made, estimates(missed, BAD, BAD, qos()), 2)
    assert (made.incumbent, made.single) == ("BOTH", "LOC")
    return made


# ------------------------------------------------------------------- comes into force


@pytest.mark.parametrize(("more_ms", "name"), [(0.04, "LOC"), (0.06, "BOTH")])
def test_a_pair_comes_into_force_if_it_saves_its_move_and_delta_min(
    more_ms: float, name: str
) -> None:
    # L95 costs 1 per 40 ms.
    loc = qos(l95_ms=20 + 40 * (MOVE + 0.01 + more_ms))
    decision = decided(policy(), estimates(loc, BAD, BAD, qos(l95_ms=20.4)), 3)
    assert decision.name == name
    assert decision.delta_j == pytest.approx(more_ms)
    assert decision.costs["BOTH"] == pytest.approx(0.51 + MOVE)


def test_a_pair_must_save_the_error_of_the_estimates_too() -> None:
    loc, both = qos(l95_ms=40.0), replace(qos(), error=(8.0, 0.0))
    assert decided(policy(), estimates(loc, BAD, BAD, both), 3).name == "LOC"
    assert decided(policy(), estimates(loc, BAD, BAD, qos()), 3).name == "BOTH"


def test_the_base_decides_among_the_single_placements() -> None:
    # The base takes the cheapest of LOC, SO and HYB, which is in no pair.
    made = policy()
    known = estimates(qos(l95_ms=60), qos(l95_ms=60), qos(l95_ms=20), qos(l95_ms=10))
    decision = decided(made, known, 3)
    assert (decision.name, decision.reason, made.single) == ("HYB", "migrate", "HYB")
    assert decided(made, known, 5).name == "HYB"


def test_a_pair_is_priced_against_the_base_s_choice() -> None:
    # The base leaves LOC for SO, and BOTH is no cheaper than SO.
    made = policy()
    decision = decided(made, estimates(qos(l95_ms=80), qos(l95_ms=20), BAD, qos(l95_ms=20)), 3)
    assert decision.name == "SO"
    # From HYB the cell moves to BOTH at once: the base wants SO, and BOTH is cheaper.
    made = policy(initial="HYB")
    known = estimates(BAD, qos(l95_ms=60), replace(BAD, violation_rate=0.9), qos(l95_ms=20))
    assert decided(made, known, 3).name == "BOTH"
    assert made.single == "SO"


@pytest.mark.parametrize("base", ["LOC", "dtp", "cusum", "work-function", "atp", "latency-first"])
def test_any_policy_can_be_the_base(base: str) -> None:
    made = policy(base)
    known = estimates(qos(l95_ms=60), BAD, BAD, qos())
    assert decided(made, known, 3).name == "BOTH"
    assert check_policy(policy(base), problem(BOTH)) == ()


def test_a_users_class_can_be_the_base() -> None:
    class Fastest:
        def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
            assert "BOTH" not in estimates
            return min(estimates, key=lambda name: estimates[name].l95_ms)

    cell = problem(BOTH)
    made = Replicate(candidates=BOTH, objective=cell.objective, base=Fastest(), min_dwell=0)
    known = estimates(qos(l95_ms=60), qos(l95_ms=50), BAD, qos())
    assert decided(made, known).name == "BOTH"
    assert made.single == "SO"


# ---------------------------------------------------------------------------- leaves it


@pytest.mark.parametrize(("more", "name"), [(0.04, "BOTH"), (0.06, "LOC")])
def test_a_pair_leaves_if_that_saves_the_move_and_delta_min(more: float, name: str) -> None:
    made = in_force()
    known = estimates(qos(), BAD, BAD, qos(l95_ms=20 + 40 * (MOVE + more)))
    assert decided(made, known).name == name


def test_it_stops_where_both_copies_are_late() -> None:
    # J of BOTH is lower still: its L95 is the lesser of two.
    made = in_force()
    late = {name: qos(l95_ms=ms, violation_rate=1.0) for name, ms in (("LOC", 100), ("SO", 100))}
    known = estimates(late["LOC"], late["SO"], BAD, qos(l95_ms=60, violation_rate=1.0))
    known["HYB"] = replace(known["LOC"], l95_ms=120.0)
    assert decided(made, known).name == "LOC"
    assert {decided(made, known).name for _ in range(10)} == {"LOC"}


@pytest.mark.parametrize("least", [0, 1, 4])
def test_it_stops_within_n_min_and_two_windows(least: int) -> None:
    made = policy(min_dwell=least)
    decided(made, estimates(qos(violation_rate=0.5), BAD, BAD, qos()), least + 1)
    assert made.incumbent == "BOTH"
    late = qos(l95_ms=80, violation_rate=1.0)
    decided(made, estimates(late, late, late, late), least + 1)
    assert made.incumbent == "LOC"


def test_a_pair_over_a_cap_leaves() -> None:
    made = in_force()
    known = estimates(qos(violation_rate=0.5), BAD, BAD, qos(robot=0.99))
    assert decided(made, known).name == "LOC"


def test_a_pair_stays_over_a_move_of_the_base_between_its_members() -> None:
    made = in_force()
    known = estimates(qos(l95_ms=90), qos(l95_ms=50), BAD, qos())
    decision = decided(made, known)
    assert (decision.name, decision.reason, made.single) == ("BOTH", "hold", "SO")


def test_another_pair_of_the_placement_comes_into_force_if_it_is_cheaper() -> None:
    members = {name: CANDIDATES[name] for name in ("LOC", "SO")}
    candidates = {**BOTH, "LATER": Replicas(members, after_ms=10)}
    cell = problem(candidates, controller=replace(SETTINGS, min_dwell=0))
    made = by_name("replicate", cell)
    assert isinstance(made, Replicate)
    known = estimates(qos(violation_rate=0.5), BAD, BAD, qos()) | {"LATER": qos(l95_ms=21)}
    assert decided(made, known).name == "BOTH"
    assert decided(made, known | {"LATER": qos(l95_ms=18.1)}).name == "BOTH"
    assert decided(made, known | {"LATER": qos(l95_ms=17.9)}).name == "LATER"


def test_a_cell_without_replicas_has_the_base_s_decisions() -> None:
    windows = [
        {"LOC": qos(l95_ms=60), "SO": qos(l95_ms=20 + 40 * (window % 3)), "HYB": BAD}
        for window in range(9)
    ]
    names = []
    for name in ("replicate", "dtp"):
        made: Any = by_name(name, problem(controller=SETTINGS))
        names.append([decided(made, known).name for known in windows])
    assert names[0] == names[1]


# ------------------------------------------------------------------------- moves of others


def test_a_move_of_the_guard_leaves_the_pair() -> None:
    made = in_force()
    made.adopt("HYB")
    assert (made.incumbent, made.single) == ("HYB", "HYB")
    made.adopt("BOTH")
    assert (made.incumbent, made.single) == ("BOTH", "LOC")


def test_a_tentative_proposal_changes_nothing() -> None:
    made = policy(base="cusum")
    known = estimates(qos(l95_ms=60), qos(), BAD, BAD)
    proposed = [
        made.propose(observed=known["LOC"], estimates=known, tentative=True)[0] for _ in range(9)
    ]
    assert {one.name for one in proposed} == {proposed[0].name}


# ------------------------------------------------------------------------ the cell file


def hedge(**controller: Any) -> Problem:
    cell = dwell.load("examples/canonical.yaml")
    members = {name: cell.candidates[name] for name in ("LOC", "SO")}
    candidates = {**cell.candidates, "BOTH": Replicas(members)}
    return replace(cell, candidates=candidates, controller=replace(cell.controller, **controller))


def test_a_cell_file_names_the_base() -> None:
    cell = evolve(hedge(), {"controller.policy": "replicate", "controller.replicate.base": "SO"})
    made = by_name("replicate", cell)
    assert isinstance(made, Replicate)
    assert isinstance(made.base, Static)
    assert parameters_of(made)["base"] == {
        "policy": "Static",
        "initial": "SO",
        "objective": parameters_of(made)["objective"],
    }


def test_a_pair_may_be_the_initial_candidate() -> None:
    made = by_name("replicate", hedge(initial="BOTH"))
    assert isinstance(made, Replicate)
    assert isinstance(made.base, DTP)
    assert (made.incumbent, made.single, made.base.initial) == ("BOTH", "LOC", "LOC")


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ("replicate", "needs a base itself"),
        ("BOTH", "BOTH has replicas"),
        ("dpt", "unknown policy 'dpt'; did you mean 'dtp'"),
    ],
)
def test_bad_bases(base: str, message: str) -> None:
    document = to_document(hedge(replicate=ReplicateSettings(base)))
    with pytest.raises(ProblemError, match=rf"controller\.replicate\.base.*{message}"):
        from_document(document)
    with pytest.raises((PolicyError, ProblemError)):
        by_name("replicate", hedge(replicate=ReplicateSettings(base)))


# ---------------------------------------------------------------------------- simulated


def test_it_replicates_in_a_run_where_a_second_copy_pays() -> None:
    settings = {"controller.estimator": "corrected", "controller.replicate.base": "LOC"}
    cell = evolve(hedge(), settings)
    run = dwell.simulate(cell, scenario="robot-cpu-stress", policy="replicate", seed=1, windows=8)
    assert run.windows["placement"].to_list() == ["LOC"] * 4 + ["BOTH"] * 3
    assert run.meta["parameters"]["base"]["policy"] == "Static"


def test_with_a_high_price_of_the_robots_cpu_it_never_replicates() -> None:
    cell = evolve(hedge(), {"controller.estimator": "corrected"})
    weights = replace(cell.objective.weights, robot=5.0)
    cell = replace(cell, objective=replace(cell.objective, weights=weights))
    scenario = "network-impairment-mild"
    run = dwell.simulate(cell, scenario=scenario, policy="replicate", seed=1, windows=8)
    assert "BOTH" not in run.windows["placement"].to_list()
