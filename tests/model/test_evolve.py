"""Evolve: other values by the paths of a cell file."""

from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.model import Caps, Chain, Constant, LogNormal, Node, Placement, Targets, evolve

CANONICAL = dwell.load(Path(__file__).parents[2] / "examples" / "canonical.yaml")


def test_a_setting_changes_and_nothing_else() -> None:
    found = evolve(CANONICAL, {"controller.min_dwell": 1})
    assert found.controller.min_dwell == 1
    assert evolve(found, {"controller.min_dwell": CANONICAL.controller.min_dwell}) == CANONICAL


def test_values_of_every_part() -> None:
    found = evolve(
        CANONICAL,
        {
            "period_ms": 40.0,
            "deadline_ms": 38.0,
            "nodes.E.cores": 7,
            "links[1].delay_ms": 3,
            "tasks.perception.on.R1.exec_ms": LogNormal(9.0, 0.1),
            "objective.weights.switching": 0.25,
            "objective.caps": {"latency_ms": 90.0},
            "window_cycles": 20.0,
            "controller.decide_cycles": 5,
        },
    )
    assert (found.pipeline.period_ms, found.pipeline.deadline_ms) == (40.0, 38.0)
    assert found.fabric.nodes["E"].cores == 7
    assert list(found.fabric.links.values())[1].delay_ms == Constant(3.0)
    assert found.pipeline.tasks["perception"].on["R1"].exec_ms == LogNormal(9.0, 0.1)
    assert found.objective.weights.switching == 0.25
    assert found.objective.caps == Caps(latency_ms=90.0)
    assert found.window_cycles == 20
    assert found.candidates == CANONICAL.candidates


CHAIN = {"from": "sensing", "to": "control", "max_age_ms": 200}


def test_mappings_become_the_parts_that_they_describe() -> None:
    chains = {"reaction": Chain("sensing", "control", 200.0)}
    assert evolve(CANONICAL, {"chains": {"reaction": CHAIN}}).pipeline.chains == chains
    assert evolve(CANONICAL, {"chains.reaction": CHAIN}).pipeline.chains == chains
    by_key = {f"chains.reaction.{name}": value for name, value in CHAIN.items()}
    assert evolve(CANONICAL, by_key).pipeline.chains == chains
    flows = [{"from": one.source, "to": one.target} for one in CANONICAL.pipeline.flows]
    found = evolve(CANONICAL, {"flows": flows, "nodes.E": {"tier": "edge", "cores": 3.0}})
    assert [one.target for one in found.pipeline.flows] == [one["to"] for one in flows]
    assert found.fabric.nodes["E"] == Node("E", "edge", 3)
    placed = dict(CANONICAL.candidates["SO"])
    found = evolve(CANONICAL, {"candidates.LOC": placed, "candidates.HYB.planning": "R2"})
    assert found.candidates["LOC"] == Placement(placed)
    assert found.candidates["HYB"].first["planning"] == "R2"
    assert evolve(CANONICAL, {"scales.scene": 2}).pipeline.scales["scene"] == Constant(2.0)


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        ("chains", 3, "chains: 3 is not allowed; it must be a mapping"),
        ("chains", {"a": 3}, "chains.a: 3 is not allowed; it must be of the type `Chain`, or a"),
        ("chains", {"a": {"form": "x"}}, "chains.a.form: unknown key 'form'; did you mean 'from'?"),
        ("chains.a", {"from": "sensing"}, "chains.a.to: missing; add it"),
        ("chains.a.from", "sensing", "chains.a.to: missing; add it"),
        ("chains", {"a": {**CHAIN, "max_age_ms": 0}}, "chains.a.max_age_ms: 0 is not allowed"),
        ("nodes.R2.bursts.threads", 1, "nodes.R2.bursts.every_ms: missing; add it"),
        ("objective", None, "objective: None is not allowed"),
        ("objective.caps", {"latncy": 3}, "objective.caps.latncy: unknown key 'latncy'"),
        ("objective.caps.misses", {"m": 1}, "objective.caps.misses.k: missing; add it"),
        ("objective.caps.misses", 3, "objective.caps.misses: 3 is not allowed"),
        ("flows", CHAIN, "flows: {'from': .* is not allowed; it must be a list"),
        ("links[0].delay_ms", "x", r"links\[0\].delay_ms: 'x' is not allowed; .* `Process`"),
        ("links[0]", {"from": "R1"}, r"links\[0\].to: missing; add it"),
        ("tasks.perception.on.E", 3, "tasks.perception.on.E: 3 is not allowed"),
        ("scenarios.baseline", [3], r"scenarios.baseline\[0\]: 3 is not allowed; .* `NodeDist"),
        ("candidates.LOC", 3, "candidates.LOC: 3 is not allowed; .* `Placement`"),
        ("candidates.LOC", {"planning": 3}, "candidates.LOC: .* must be a non-empty name"),
        ("candidates.LOC.planning", "Q", "candidates.LOC.planning: unknown node .Q."),
        ("controller.fallbacks", "LOC", "controller.fallbacks: 'LOC' is not allowed; .* a list"),
    ],
)
def test_a_value_of_another_type_is_told_with_its_field(
    path: str, value: object, fault: str
) -> None:
    with pytest.raises(ProblemError, match=f"^{fault}"):
        evolve(CANONICAL, {path: value})


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("controller.min_dwell", -1, "-1 is not allowed; it must be a whole number from 0"),
        ("controller.migration", "hot", "'hot' is not allowed; it must be one of warm, cold"),
        ("controller.escape", "yes", "'yes' is not allowed; it must be true or false"),
        ("objective.weights.egde", 3, "unknown key 'egde'; did you mean 'edge'?"),
        ("nodes.E9.cores", 3, "no 'E9'"),
        ("links[99].loss", 0.1, "there is no links[99]"),
        ("deadline_ms", 1e6, "at most 64 period_ms"),
        ("tasks.perception.on.R1.threads", 0, "0 is not allowed"),
    ],
)
def test_a_wrong_value_is_told_at_its_path(path: str, value: object, told: str) -> None:
    with pytest.raises(ProblemError) as caught:
        evolve(CANONICAL, {path: value})
    (fault,) = caught.value.faults
    assert told in fault.message
    assert fault.path == path


def test_what_is_drawn_is_equal_where_only_settings_differ() -> None:
    found = evolve(CANONICAL, {"controller.min_dwell": 1, "objective.weights.edge": 0.0})
    assert found.drawn == CANONICAL.drawn
    assert hash(found.drawn) == hash(CANONICAL.drawn)
    assert evolve(CANONICAL, {"nodes.E.cores": 7}).drawn != CANONICAL.drawn


def test_the_latency_target_defaults_to_the_one_of_a_file() -> None:
    named = {"chains.reaction": CHAIN, "objective.latency": "reaction"}
    given = {"objective.targets": {"robot": 0.6}}
    chained = evolve(CANONICAL, named)
    for problem, changes, target_ms in (
        (CANONICAL, {}, CANONICAL.pipeline.deadline_ms),
        (CANONICAL, {"deadline_ms": 30.0}, 30.0),
        (CANONICAL, named, 200.0),
        (chained, {}, 200.0),
        (chained, {"chains.reaction.max_age_ms": 150.0}, 150.0),
        (chained, {"objective.latency": None}, CANONICAL.pipeline.deadline_ms),
    ):
        found = evolve(problem, {**given, **changes})
        assert found.objective.targets == Targets(target_ms, robot=0.6)


@pytest.mark.parametrize(
    ("outer", "inner"),
    [
        ("objective", "objective.targets"),
        ("objective.targets", "objective.targets.robot"),
        ("nodes.E", "nodes.E.cores"),
        ("links[0]", "links[0].delay_ms"),
    ],
)
def test_overlapping_paths_are_refused(outer: str, inner: str) -> None:
    for changes in ({outer: {}, inner: 1}, {inner: 1, outer: {}}):
        with pytest.raises(ProblemError) as caught:
            evolve(CANONICAL, changes)
        assert str(caught.value) == f"{inner}: is a part of {outer}; give one of them"


def test_a_candidate_with_two_copies_is_given_whole() -> None:
    problem = dwell.load(Path(__file__).parents[2] / "examples" / "replicas.yaml")
    with pytest.raises(ProblemError, match=r"^candidates.NOW: .* give it whole, as `Replicas`"):
        evolve(problem, {"candidates.NOW.after_ms": 3})
    assert evolve(problem, {"window_cycles": 40}).candidates == problem.candidates
