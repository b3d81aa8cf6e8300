"""`simulate` as a user sees it: what determines a run, what its tables promise, when orders act."""

from __future__ import annotations

import copy
import hashlib
import math
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import PolicyError, ProblemError, RunError, SimulationError
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import (
    Constant,
    ControllerSettings,
    Decision,
    Execution,
    Flow,
    Link,
    Node,
    NodeDisturbance,
    Problem,
    QoS,
    Quota,
    Task,
    Uniform,
)
from dwell.model.document import to_document
from dwell.policies import DTP
from dwell.policies.registry import REGISTRY as POLICIES
from dwell.record import Run
from dwell.sim import Phase, describe
from tests.cells.generated import MS, make_problem

ROOT = Path(__file__).parents[2]
CELLS = ("canonical", "fan-in", "cloud")
TABLES = ("cycles", "windows", "decisions")


@pytest.fixture(scope="module")
def cells() -> dict[str, Problem]:
    """Return the example cells."""
    return {name: dwell.load(ROOT / "examples" / f"{name}.yaml") for name in CELLS}


@pytest.fixture(scope="module")
def canonical(cells: Mapping[str, Problem]) -> Problem:
    """Return the canonical cell."""
    return cells["canonical"]


class Script:
    """A policy that says its names one after another and then the last one for ever."""

    def __init__(self, *names: str) -> None:
        self.names = names
        self.at = 0
        self.seen: list[QoS] = []

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Decision | str:
        """Say the next name."""
        self.seen.append(observed)
        name = self.names[min(self.at, len(self.names) - 1)]
        self.at += 1
        return name


def assert_same(one: dwell.Run, other: dwell.Run) -> None:
    """Assert that all tables are equal bit for bit, and of one schema."""
    for name in TABLES:
        a, b = getattr(one, name), getattr(other, name)
        assert a.schema == b.schema
        assert a.equals(b), name


def digest(run: dwell.Run) -> str:
    """Return a hash of all tables; floats are written so that they read back the same."""
    text = "".join(getattr(run, name).write_csv() for name in TABLES)
    return hashlib.sha256(text.encode()).hexdigest()


def two_nodes(
    *,
    exec_ms: float = 5.0,
    window_cycles: int = 10,
    workers: int = 1,
    scenario: Sequence[NodeDisturbance] = (),
    **settings: Any,
) -> Problem:
    """Return one task that may run on R or on E, where the controller sits; P = D = 20 ms."""
    execution = Execution(Constant(exec_ms), workers=workers)
    return make_problem(
        [Node("R", "robot", 4), Node("E", "edge", 4)],
        [Task("work", {"R": execution, "E": execution})],
        candidates={"LOC": {"work": "R"}, "OFF": {"work": "E"}},
        period_ms=20.0,
        window_cycles=window_cycles,
        scenario=scenario,
        controller=ControllerSettings(**settings),
    )


def first_cycles(run: dwell.Run, placement: str) -> list[int]:
    """Return where runs of cycles with a placement begin."""
    names = run.cycles["placement"].cast(str).to_list()
    return [
        i
        for i, name in enumerate(names)
        if name == placement and (i == 0 or names[i - 1] != placement)
    ]


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


def test_compiled_and_interpreted_kernels_make_the_same_run() -> None:
    assert digests_elsewhere(3, NUMBA_DISABLE_JIT="1") == digests_elsewhere(3)


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


# --------------------------------------------------------------------------- what tables say


def runs_of(cells: Mapping[str, Problem]) -> list[tuple[Problem, dwell.Run]]:
    """Return a run of every cell and scenario under two policies."""
    return [
        (problem, dwell.simulate(problem, scenario=scenario, policy=policy, seed=3, windows=15))
        for problem in cells.values()
        for scenario in problem.scenarios
        for policy in ("dtp", "latency-first")
    ]


def test_every_cycle_is_done_lost_or_in_flight(cells: Mapping[str, Problem]) -> None:
    for problem, run in runs_of(cells):
        cycles = run.cycles
        # Orders take time: the cycles of a last window that is not complete are never released.
        count = run.windows["first_cycle"][-1] + problem.window_cycles
        assert 14 * problem.window_cycles <= count <= 15 * problem.window_cycles
        assert cycles["cycle"].to_list() == list(range(count))
        assert (cycles["release_ns"].diff().drop_nulls() > 0).all()
        done = cycles["outcome"] == "done"
        assert (cycles["latency_ns"].is_not_null() == done).all()
        assert cycles.filter(~done)["missed"].all()
        deadline_ns = round(problem.pipeline.deadline_ms * MS)
        assert cycles.filter(pl.col("latency_ns") > deadline_ns)["missed"].all()
        # Nothing hangs: what is in flight was released near the end.
        flying = cycles.filter(pl.col("outcome") == "in_flight")["cycle"]
        assert (flying >= count - 2 * problem.window_cycles).all()


def test_latency_is_compute_queue_and_network(cells: Mapping[str, Problem]) -> None:
    for _, run in runs_of(cells):
        parts = run.cycles.select("compute_ns", "queue_ns", "network_ns")
        done = run.cycles.filter(pl.col("outcome") == "done")
        assert (
            done["compute_ns"] + done["queue_ns"] + done["network_ns"] == done["latency_ns"]
        ).all()
        assert (parts.min_horizontal().drop_nulls() >= 0).all()
        lost = run.cycles.filter(pl.col("outcome") != "done")
        nulls = lost.select("latency_ns", "compute_ns", "queue_ns", "network_ns").null_count()
        assert set(nulls.row(0)) == {lost.height}


def test_windows_say_what_their_cycles_say(cells: Mapping[str, Problem]) -> None:
    for problem, run in runs_of(cells):
        width = problem.window_cycles
        for row in run.windows.iter_rows(named=True):
            mine = run.cycles[row["first_cycle"] : row["first_cycle"] + width]
            assert mine.height == width
            assert row["placement"] == mine["placement"][0]
            assert row["mixed"] == (mine["placement"].n_unique() > 1)
            assert row["violation_rate"] == mine["missed"].mean()
            latencies = sorted(
                math.inf if value is None else value / MS for value in mine["latency_ns"].to_list()
            )
            assert row["l95_ms"] == latencies[math.ceil(0.95 * width) - 1]
            assert row["warmup"] == (row["window"] < problem.warmup_windows)
            for node in problem.fabric.nodes:
                assert 0 <= row[f"u_{node}"] <= 1


def test_windows_follow_one_another(cells: Mapping[str, Problem]) -> None:
    for problem, run in runs_of(cells):
        moved = run.decisions.filter(pl.col("migrated"))["window"].to_list()
        gaps = run.windows["first_cycle"].diff().to_list()[1:]
        for window, gap in enumerate(gaps):
            if window in moved:
                assert gap >= problem.window_cycles
            else:
                assert gap == problem.window_cycles


def test_decisions_say_what_was_stamped(cells: Mapping[str, Problem]) -> None:
    for _, run in runs_of(cells):
        placed = dict(run.windows.select("window", pl.col("placement").cast(str)).rows())
        for row in run.decisions.iter_rows(named=True):
            assert row["incumbent"] == placed[row["window"]]
            assert row["migrated"] == (row["placement"] != row["incumbent"])
            if row["window"] + 1 in placed:
                assert placed[row["window"] + 1] == row["placement"]


def test_costs_are_finite_whatever_is_lost(cells: Mapping[str, Problem]) -> None:
    for _, run in runs_of(cells):
        assert run.windows["cost"].drop_nulls().is_finite().all()
        assert run.windows["seen_l95_ms"].drop_nulls().is_finite().all()


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
    for answer in ("nowhere", None, 3, contradiction, silent):
        with pytest.raises(PolicyError, match=r"Always\.decide"):
            dwell.simulate(canonical, policy=Always(answer), seed=1, windows=3)
    fine = Decision(placement=placement, name="SO", migrated=True, reason="migrate")
    with pytest.raises(PolicyError, match="window 1"):  # it has migrated already
        dwell.simulate(canonical, policy=Always(fine), seed=1, windows=3)


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
    wider = replace(cells["canonical"], window_cycles=50)
    with pytest.raises(SimulationError, match="need"):
        dwell.simulate_realisation(wider, real)


# ----------------------------------------------------------------------- when an order acts


@pytest.mark.parametrize(
    ("settings", "cycle"),
    [
        ({}, 10),
        ({"order_delay_ms": 0.5}, 11),
        ({"order_delay_ms": 20.0}, 11),
        ({"order_delay_ms": 20.5}, 12),
        ({"order_delay_ms": 250.0}, 23),
        ({"order_lead_cycles": 1}, 11),
        ({"order_lead_cycles": 7}, 17),
        ({"order_lead_cycles": 1, "order_delay_ms": 45.0}, 13),
        ({"order_lead_cycles": 5, "order_delay_ms": 45.0}, 15),
        ({"close_grace_ms": 5.0}, 11),
        ({"close_grace_ms": 20.0}, 11),
        ({"close_grace_ms": 21.0}, 12),
        ({"close_grace_ms": 5.0, "order_delay_ms": 20.0}, 12),
        ({"close_grace_ms": 5.0, "order_lead_cycles": 3}, 13),
    ],
)
def test_the_first_cycle_that_an_order_stamps(settings: Mapping[str, Any], cycle: int) -> None:
    problem = two_nodes(**settings)
    run = dwell.simulate(problem, policy=Script("OFF"), seed=1, windows=6)
    assert first_cycles(run, "OFF") == [cycle]
    windows = run.windows.select("first_cycle", pl.col("placement").cast(str), "mixed").rows()
    assert windows[0] == (0, "LOC", False)
    assert windows[1] == (cycle, "OFF", False)
    assert windows[2] == (cycle + 10, "OFF", False)


def test_orders_one_after_another() -> None:
    problem = two_nodes(order_delay_ms=30.0)
    run = dwell.simulate(problem, policy=Script("OFF", "LOC", "OFF"), seed=1, windows=6)
    assert first_cycles(run, "OFF") == [12, 36]
    assert first_cycles(run, "LOC") == [0, 24]
    assert run.windows["first_cycle"].to_list()[:5] == [0, 12, 24, 36, 46]


@pytest.mark.parametrize(
    ("grace_ms", "seen_ms", "seen_rate"), [(0.0, 20.0, 1.0), (4.0, 24.0, 1.0), (10.0, 25.0, 1.0)]
)
def test_what_is_unfinished_at_the_close_counts_with_its_age(
    grace_ms: float, seen_ms: float, seen_rate: float
) -> None:
    problem = two_nodes(exec_ms=25.0, window_cycles=1, workers=2, close_grace_ms=grace_ms)
    run = dwell.simulate(problem, policy=Script("LOC"), seed=1, windows=8)
    assert set(run.windows["seen_l95_ms"][:6].to_list()) == {seen_ms}
    assert set(run.windows["seen_violation_rate"][:6].to_list()) == {seen_rate}
    assert set(run.windows["l95_ms"][:6].to_list()) == {25.0}


def test_the_controller_decides_nothing_while_its_node_is_down() -> None:
    # Windows close every 0.2 s; E is down at the closes of windows 2 (0.6 s) and 3 (0.8 s).
    outage = NodeDisturbance(node="E", at_s=0.5, for_s=0.4, down=True)
    problem = two_nodes(scenario=[outage], on="E")
    for policy in ("LOC", Script("LOC"), "dtp"):
        run = dwell.simulate(problem, scenario="disturbed", policy=policy, seed=1, windows=8)
        blind = run.windows.filter(pl.col("cost").is_null())
        assert run.decisions["window"].to_list() == [0, 1, 4, 5, 6, 7]
        assert blind["window"].to_list() == [2, 3]
        assert blind.select("seen_l95_ms", "seen_violation_rate").null_count().row(0) == (2, 2)
        assert run.windows["l95_ms"].to_list() == [5.0] * 8
        assert run.windows["u_E"].to_list() == [0.0] * 8
    elsewhere = replace(problem, controller=replace(problem.controller, on="R"))
    run = dwell.simulate(elsewhere, scenario="disturbed", policy=Script("LOC"), seed=1, windows=8)
    assert run.decisions.height == 8


def test_cycles_on_a_dead_node_are_lost_and_say_so() -> None:
    outage = NodeDisturbance(node="E", at_s=0.5, for_s=0.4, down=True)
    problem = two_nodes(scenario=[outage], on="R")
    run = dwell.simulate(problem, scenario="disturbed", policy="OFF", seed=1, windows=8)
    outcomes = run.cycles["outcome"].cast(str).to_list()
    assert outcomes == ["done"] * 25 + ["node_down"] * 20 + ["done"] * 35
    assert run.windows["violation_rate"].to_list() == [0, 0, 0.5, 1, 0.5, 0, 0, 0]
    assert run.windows["l95_ms"].to_list()[2:5] == [math.inf] * 3


# -------------------------------------------------------------------------- jitter and quota


def test_jitter_moves_releases_and_the_closes_with_them() -> None:
    problem = replace(
        two_nodes(),
        pipeline=replace(two_nodes().pipeline, release_jitter_ms=Uniform(0.0, 6.0)),
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=20)
    late_ms = run.cycles["release_ns"].to_numpy() / MS - np.arange(200) * 20.0
    assert late_ms.min() >= 0
    assert late_ms.max() <= 6
    assert late_ms.std() > 1
    assert set(run.cycles["latency_ns"].to_list()) == {5 * MS}
    by_window = dwell.simulate_realisation(
        problem,
        dwell.draw(problem, scenario="baseline", seed=1, windows=20),
        policy="LOC",
        by_window=True,
    )
    assert_same(run, by_window)


def test_jitter_beyond_the_period_keeps_the_order_of_cycles() -> None:
    problem = replace(
        two_nodes(workers=4),
        pipeline=replace(two_nodes(workers=4).pipeline, release_jitter_ms=Uniform(0.0, 70.0)),
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=20)
    assert (run.cycles["release_ns"].diff().drop_nulls() >= 0).all()
    assert (run.cycles["outcome"] == "done").sum() >= 198


@pytest.mark.parametrize(("exec_ms", "latency_ms"), [(3.0, 3.0), (5.0, 5.0), (8.0, 13.0)])
def test_a_quota_stops_a_job_whose_bucket_is_empty(exec_ms: float, latency_ms: float) -> None:
    # 5 ms of one core in every 10 ms; releases fall on the begins of periods.
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(0.5, 10.0))],
        [Task("work", {"R": Execution(Constant(exec_ms))})],
        period_ms=20.0,
        window_cycles=10,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    assert set(run.cycles["latency_ns"].to_list()) == {round(latency_ms * MS)}


def test_a_core_keeps_some_of_what_it_has_drawn() -> None:
    # As above, but 1 ms outlasts the period: from the second job on 6 ms are there at its begin.
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(0.5, 10.0, slack_ms=1.0))],
        [Task("work", {"R": Execution(Constant(8.0))})],
        period_ms=20.0,
        window_cycles=10,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    latency_ms = [ns / MS for ns in run.cycles["latency_ns"]]
    assert latency_ms == [13.0, *[12.0] * 19]


def test_a_quota_is_noticed_at_ticks_and_its_overrun_paid_back() -> None:
    # 2 ms in every 4; periods begin with the releases, and 3 ms after a tick.
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(0.5, 4.0, tick_ms=4.0))],
        [Task("work", {"R": Execution(Constant(6.0))})],
        period_ms=40.0,
        window_cycles=10,
    )
    real = replace(
        dwell.draw(problem, scenario="disturbed", seed=1, windows=1), phases={"R": Phase(0, 3 * MS)}
    )
    run = dwell.simulate_realisation(problem, real, policy="LOC")
    # It runs from 0 to 5: 1 of 2 ms are left at the first tick, and 1 too many of 4 are used at the
    # second. The refill at 8 pays that debt, and in the ms that it leaves the job ends.
    assert set(run.cycles["latency_ns"].to_list()) == {9 * MS}


def test_threads_take_turns_from_tick_to_tick() -> None:
    stress = NodeDisturbance(node="R", at_s=0.0, stress_threads=1)
    problem = make_problem(
        [Node("R", "robot", 1, quota=Quota(1.0, 4.0, tick_ms=4.0))],
        [Task("work", {"R": Execution(Constant(6.0))})],
        period_ms=40.0,
        window_cycles=10,
        scenario=[stress],
    )
    real = replace(
        dwell.draw(problem, scenario="disturbed", seed=1, windows=1), phases={"R": Phase(0, 1 * MS)}
    )
    run = dwell.simulate_realisation(problem, real, policy="LOC", jobs=True)
    assert run.jobs is not None
    # The other thread has the core until the tick at 3, and from 7 to 11.
    assert set((run.jobs["start_ns"] - run.jobs["ready_ns"]).to_list()) == {3 * MS}
    assert set(run.cycles["latency_ns"].to_list()) == {13 * MS}


def test_phases_are_drawn_where_ticks_are() -> None:
    def drawn(tick_ms: float, seed: int) -> Mapping[str, Phase]:
        node = Node("R", "robot", 1, quota=Quota(0.5, 10.0, tick_ms=tick_ms))
        problem = make_problem([node], [Task("work", {"R": Execution(Constant(1.0))})])
        return dwell.draw(problem, scenario="disturbed", seed=seed, windows=1).phases

    assert drawn(0.0, 1) == {}
    assert drawn(4.0, 1) == drawn(4.0, 1) != drawn(4.0, 2)
    period_ago, tick_ago, wakes = zip(*(drawn(4.0, seed)["R"] for seed in range(50)), strict=True)
    assert len(set(wakes)) == 50
    assert 0 <= min(period_ago) < 2 * MS < 8 * MS < max(period_ago) < 10 * MS
    assert 0 <= min(tick_ago) < MS < 3 * MS < max(tick_ago) < 4 * MS


def woken(hz: float, *disturbances: NodeDisturbance, quota: Quota, exec_ms: float) -> Run:
    """A job every 40 ms on a node where something else wakes so often."""
    problem = make_problem(
        [Node("R", "robot", 1, quota=quota, background_hz=hz)],
        [Task("work", {"R": Execution(Constant(exec_ms))})],
        period_ms=40.0,
        window_cycles=25,
        scenario=[*disturbances],
    )
    real = dwell.draw(problem, scenario="disturbed", seed=1, windows=20)
    phase = real.phases["R"]._replace(period_ago_ns=0, tick_ago_ns=3 * MS)
    return dwell.simulate_realisation(problem, replace(real, phases={"R": phase}), policy="LOC")


def latencies_ms(run: Run) -> np.ndarray[Any, Any]:
    return run.cycles["latency_ns"].to_numpy() / MS


def test_what_wakes_has_the_kernel_look_at_the_quota() -> None:
    # Beside the ticks, which alone make it 9 ms (above): looked at all the time it is used up after
    # 2 ms of every 4, and what is overrun by then is paid in the next period.
    run = woken(100_000.0, quota=Quota(0.5, 4.0, tick_ms=4.0), exec_ms=6.0)
    assert latencies_ms(run).mean() == pytest.approx(10.0, abs=0.03)
    # It runs on to the tick at 5, unless something wakes between 2, when 2 are used up, and 4.
    rare = latencies_ms(woken(100.0, quota=Quota(0.5, 4.0, tick_ms=4.0), exec_ms=6.0))
    assert 0.6 < np.mean(rare == 9.0) < 0.95


def test_what_wakes_has_the_kernel_pick_anew_who_runs() -> None:
    # Beside one foreign thread, on a whole core: 13 ms where threads take turns from tick to tick.
    stress = NodeDisturbance("R", stress_threads=1)
    quota = Quota(1.0, 4.0, tick_ms=4.0)
    run = woken(100_000.0, stress, quota=quota, exec_ms=6.0)
    assert latencies_ms(run) == pytest.approx(12.0, abs=0.2)
    # As often as here, turns are two gaps long in the mean, and never longer than to the next tick.
    often = latencies_ms(woken(1_000.0, stress, quota=quota, exec_ms=6.0))
    assert often.mean() == pytest.approx(12.0, rel=0.03)
    assert often.std() > 0.3


@pytest.mark.parametrize(("hz", "used"), [(0.0, 0.86), (300.0, 0.955), (1_000.0, 0.99)])
def test_the_more_often_something_wakes_the_less_of_a_quota_is_lost(hz: float, used: float) -> None:
    # Measured with a busy thread, 0.8 of a core in 3 ms, beside one that sleeps and wakes (its time
    # and its going to sleep, at which the kernel looks too, are not in the model).
    node = Node("R", "robot", 1, quota=Quota(0.8, 3.0, slack_ms=1.0, tick_ms=4.0), background_hz=hz)
    problem = make_problem(
        [node],
        [Task("work", {"R": Execution(Constant(0.1))})],
        period_ms=100.0,
        window_cycles=20,
        scenario=[NodeDisturbance("R", stress_threads=1)],
    )
    found = [
        dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=seed, windows=2).windows[
            "u_R"
        ][1]
        for seed in range(30)
    ]
    assert np.mean(found) == pytest.approx(used, abs=0.025)


@pytest.mark.parametrize(
    ("quota", "exec_ms", "latency_ms", "used"),
    [
        # 4 of the 5 ms in every period are left to the job.
        (Quota(0.5, 10.0), 3.0, 3.0, 0.5),
        (Quota(0.5, 10.0), 8.0, 14.0, 1.0),
        # 0.9 of the core are left to it: busy while it runs, and for a tenth of the rest.
        (None, 4.5, 5.0, 0.325),
    ],
)
def test_the_background_takes_of_the_quota_or_of_the_cores(
    quota: Quota | None, exec_ms: float, latency_ms: float, used: float
) -> None:
    problem = make_problem(
        [Node("R", "robot", 1, quota=quota, background=0.1)],
        [Task("work", {"R": Execution(Constant(exec_ms))})],
        period_ms=20.0,
        window_cycles=10,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    assert set(run.cycles["latency_ns"].to_list()) == {round(latency_ms * MS)}
    assert run.windows["u_R"].to_list() == pytest.approx([used] * 2)


def test_what_waits_while_jobs_run_takes_less_of_their_quota() -> None:
    # 4.5 of the 5 ms in every period are left to the job, 4 while there are foreign threads: these
    # have half of them. The job takes 1.25 times as long then.
    node = Node(
        *("R1", "robot", 1),
        quota=Quota(0.5, 10.0),
        background=0.1,
        background_beside=0.05,
        interference=1.25,
    )
    problem = make_problem(
        [node],
        [Task("work", {"R1": Execution(Constant(8.0))})],
        period_ms=100.0,
        window_cycles=5,
        scenario=[NodeDisturbance("R1", stress_threads=1)],
    )
    calm = dwell.simulate(problem, scenario="baseline", policy="LOC", seed=1, windows=2)
    assert set(calm.cycles["latency_ns"].to_list()) == {round(13.5 * MS)}
    assert calm.windows["u_R1"].to_list() == pytest.approx([0.36] * 2)
    stressed = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=2)
    # 1.6 ms of its 8 in every period.
    assert stressed.cycles["latency_ns"][1] == 44 * MS
    assert stressed.windows["u_R1"].to_list() == pytest.approx([1.0] * 2, abs=0.02)


def test_what_no_quota_counts_makes_the_core_slower_and_the_quota_last() -> None:
    # Others have half of the core's time: the job has used up its 2.5 ms of every 10 after 5, and
    # after three such periods it takes another millisecond for the last half of one.
    node = Node("R1", "robot", 1, quota=Quota(0.25, 10.0), contention=0.5)
    problem = make_problem(
        [node],
        [Task("work", {"R1": Execution(Constant(8.0))})],
        period_ms=100.0,
        window_cycles=5,
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    assert set(run.cycles["latency_ns"].to_list()) == {31 * MS}
    assert run.windows["u_R1"].to_list() == pytest.approx([8.0 / 25.0] * 2)
    ticking = replace(node, quota=Quota(0.25, 10.0, slack_ms=1.0, tick_ms=4.0))
    fabric = replace(problem.fabric, nodes={"R1": ticking})
    run = dwell.simulate(replace(problem, fabric=fabric), policy="LOC", seed=1, windows=20)
    assert run.windows["u_R1"].mean() == pytest.approx(8.0 / 25.0, rel=0.01)
    # What ticks notice late is made up for later; faster than its pace the job never is.
    assert min(run.cycles["latency_ns"].to_list()) >= 16 * MS


def test_a_period_that_begins_with_stress_and_a_job_is_a_stressed_one() -> None:
    # All three at 30 ms. Without stress a period has 5 ms, with it 2.5, of which the job has half.
    problem = make_problem(
        [Node("R1", "robot", 1, quota=Quota(0.5, 10.0), background=0.25, background_beside=0.0)],
        [Task("work", {"R1": Execution(Constant(4.0))}, offset_ms=30.0)],
        period_ms=100.0,
        window_cycles=5,
        scenario=[NodeDisturbance("R1", at_s=0.03, stress_threads=1)],
    )
    run = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=1)
    assert run.cycles["latency_ns"][0] == 60.5 * MS


def test_foreign_threads_of_a_node_on_the_same_cpu_take_more_of_it() -> None:
    # R2 has all of its core, and in the second of four windows, while R1 is stressed, a quarter.
    quota = Quota(0.4, 20.0)
    problem = make_problem(
        [
            Node("R1", "robot", 1),
            Node("R2", "robot", 1, quota=quota, contention_stressed={"R1": 0.75}),
        ],
        [Task("work", {"R2": Execution(Constant(10.0))})],
        period_ms=100.0,
        window_cycles=5,
        scenario=[NodeDisturbance("R1", at_s=0.5, for_s=0.5, stress_threads=1)],
    )
    run = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=4)
    # Calm: 8 ms, 12 of waiting, 2. Stressed: 5 ms in every period, less than its quota.
    assert run.cycles["latency_ns"].to_list() == [22 * MS] * 5 + [40 * MS] * 5 + [22 * MS] * 10
    # It is the same work, whatever it took of the core's time.
    assert run.windows["u_R2"].to_list() == pytest.approx([0.25] * 4)


def test_threads_that_hand_a_job_on_wait_for_their_turns() -> None:
    # One core, nothing used up: a foreign thread, ticks every 4 ms.
    def played(before_ms: float, after_ms: float) -> tuple[list[float], list[float]]:
        execution = Execution(Constant(4.0), before_ms=before_ms, after_ms=after_ms)
        problem = make_problem(
            [Node("R1", "robot", 1, quota=Quota(1.0, 1000.0, 0.0, 4.0))],
            [Task("work", {"R1": execution})],
            period_ms=101.0,
            window_cycles=40,
            scenario=[NodeDisturbance("R1", stress_threads=1)],
        )
        run = dwell.simulate(
            problem, scenario="disturbed", policy="LOC", seed=3, windows=1, jobs=True
        )
        waits_ns = run.jobs["start_ns"] - run.jobs["ready_ns"]
        latency_ns = run.cycles["latency_ns"].to_list()
        return [ns / MS for ns in latency_ns], [ns / MS for ns in waits_ns.to_list()]

    one, first_waits = played(0.0, 0.0)
    three, waits = played(1.0, 1.0)
    # One thread waits for the end of the foreign one's turn, at a tick.
    assert min(one) > 4.9
    assert first_waits.count(0.0) <= 2
    # Of three the first takes the turn at once where it has lasted 1.4 ms.
    assert waits.count(0.0) >= 18
    # The worker lets the foreign one go first, which has waited: to the first tick after 1.4 ms.
    at_once = [ms for ms, wait in zip(three, waits, strict=True) if wait == 0.0]
    assert min(at_once) >= 4.0 + 1.4
    # The last goes first: nobody has had another turn.
    assert max(at_once) < 4.0 + 1.4 + 4.0


def test_jobs_are_where_their_cycles_were_placed(canonical: Problem) -> None:
    run = dwell.simulate(canonical, policy=Script("SO", "LOC", "HYB"), seed=1, windows=6, jobs=True)
    placed = run.cycles.select("cycle", pl.col("placement").cast(str))
    jobs = run.jobs.with_columns(pl.col("task", "node").cast(str)).join(placed, on="cycle")
    for task, node, candidate in jobs.select("task", "node", "placement").unique().iter_rows():
        assert canonical.candidates[candidate][task] == node
    finished = jobs.filter(pl.col("end_ns").is_not_null() & pl.col("start_ns").is_not_null())
    assert (finished["ready_ns"] <= finished["start_ns"]).all()
    assert (finished["start_ns"] <= finished["end_ns"]).all()
    with pytest.raises(RunError):
        _ = dwell.simulate(canonical, seed=1, windows=1).jobs


def test_a_flow_waits_for_its_link() -> None:
    # 5 ms on R, 1 ms and 8 * 12500 / 100e3 = 1 ms to E, 5 ms there.
    execution = Execution(Constant(5.0))
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("a", {"R": execution}), Task("b", {"E": execution})],
        [Flow("a", "b", 12_500)],
        links=[Link("R", "E", Constant(1.0), rate_mbps=100.0)],
        window_cycles=5,
    )
    row = dwell.simulate(problem, policy="LOC", seed=1, windows=2).cycles.row(0, named=True)
    assert (row["latency_ns"], row["compute_ns"], row["queue_ns"], row["network_ns"]) == (
        12 * MS,
        10 * MS,
        0,
        2 * MS,
    )


def test_a_controller_that_is_down_all_along_decides_nothing() -> None:
    problem = two_nodes(scenario=[NodeDisturbance(node="E", down=True)], on="E")
    for policy in ("LOC", "dtp"):
        run = dwell.simulate(problem, scenario="disturbed", policy=policy, seed=1, windows=3)
        assert run.decisions.height == 0
        assert run.windows["cost"].null_count() == 3
        assert run.decisions.schema == dwell.simulate(problem, seed=1, windows=1).decisions.schema
