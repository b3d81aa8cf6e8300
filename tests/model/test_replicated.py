"""Candidates with replicas: keys, faults, placements."""

from __future__ import annotations

import pickle
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.cost import hamming
from dwell.errors import PlacementError, ProblemError
from dwell.model import Placement, Problem, Replicas
from dwell.model.document import to_document

CELL: dict[str, Any] = {
    "dwell": 1,
    "period_ms": 20,
    "deadline_ms": 20,
    "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}, "F": {"tier": "edge"}},
    "links": [
        {"from": a, "to": b, "both_ways": True, "delay_ms": 1}
        for a, b in (("R", "E"), ("R", "F"), ("E", "F"))
    ],
    "tasks": {
        "camera": {"on": {node: {"exec_ms": 1} for node in "RE"}},
        "detect": {"on": {node: {"exec_ms": 1} for node in "REF"}},
        "plan": {"on": {node: {"exec_ms": 1} for node in "REF"}},
        "act": {"on": {node: {"exec_ms": 1} for node in "RE"}},
    },
    "flows": [
        {"from": "camera", "to": "detect"},
        {"from": "detect", "to": "plan"},
        {"from": "plan", "to": "act"},
    ],
    "candidates": {
        "LOC": {"camera": "R", "detect": "R", "plan": "R", "act": "R"},
        "SO": {"camera": "R", "detect": "E", "plan": "R", "act": "R"},
        "FAR": {"camera": "R", "detect": "E", "plan": "F", "act": "R"},
        "SINK": {"camera": "R", "detect": "E", "plan": "E", "act": "E"},
        "SOURCE": {"camera": "E", "detect": "E", "plan": "R", "act": "R"},
        "TWIN": {"camera": "R", "detect": "R", "plan": "R", "act": "R"},
    },
    "objective": {"weights": {}},
}


def cell(both: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {**CELL, **more, "candidates": {**CELL["candidates"], "BOTH": both}}


def problem(*members: str, after_ms: float = 5.0) -> Problem:
    return from_document(cell({"replicas": list(members), "after_ms": after_ms}))


def test_a_task_with_two_nodes_is_placed_on_both() -> None:
    both = problem("LOC", "FAR").candidates["BOTH"]
    assert isinstance(both, Replicas)
    assert isinstance(both, Placement)
    assert both["detect"] == ("R", "E")
    assert both["plan"] == ("R", "F")
    assert both["camera"] == both["act"] == "R"
    assert (both.members, both.after_ms, both.doubled) == (("LOC", "FAR"), 5.0, ("detect", "plan"))


def test_a_document_keeps_the_members_and_the_time() -> None:
    one = problem("LOC", "SO")
    assert to_document(one)["candidates"]["BOTH"] == {"replicas": ["LOC", "SO"], "after_ms": 5.0}
    assert from_document(to_document(one)) == one
    assert from_document(to_document(one)) != problem("LOC", "SO", after_ms=6.0)


def test_replicas_are_equal_by_members_and_time() -> None:
    both, later = (problem("LOC", "SO", after_ms=ms).candidates["BOTH"] for ms in (0.0, 1.0))
    again = pickle.loads(pickle.dumps(both))
    assert again == both
    assert hash(again) == hash(both)
    assert eval(repr(both)) == both
    assert both != later
    assert both != Placement(both.first)
    assert both != problem("SO", "LOC", after_ms=0.0).candidates["BOTH"]


def test_hamming_counts_tasks_whose_set_of_nodes_changes() -> None:
    placed = problem("LOC", "FAR").candidates
    swapped = problem("FAR", "LOC").candidates["BOTH"]
    shares = {name: hamming(placed["BOTH"], placed[name]) for name in ("LOC", "SO", "FAR", "BOTH")}
    assert shares == {"LOC": 0.5, "SO": 0.5, "FAR": 0.5, "BOTH": 0.0}
    assert hamming(swapped, placed["BOTH"]) == 0.0
    assert placed["BOTH"].moved(placed["SO"]) == ("detect", "plan")


@pytest.mark.parametrize(
    ("both", "path", "words"),
    [
        ({"replicas": "LOC"}, "replicas", "name two candidates, as [LOC, SO]"),
        ({"replicas": "LOC", "after_ms": 5}, "replicas", "'LOC' is not allowed; it must be a list"),
        ({"replicas": {"ONE": "LOC"}}, "replicas", "a mapping is not allowed; it must be a list"),
        ({"after_ms": 5}, "replicas", "missing"),
        ({"replicas": []}, "replicas", "exactly two"),
        ({"replicas": ["LOC"]}, "replicas", "exactly two"),
        ({"replicas": ["LOC", "LOC"]}, "replicas", "exactly two"),
        ({"replicas": ["LOC", "SO", "FAR"]}, "replicas", "exactly two"),
        ({"replicas": ["LOC", "SOO"]}, "replicas[1]", "did you mean 'SO'"),
        ({"replicas": ["BOTH", "LOC"]}, "replicas[0]", "has replicas itself"),
        ({"replicas": ["LOC", "TWIN"]}, "replicas", "place no task differently"),
        ({"replicas": ["LOC", "SINK"]}, "replicas", "act is a sink and would run on R and E"),
        ({"replicas": ["LOC", "SOURCE"]}, "replicas", "camera is the first source"),
        ({"replicas": ["LOC", "SO"], "after_ms": 20.5}, "after_ms", "at most deadline_ms = 20"),
        ({"replicas": ["LOC", "SO"], "after_ms": -1}, "after_ms", "at least 0"),
        ({"replicas": ["LOC", "SO"], "after": 1}, "after", "did you mean 'after_ms'"),
    ],
)
def test_faults(both: dict[str, Any], path: str, words: str) -> None:
    with pytest.raises(ProblemError) as caught:
        from_document(cell(both))
    found = {fault.path: fault.message for fault in caught.value.faults}
    assert words in found[f"candidates.BOTH.{path}"]


@pytest.mark.parametrize(
    ("more", "word"),
    [
        ({"deadline_ms": 21}, "deadline_ms above period_ms"),
        ({"tasks": {**CELL["tasks"], "camera": {**CELL["tasks"]["camera"], "every": 2}}}, "every"),
        ({"flows": [*CELL["flows"][:2], {**CELL["flows"][2], "sampled": True}]}, "sampled"),
        ({"chains": {"way": {"from": "camera", "to": "act"}}}, "chains"),
    ],
)
def test_cells_without_replicas(more: dict[str, Any], word: str) -> None:
    with pytest.raises(ProblemError) as caught:
        from_document(cell({"replicas": ["LOC", "SO"]}, **more))
    (fault,) = [one for one in caught.value.faults if one.path == "candidates.BOTH.replicas"]
    assert word in fault.message


def test_no_fallback_has_replicas() -> None:
    settings = {"fallbacks": ["LOC", "BOTH"]}
    with pytest.raises(ProblemError) as caught:
        from_document(cell({"replicas": ["LOC", "SO"]}, controller=settings))
    (fault,) = caught.value.faults
    assert fault.path == "controller.fallbacks[1]"
    assert "BOTH has replicas" in fault.message


def test_a_task_may_be_called_replicas() -> None:
    tasks = {"replicas": {"on": {node: {"exec_ms": 1} for node in "RE"}}}
    document = {**CELL, "tasks": tasks, "flows": [], "candidates": {"LOC": {"replicas": "E"}}}
    assert from_document(document).candidates["LOC"] == {"replicas": "E"}


@pytest.mark.parametrize("number", [1, 3])
def test_two_plain_members(number: int) -> None:
    members = {str(i): Placement({"act": f"N{i}"}) for i in range(number)}
    with pytest.raises(PlacementError):
        Replicas(members)
