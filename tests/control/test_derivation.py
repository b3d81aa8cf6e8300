"""Decisions derived again from the tables of a run and the parameters in its record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

import dwell
from dwell.estimators import Evidence, Profile
from dwell.model import Caps, NodeDisturbance, Problem, QoS
from dwell.policies import DTP, Cusum, WorkFunction
from tests.reference.derivation import RULES, Record, require_derived

#: Caps by which candidates are left out, one by one or all together.
CAPS = {
    "own": None,
    "none": Caps(),
    "utilisation": Caps(utilisation=0.16),
    "latency": Caps(latency_ms=31.0),
    "all": Caps(latency_ms=1.0, utilisation=0.01),
}


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load("examples/canonical.yaml")


# ---------------------------------------------------------------------------------- the tests


def capped(problem: Problem, caps: str) -> Problem:
    given = CAPS[caps]
    if given is None:
        return problem
    return replace(problem, objective=replace(problem.objective, caps=given))


def deciding_often(problem: Problem, rng: Random) -> Problem:
    """Draw how often it decides, how long a placement has to stay, and the deadline."""
    width = problem.window_cycles
    controller = replace(
        problem.controller,
        decide_cycles=rng.choice([1, 7, width // 4, width - 1, rng.randint(1, width)]),
        min_dwell=rng.choice([0, 0, 1, 3]),
        min_dwell_cycles=rng.choice([0, rng.randint(0, 3 * width)]),
    )
    deadline_ms = problem.pipeline.period_ms * rng.choice([1.0, 3.5, 8.0])
    pipeline = replace(problem.pipeline, deadline_ms=deadline_ms)
    return replace(problem, controller=controller, pipeline=pipeline)


#: Each policy with each kind of caps meets two of them: one per way of deciding.
CONDITIONS = (
    ("robot-cpu-stress", "profile"),
    ("edge-cpu-stress", "corrected"),
    ("edge-cpu-stress", "profile"),
    ("network-impairment-mild", "scaling"),
)


@pytest.mark.parametrize("policy", RULES)
@pytest.mark.parametrize("caps", CAPS)
@pytest.mark.parametrize("often", [False, True], ids=["windows", "between"])
def test_every_decision_follows_from_its_row(
    canonical: Problem, policy: str, caps: str, often: bool, tmp_path: Path
) -> None:
    problem = capped(canonical, caps)
    seed = ([*RULES].index(policy) + [*CAPS].index(caps) + often) % len(CONDITIONS)
    scenario, estimator = CONDITIONS[seed]
    if often:
        problem = deciding_often(problem, Random(f"{policy}, {caps}, {seed}"))
    run = dwell.simulate(
        problem, scenario=scenario, policy=policy, estimator=estimator, seed=seed, windows=25
    )
    run.save(tmp_path / "run")
    require_derived(tmp_path / "run", policy)


class Doubting:
    """Learns nothing and says so: the profile, by turns too low and too high, with its errors.

    The incumbent's estimate is one as the others', and not what was observed.
    """

    def __init__(self, share: float) -> None:
        self.share = share

    def start(self, problem: Problem) -> None:
        self.profile, self.window = Profile(problem), 0

    def learn(self, evidence: Evidence) -> None:
        self.window += 1

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        known = self.profile.estimate(observed=observed, incumbent=incumbent, own=own)
        return {
            name: replace(
                qos,
                l95_ms=qos.l95_ms * (1 + 0.3 * math.sin(self.window / 2 + 2 * i)),
                cut_from_ms=None,
                error=(self.share * qos.l95_ms * (1 + i), self.share * i / 10),
            )
            for i, (name, qos) in enumerate(known.items())
        }


@pytest.mark.parametrize(("policy", "escape"), [*((p, False) for p in RULES), ("dtp", True)])
@pytest.mark.parametrize("caps", ["own", "latency"])
@pytest.mark.parametrize("every", [17, 25, 100])
def test_a_learners_decision_follows_from_its_row_with_its_errors(
    canonical: Problem, policy: str, caps: str, escape: bool, every: int, tmp_path: Path
) -> None:
    problem = capped(canonical, caps)
    controller = replace(
        problem.controller, decide_cycles=every, escape=escape, min_dwell=1, min_improvement=0.02
    )
    problem = replace(problem, controller=controller)
    moves = {}
    for share in (0.0, 0.2):
        folder = tmp_path / str(share)
        run = dwell.simulate(
            problem,
            scenario="robot-cpu-stress",
            policy=policy,
            estimator=Doubting(share),
            seed=2,
            windows=40,
        )
        run.save(folder)
        require_derived(folder, policy)
        moves[share] = run.decisions["migrated"].sum()
    if policy in ("dtp", "cusum", "work-function", "latency-first") and caps == "own":
        assert moves[0.2] < moves[0.0]


@pytest.mark.parametrize("policy", ["dtp", "cusum", "work-function"])
@pytest.mark.parametrize("taken", [False, True])
@pytest.mark.parametrize("estimator", ["profile", "corrected"])
def test_every_decision_follows_from_its_row_where_there_are_accelerators(
    policy: str, taken: bool, estimator: str, tmp_path: Path
) -> None:
    problem = dwell.load("examples/fan-in.yaml")
    objective = replace(
        problem.objective,
        # Parts of the placements have more on the gpu than that.
        caps=Caps(utilisation=0.12),
        accelerators={"E.gpu": "edge"} if taken else {},
    )
    problem = replace(problem, objective=objective)
    run = dwell.simulate(
        problem,
        scenario="overview-robot-stress",
        policy=policy,
        estimator=estimator,
        seed=1,
        windows=25,
    )
    run.save(tmp_path / "run")
    require_derived(tmp_path / "run", policy)


def test_caps_that_leave_out_a_cheaper_candidate_are_the_reason(canonical: Problem) -> None:
    reasons = {
        caps: set(
            dwell.simulate(
                capped(canonical, caps),
                scenario="robot-cpu-stress",
                policy="cusum",
                seed=1,
                windows=25,
            )
            .decisions["reason"]
            .cast(str)
        )
        for caps in ("none", "utilisation", "latency", "all")
    }
    assert reasons["none"] == {"hold", "migrate"}
    assert "infeasible" in reasons["all"]
    assert "capped" not in reasons["none"] | reasons["all"]


def test_a_dearer_candidate_within_the_caps_is_capped(canonical: Problem) -> None:
    """SO is the cheapest but over the cap on L95, HYB within it."""
    objective = replace(canonical.objective, caps=Caps(latency_ms=50.0))
    quiet = {"R1": 0.2, "E": 0.1, "R2": 0.1}
    estimates = {
        "LOC": QoS(45.0, 1.0, quiet),
        "SO": QoS(51.0, 0.0, {**quiet, "E": 0.0}),
        "HYB": QoS(49.0, 0.2, quiet),
    }
    for policy in (
        DTP(candidates=canonical.candidates, objective=objective, min_dwell=0),
        Cusum(candidates=canonical.candidates, objective=objective, threshold=0.0),
        WorkFunction(candidates=canonical.candidates, objective=objective),
    ):
        decision = policy.decide(observed=estimates["LOC"], estimates=estimates)
        assert (decision.name, decision.reason) == ("HYB", "capped")


@pytest.mark.parametrize("escape", [False, True])
def test_parameters_of_an_object_are_its_own(
    canonical: Problem, escape: bool, tmp_path: Path
) -> None:
    """And not those of the cell file."""
    policy = DTP(
        candidates=canonical.candidates,
        initial="SO",
        objective=replace(canonical.objective, caps=Caps(latency_ms=33.0)),
        min_dwell=1,
        min_improvement=0.123456789,
        escape=escape,
    )
    run = dwell.simulate(
        canonical, scenario="network-impairment-mild", policy=policy, seed=3, windows=30
    )
    run.save(tmp_path / "run")
    record = Record(tmp_path / "run")
    told = {"initial": "SO", "min_dwell": 1, "min_improvement": 0.123456789, "escape": escape}
    assert told.items() <= record.parameters.items()
    assert record.objective["caps"] == {"latency_ms": 33.0}
    reasons = {row["reason"] for row in require_derived(tmp_path / "run", "dtp")}
    assert {"dwell", "hold"} & reasons or escape


def test_what_a_policy_of_a_users_keeps_is_recorded(canonical: Problem) -> None:
    class Mine:
        def __init__(self, least: float, name: str = "SO", more: object = None) -> None:
            self.least, self.name, self.more = math.inf, name, [1]

        def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
            """Go where it was told."""
            return self.name

    run = dwell.simulate(canonical, policy=Mine(1.0), seed=1, windows=6)
    assert run.meta["parameters"] == {"least": "inf", "name": "SO"}
    decisions = run.decisions
    assert decisions["eligible_LOC"].all()
    assert decisions["excess_LOC"].null_count() == 0
    assert decisions["est_u_E_SO"].null_count() == 0
    assert decisions["reason"][0] == "migrate"


def test_a_guards_move_has_nothing_priced_and_what_it_holds_back_has(
    canonical: Problem, tmp_path: Path
) -> None:
    down = (NodeDisturbance("E", at_s=20.0, for_s=12.0, down=True),)
    controller = replace(canonical.controller, on="R2", initial="SO", min_dwell=0)
    problem = replace(canonical, scenarios={"down": down}, controller=controller)
    run = dwell.simulate(problem, scenario="down", policy="dtp", seed=1, windows=25, guard=True)
    run.save(tmp_path / "run")
    rows = Record(tmp_path / "run").rows
    guards = [row for row in rows if row["reason"] == "guard"]
    moved = [row for row in guards if row["migrated"]]
    held = [row for row in guards if not row["migrated"]]
    assert moved
    assert held
    for column in ("j_SO", "est_l95_ms_SO", "est_u_E_SO", "eligible_SO", "excess_SO"):
        assert all(row[column] is None for row in moved)
        assert all(row[column] is not None for row in rows if row not in moved)
