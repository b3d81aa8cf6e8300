"""`simulate` as a user sees it: what determines a run, what its tables promise, when orders act."""

from __future__ import annotations

import copy
import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import PolicyError, ProblemError, SimulationError, user_note
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import (
    Decision,
    Problem,
    QoS,
)
from dwell.model.document import to_document
from dwell.policies import DTP
from dwell.policies.registry import REGISTRY as POLICIES
from dwell.sim import describe
from tests.cells import deterministic
from tests.cells.examples import CELLS
from tests.cells.two_nodes import TABLES, Script, assert_same

ROOT = Path(__file__).parents[2]


def digest(run: dwell.Run) -> str:
    """Return a hash of all tables; floats are written so that they read back the same."""
    text = "".join(getattr(run, name).write_csv() for name in TABLES)
    return hashlib.sha256(text.encode()).hexdigest()


# ------------------------------------------------------------------------------ determinism


@pytest.mark.parametrize("cell", CELLS)
def test_a_seed_determines_the_run(cells: Mapping[str, Problem], cell: str) -> None:
    one, again, other = (
        dwell.simulate(cells[cell], policy="dtp", seed=seed, windows=12) for seed in (5, 5, 6)
    )
    assert_same(one, again)
    assert not one.cycles.equals(other.cycles)


PROGRAM = """\
import sys
import dwell
from tests.sim.test_engine import digest
problem = dwell.load(sys.argv[1])
for policy in ("dtp", "SO", "latency-first"):
    run = dwell.simulate(
        problem, scenario="robot-cpu-stress", policy=policy, seed=11, windows=int(sys.argv[2])
    )
    print(digest(run))
"""


def digests_elsewhere(windows: int, **environment: str) -> list[str]:
    """Return the digests of three small runs that another process made."""
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(ROOT / "examples" / "canonical.yaml"), str(windows)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout.split()


def test_other_processes_make_the_same_run(canonical: Problem) -> None:
    here = [
        digest(
            dwell.simulate(
                canonical, scenario="robot-cpu-stress", policy=policy, seed=11, windows=8
            )
        )
        for policy in ("dtp", "SO", "latency-first")
    ]
    assert digests_elsewhere(8, PYTHONHASHSEED="1") == here
    assert digests_elsewhere(8, PYTHONHASHSEED="2") == here


# --------------------------------------------------------------------- common random numbers


def grown(problem: Problem) -> Problem:
    """Return the same cell with a node, a task, a flow and links more, all of them listed first."""
    document: dict[str, Any] = copy.deepcopy(dict(to_document(problem)))
    document["nodes"] = {"X": {"tier": "edge", "cores": 2}, **document["nodes"]}
    delay = {"lognormal": {"mean": 2.0, "cv": 0.5}}
    document["links"] = [
        {"from": "R1", "to": "X", "both_ways": True, "delay_ms": delay},
        *document["links"],
    ]
    document["tasks"] = {
        "logging": {"on": {"X": {"exec_ms": {"gamma": {"mean": 2.0, "cv": 1.0}}}}},
        **document["tasks"],
    }
    document["flows"] = [{"from": "sensing", "to": "logging", "bytes": 10}, *document["flows"]]
    document["objective"].pop("tiers", None)
    return from_document(document)


def test_what_is_added_does_not_change_the_draws_of_others(canonical: Problem) -> None:
    more = grown(canonical)
    for scenario in canonical.scenarios:
        one, other = (
            dwell.draw(problem, scenario=scenario, seed=2, windows=5)
            for problem in (canonical, more)
        )
        assert (one.release_ns == other.release_ns).all()
        for i, site in enumerate(one.sites):
            assert (one.exec_ns[i] == other.exec_ns[other.sites.index(site)]).all(), site
        for i, hop in enumerate(one.hops):
            j = other.hops.index(hop)
            assert (one.delay_ns[i] == other.delay_ns[j]).all(), hop
            assert one.loss_keys[i] == other.loss_keys[j], hop
        for i, (hop_index, layer) in enumerate(one.layers):
            j = other.layers.index((other.hops.index(one.hops[hop_index]), layer))
            assert (one.extra_ns[i] == other.extra_ns[j]).all()
        assert list(one.node_changes) == [c for c in other.node_changes if c.node != "X"]
        mine = [s for s in other.link_segments if "X" not in s.link]
        assert list(one.link_segments) == mine


def test_a_node_that_nobody_uses_changes_nothing(canonical: Problem) -> None:
    document: dict[str, Any] = copy.deepcopy(dict(to_document(canonical)))
    document["nodes"] = {"X": {"tier": "edge", "cores": 2}, **document["nodes"]}
    document["objective"].pop("tiers", None)
    more = from_document(document)
    for policy in ("dtp", "SO"):
        one, other = (
            dwell.simulate(problem, policy=policy, seed=4, windows=20)
            for problem in (canonical, more)
        )
        assert one.cycles.equals(other.cycles)
        assert one.windows.equals(other.windows.drop("u_X"))
        assert one.decisions.equals(other.decisions.drop(pl.selectors.starts_with("est_u_X")))


def test_policies_meet_the_same_realisation(canonical: Problem) -> None:
    real = dwell.draw(canonical, scenario="robot-cpu-stress", seed=1, windows=10)
    before = copy.deepcopy(real)
    runs = [
        dwell.simulate_realisation(canonical, real, policy=policy)
        for policy in ("dtp", "LOC", "dtp")
    ]
    assert_same(runs[0], runs[2])
    for name in ("release_ns", "exec_ns", "delay_ns", "loss_keys", "extra_ns"):
        assert (getattr(real, name) == getattr(before, name)).all()
    drawn = dwell.simulate(canonical, scenario="robot-cpu-stress", seed=1, windows=10, policy="LOC")
    assert_same(runs[1], drawn)


# ------------------------------------------------------------------------ two ways to play


@pytest.mark.parametrize("cell", CELLS)
def test_window_by_window_is_bit_for_bit_the_static_run(
    cells: Mapping[str, Problem], cell: str
) -> None:
    problem = cells[cell]
    for scenario in problem.scenarios:
        real = dwell.draw(problem, scenario=scenario, seed=9, windows=12)
        for policy in problem.candidates:
            fast, slow = (
                dwell.simulate_realisation(
                    problem, real, policy=policy, by_window=by_window, jobs=True
                )
                for by_window in (False, True)
            )
            assert fast.jobs.equals(slow.jobs)
            assert_same(fast, slow)


def test_stress_on_the_edge_is_no_reason_to_leave_it(canonical: Problem) -> None:
    """E is full under every placement, so that LOC is not the only one within the caps."""
    for seed in (1, 2):
        run = dwell.simulate(
            canonical, scenario="edge-cpu-stress", policy="dtp", seed=seed, windows=30
        )
        after = run.decisions.filter(run.decisions["incumbent"] != "LOC")
        assert not after.is_empty()
        assert (after["placement"] != "LOC").all()


# -------------------------------------------------------------------------------- migrations


@pytest.mark.parametrize(
    ("delay_ms", "lead", "first"), [(0, 0, 50), (0, 2, 52), (80, 0, 52), (100, 2, 53)]
)
def test_an_order_takes_effect_after_its_delay_and_its_lead(
    delay_ms: float, lead: int, first: int
) -> None:
    problem = deterministic.cell(estimator="profile")
    orders = replace(problem.controller, order_delay_ms=delay_ms, order_lead_cycles=lead)
    problem = replace(problem, controller=orders)
    run = dwell.simulate(problem, policy=Script("OFF"), seed=1, windows=4)
    # Cycles are 40 ms apart; window 0 closes at the release of cycle 50.
    assert (run.cycles["placement"] == "LOC").to_list() == [
        cycle < first for cycle in range(run.cycles.height)
    ]
    assert run.windows["first_cycle"].to_list()[:3] == [0, first, first + 50]
    assert not run.windows["mixed"].any()
    # A window's work is counted from its first cycle on.
    used = run.windows["u_R"].to_list()
    assert used[1] == pytest.approx(used[2])


@pytest.mark.parametrize("min_dwell", [0, 1, 3, 10])
def test_migrations_stay_within_their_bound(cells: Mapping[str, Problem], min_dwell: int) -> None:
    for problem in cells.values():
        eager = DTP(
            candidates=problem.candidates,
            initial=problem.initial,
            objective=problem.objective,
            min_dwell=min_dwell,
            min_improvement=0.0,
        )
        for scenario in problem.scenarios:
            run = dwell.simulate(problem, scenario=scenario, policy=eager, seed=1, windows=40)
            moves = run.decisions.filter(pl.col("migrated"))["window"]
            assert moves.len() <= run.decisions.height // (min_dwell + 1)
            assert (moves.diff().drop_nulls() >= min_dwell + 1).all()


# ----------------------------------------------------------------------------------- policies


def test_the_callers_policy_is_not_changed(canonical: Problem) -> None:
    script = Script("SO", "HYB", "LOC")
    dtp = DTP(
        candidates=canonical.candidates,
        initial="LOC",
        objective=canonical.objective,
        min_dwell=1,
        min_improvement=0.0,
    )
    for policy in (script, dtp):
        before = pickle.dumps(policy)
        first, second = (
            dwell.simulate(canonical, policy=policy, seed=1, windows=10) for _ in range(2)
        )
        assert_same(first, second)
        assert pickle.dumps(policy) == before


@pytest.mark.parametrize("guard", [False, True])
@pytest.mark.parametrize("estimator", list(ESTIMATORS))
def test_a_run_is_described_before_it_is_played(
    canonical: Problem, estimator: str, guard: bool
) -> None:
    for policy in (*POLICIES, "SO"):
        asked: dict[str, Any] = {
            "scenario": "edge-cpu-stress",
            "policy": policy,
            "estimator": estimator,
            "seed": 3,
            "windows": 6,
            "guard": guard,
        }
        assert describe(canonical, **asked) == dwell.simulate(canonical, **asked).meta
    with pytest.raises(ProblemError, match="did you mean 'edge-cpu-stress'"):
        describe(canonical, scenario="edge-cpu-stres", seed=1)


def test_names_are_decisions(canonical: Problem) -> None:
    run = dwell.simulate(canonical, policy=Script("LOC", "SO", "SO", "HYB"), seed=1, windows=8)
    decided = run.decisions.select(pl.col("placement", "reason").cast(str), "migrated", "dwell")
    assert decided.rows()[:5] == [
        ("LOC", "hold", False, 1),
        ("SO", "migrate", True, 0),
        ("SO", "hold", False, 1),
        ("HYB", "migrate", True, 0),
        ("HYB", "hold", False, 1),
    ]
    assert run.decisions["j_SO"].is_null().all()


class Always:
    """A policy that gives the same answer whatever it sees."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Any:
        """Give the answer."""
        return self.answer


def test_what_is_no_decision_is_refused(canonical: Problem) -> None:
    placement = canonical.candidates["SO"]
    contradiction = Decision(placement=placement, name="LOC", migrated=False, reason="hold")
    silent = Decision(placement=placement, name="SO", migrated=False, reason="hold")
    for answer in ("nowhere", None, 3, float("nan"), contradiction, silent):
        with pytest.raises(PolicyError, match=r"Always\.decide"):
            dwell.simulate(canonical, policy=Always(answer), seed=1, windows=3)
    fine = Decision(placement=placement, name="SO", migrated=True, reason="migrate")
    with pytest.raises(PolicyError, match="window 1"):  # it has migrated already
        dwell.simulate(canonical, policy=Always(fine), seed=1, windows=3)


class Failing:
    """A policy that fails at its third close."""

    closes = 0

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Stay where it is, twice."""
        self.closes += 1
        return ("LOC", "LOC")[self.closes - 1]


def test_what_a_policy_raises_in_a_close_is_what_its_author_sees(canonical: Problem) -> None:
    realisation = dwell.draw(canonical, scenario="baseline", seed=1, windows=4)
    before = dwell.simulate_realisation(canonical, realisation, policy="dtp")
    with pytest.raises(IndexError, match="tuple index out of range") as caught:
        dwell.simulate_realisation(canonical, realisation, policy=Failing())
    told = "Failing: decide at window 2 failed: IndexError: tuple index out of range (test_engine"
    assert str(user_note(caught.value)).startswith(told)
    # The realisation is as it was.
    after = dwell.simulate_realisation(canonical, realisation, policy="dtp")
    assert after.cycles.equals(before.cycles)


def test_two_threads_may_play_one_realisation(canonical: Problem) -> None:
    realisation = dwell.draw(canonical, scenario="baseline", seed=1, windows=20)
    policies = ["dtp", "cusum", "dtp", "LOC"]

    def play(policy: str) -> pl.DataFrame:
        return dwell.simulate_realisation(canonical, realisation, policy=policy).cycles

    alone = [play(policy) for policy in policies]
    with ThreadPoolExecutor(2) as threads:
        together = list(threads.map(play, policies))
    assert all(one.equals(other) for one, other in zip(alone, together, strict=True))


def test_what_is_unknown_is_refused(canonical: Problem) -> None:
    with pytest.raises(ProblemError, match="did you mean 'network-impairment'"):
        dwell.simulate(canonical, scenario="network-impairmant", seed=1, windows=1)
    with pytest.raises(PolicyError, match="did you mean 'dtp'"):
        dwell.simulate(canonical, policy="dpt", seed=1, windows=1)
    with pytest.raises(ProblemError, match="unknown estimator"):
        dwell.simulate(canonical, estimator="oracle", seed=1, windows=1)
    with pytest.raises(PolicyError, match="is no policy"):
        dwell.simulate(canonical, policy=object(), seed=1, windows=1)  # type: ignore[arg-type]
    for number in (0, -1):
        with pytest.raises(SimulationError, match="windows"):
            dwell.simulate(canonical, seed=1, windows=number)
    with pytest.raises(SimulationError, match="seed"):
        dwell.simulate(canonical, seed=-1, windows=1)


def test_a_realisation_of_another_problem_is_refused(cells: Mapping[str, Problem]) -> None:
    real = dwell.draw(cells["canonical"], seed=1, windows=2, scenario="baseline")
    with pytest.raises(SimulationError, match="draw it from the same problem"):
        dwell.simulate_realisation(cells["fan-in"], real)
    wider = replace(cells["canonical"], window_cycles=200)
    with pytest.raises(SimulationError, match="need"):
        dwell.simulate_realisation(wider, real)
