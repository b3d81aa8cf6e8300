"""Replicas in simulated runs: the hedge, prices, evidence, refusals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import ProblemError
from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Message, Meter, Site
from dwell.estimators.profile import Profile
from dwell.estimators.scaling import Scaling
from dwell.model import Problem, QoS
from tests.reference.test_against import Probe

CELL: dict[str, Any] = {
    "dwell": 1,
    "name": "hedge",
    "period_ms": 200,
    "deadline_ms": 15,
    "window_cycles": 50,
    "nodes": {"R": {"tier": "robot"}, "A": {"tier": "edge"}, "B": {"tier": "edge"}},
    "links": [
        *(
            {"from": "R", "to": to, "delay_ms": 5, "loss": 0.01, "on_loss": {"retransmit_ms": 95}}
            for to in "AB"
        ),
        *({"from": source, "to": "R", "delay_ms": 0} for source in "AB"),
    ],
    "tasks": {
        "camera": {"on": {"R": {"exec_ms": 0}}},
        "work": {"on": {"A": {"exec_ms": 0.5}, "B": {"exec_ms": 0.25}}},
        "act": {"on": {"R": {"exec_ms": 0}}},
    },
    "flows": [
        {"from": "camera", "to": "work", "bytes": 1000},
        {"from": "work", "to": "act", "bytes": 1000},
    ],
    "candidates": {
        "ONE": {"work": "A"},
        "TWO": {"work": "B"},
        "NOW": {"replicas": ["ONE", "TWO"]},
        "LATER": {"replicas": ["ONE", "TWO"], "after_ms": 9.5},
    },
    "objective": {"weights": {"latency": 1.0}, "targets": {"latency_ms": 15}},
    "controller": {"policy": "ONE", "decide_cycles": 50, "fallbacks": ["ONE"]},
}


@pytest.fixture(scope="module")
def cell() -> Problem:
    return from_document(CELL)


def hedged(cell: Problem, name: str) -> tuple[float, float]:
    """Return the share of cycles over D, and the second copies per cycle."""
    run = dwell.simulate(cell, policy=name, seed=1, windows=1000, jobs=True)
    assert run.jobs is not None
    late = np.mean(run.cycles["latency_ns"].to_numpy() > 15e6)
    return float(late), float(np.sum(run.jobs["second"].to_numpy())) / len(run.cycles)


def test_a_second_copy_after_a_while_hedges_nearly_as_well_as_one_at_once(cell: Problem) -> None:
    alone, now, later = (hedged(cell, name) for name in ("ONE", "NOW", "LATER"))
    # 1e-2 alone, and 1e-4 with two links.
    assert alone[0] == pytest.approx(1e-2, rel=0.15)
    assert alone[1] == 0
    assert 0 < now[0] < 3e-4
    assert now[1] > 0.999 - 0.01
    assert 0 < later[0] < 3e-4
    assert later[1] == pytest.approx(1e-2, rel=0.15)


def test_both_copies_are_paid_for(cell: Problem) -> None:
    prices = Profile(cell)
    assert prices.violation_rate["NOW"] < prices.violation_rate["ONE"]
    assert prices.own["NOW"]["A"] == pytest.approx(prices.own["ONE"]["A"], rel=0.02)
    assert prices.own["NOW"]["B"] == pytest.approx(prices.own["TWO"]["B"], rel=0.02)
    run = dwell.simulate(cell, policy="NOW", seed=1, windows=40)
    assert run.windows["u_A"].mean() == pytest.approx(0.5 / 200, rel=0.02)
    assert run.windows["u_B"].mean() == pytest.approx(0.25 / 200, rel=0.02)


def evidence(cell: Problem, name: str) -> Evidence:
    """Return the evidence of the first window of a run under a candidate."""
    probe = Probe(0.0)
    dwell.simulate(cell, policy=name, estimator=probe, seed=1, windows=2)
    return probe.evidence[0]


def test_evidence_has_both_copies(cell: Problem) -> None:
    times = Meter(cell).times(evidence(cell, "NOW"))
    for node, ms in (("A", 0.5), ("B", 0.25)):
        assert times[Site("work", node)] == pytest.approx(ms)
        assert len(times[Site("work", node)]) >= 48


def test_a_cancelled_copy_is_not_lost(cell: Problem) -> None:
    seen = evidence(cell, "LATER")
    times = Meter(cell).times(seen)
    assert len(times[Site("work", "B")]) < 5
    assert all(np.isfinite(values).all() for values in times.values())
    assert (seen.cycles.ready_ns[:, 4] == -2).sum() > 45


@pytest.mark.parametrize("estimator", ["corrected", "scaling"])
def test_estimators_learn_from_a_slow_copy(estimator: str) -> None:
    scenarios = {"slow": [{"node": "A", "at_s": 10, "stress_threads": 999}]}
    controller = {"on": "R", "decide_cycles": 50}
    cell = from_document({**CELL, "scenarios": scenarios, "controller": controller})
    given = Scaling(cell, {("work", "A", "B"): 0.5}) if estimator == "scaling" else estimator
    run = dwell.simulate(cell, scenario="slow", policy="NOW", estimator=given, seed=1, windows=6)
    last = run.decisions.row(-1, named=True)
    assert last["est_violation_rate_ONE"] > 0.9
    assert last["est_violation_rate_NOW"] < 0.1
    assert last["est_violation_rate_TWO"] < 0.1


def failing(**for_s: float) -> Problem:
    """Return the cell with a third candidate, and a scenario: nodes are down from 3 s on."""
    disturbances = [
        {"node": name, "at_s": 3, "for_s": length_s, "down": True}
        for name, length_s in for_s.items()
    ]
    work = {"on": {name: {"exec_ms": 0.5} for name in "ABC"}}
    return from_document(
        {
            **CELL,
            "nodes": {**CELL["nodes"], "C": {"tier": "edge"}},
            "links": [
                *CELL["links"],
                {"from": "R", "to": "C", "both_ways": True, "delay_ms": 1},
            ],
            "tasks": {**CELL["tasks"], "work": work},
            "candidates": {**CELL["candidates"], "THREE": {"work": "C"}},
            "controller": {"on": "R", "fallbacks": ["THREE", "ONE"], "probe_cycles": 5},
            "scenarios": {"fails": disturbances},
        }
    )


class Wish:
    """A policy that always wants one candidate."""

    def __init__(self, name: str) -> None:
        self.name = name

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Return it."""
        return self.name


def guarded(problem: Problem, wish: str) -> dwell.Run:
    """Simulate a policy with a wish under the guard, from 3 s on in the scenario."""
    controller = replace(problem.controller, initial=wish)
    problem = replace(problem, controller=controller)
    policy = Wish(wish)
    return dwell.simulate(problem, policy=policy, scenario="fails", seed=1, windows=4, guard=True)


def test_the_guard_stays_while_one_copy_completes_cycles() -> None:
    run = guarded(failing(A=100), "NOW")
    assert {*run.cycles["placement"]} == {"NOW"}
    assert {*run.cycles["outcome"]} == {"done"}


def test_the_guard_leaves_replicas_of_which_neither_copy_completes_cycles() -> None:
    run = guarded(failing(A=100, B=100), "NOW")
    lost = (run.cycles["outcome"] != "done").to_list()
    # Patience is three periods; two more cycles are released up to the move.
    assert lost == [False] * 15 + [True] * 3 + [False] * (len(lost) - 18)
    assert run.cycles["placement"].to_list() == ["NOW"] * 18 + ["THREE"] * (len(lost) - 18)


@pytest.mark.parametrize(("a_for_s", "b_for_s", "returns"), [(100, 10, False), (10, 100, True)])
def test_probes_of_replicas_go_through_their_first_member(
    a_for_s: float, b_for_s: float, returns: bool
) -> None:
    run = guarded(failing(A=a_for_s, B=b_for_s), "NOW")
    assert (run.cycles["placement"][-1] == "NOW") == returns


def test_no_shadow_goes_through_a_member_of_the_replicas_in_force() -> None:
    problem, probe = failing(), Probe(0.1)
    dwell.simulate(problem, policy="NOW", estimator=probe, seed=1, windows=2)
    names = list(problem.candidates)
    sent = {names[i] for seen in probe.evidence for i in seen.shadow_placement if i >= 0}
    assert sent == {"THREE"}
    times = Meter(problem).times(probe.evidence[0])
    assert times[Site("work", "C")] == pytest.approx(0.5)
    dwell.simulate(problem, policy="ONE", estimator=probe, seed=1, windows=2)
    sent = {names[i] for seen in probe.evidence for i in seen.shadow_placement if i >= 0}
    assert sent == {"TWO", "THREE"}


def test_messages_to_a_node_that_is_down_are_not_cancelled() -> None:
    problem, probe = failing(B=100), Probe(0.0)
    dwell.simulate(problem, policy="NOW", estimator=probe, scenario="fails", seed=1, windows=3)
    link = Message("camera", "work", "R->B")
    first, *_, last = (Meter(problem).times(seen)[link] for seen in probe.evidence)
    assert np.isfinite(first).all()
    assert np.isinf(last).all()


def test_a_search_leaves_replicas_out(cell: Problem) -> None:
    found = dwell.search(cell, cycles=50)
    assert sorted(dict(placement)["work"] for placement, _, _ in found) == ["A", "B"]


def test_replicas_may_be_named_where_placements_are_searched() -> None:
    candidates = {**CELL["candidates"], "all": True, "keep": 4}
    controller = {"policy": "NOW", "decide_cycles": 50}
    given = from_document({**CELL, "candidates": candidates, "controller": controller})
    run = dwell.simulate(given, seed=1, windows=2)
    assert list(run.problem.candidates) == ["ONE", "TWO", "NOW", "LATER"]


def test_a_search_keeps_named_replicas() -> None:
    candidates = {**CELL["candidates"], "all": True, "keep": 3}
    with pytest.raises(ProblemError, match="at least 4, the number of named candidates"):
        from_document({**CELL, "candidates": candidates})
