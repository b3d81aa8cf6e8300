"""Chains of a cell file: keys, faults, and the names of their columns."""

from __future__ import annotations

from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.errors import ProblemError
from dwell.model import Chain
from dwell.model.document import to_document
from dwell.record import column_types

CELL: dict[str, Any] = {
    "dwell": 1,
    "period_ms": 10,
    "nodes": {"R": {"tier": "robot"}},
    "tasks": {
        name: {"on": {"R": {"exec_ms": 1}}} for name in ("camera", "detect", "imu", "control")
    },
    "flows": [
        {"from": "camera", "to": "detect"},
        {"from": "detect", "to": "control", "sampled": True},
        {"from": "imu", "to": "control"},
    ],
    "candidates": {"LOC": {}},
    "objective": {"weights": {}},
}


def cell(**chains: object) -> dict[str, Any]:
    return {**CELL, "chains": chains}


def faults(document: dict[str, Any]) -> list[str]:
    with pytest.raises(ProblemError) as caught:
        from_document(document)
    return [str(fault) for fault in caught.value.faults]


def test_a_chain_leads_over_flows_of_both_kinds() -> None:
    problem = from_document(cell(see={"from": "camera", "to": "control", "max_age_ms": 150}))
    assert problem.pipeline.chains == {"see": Chain("camera", "control", 150)}
    assert from_document(to_document(problem)) == problem


@pytest.mark.parametrize(
    ("chain", "words"),
    [
        ({"from": "imu", "to": "detect"}, ["chains.see", "imu", "detect"]),
        ({"from": "control", "to": "camera"}, ["chains.see", "control", "camera"]),
        ({"from": "imu", "to": "imu"}, ["chains.see", "imu"]),
        ({"from": "imus", "to": "control"}, ["chains.see.from", "'imus'", "'imu'"]),
        ({"from": "imu", "to": "controls"}, ["chains.see.to", "'controls'", "'control'"]),
        ({"from": "imu"}, ["chains.see.to", "missing"]),
        ({"from": "imu", "to": "control", "max_age_ms": 0}, ["max_age_ms", "above 0"]),
        ({"from": "imu", "to": "control", "least": 0}, ["chains.see.least"]),
    ],
)
def test_a_bad_chain_is_one_fault(chain: dict[str, object], words: list[str]) -> None:
    (fault,) = faults(cell(see=chain))
    assert [word for word in words if word not in fault] == []


def test_a_bad_name_of_a_chain_is_a_fault() -> None:
    (fault,) = faults(cell(**{"a/b": {"from": "imu", "to": "control"}}))
    assert fault.startswith("chains.a/b")


def test_the_target_of_a_chain_that_counts_as_latency_is_its_largest_age() -> None:
    ends = {"from": "camera", "to": "control"}

    def target_ms(objective: dict[str, Any]) -> float:
        chains = {"see": {**ends, "max_age_ms": 150}, "free": ends}
        return from_document(
            {**cell(**chains), "objective": objective}
        ).objective.targets.latency_ms

    assert target_ms({"latency": "see"}) == 150
    assert target_ms({"latency": "see", "targets": {"robot": 0.5}}) == 150
    assert target_ms({"latency": "see", "targets": {"latency_ms": 60}}) == 60
    # Without such a chain, or without its bound, the deadline counts.
    assert target_ms({}) == target_ms({"latency": "free"}) == 10


@pytest.mark.parametrize("max_age_ms", [1e12, 1e-12])
def test_an_age_that_cannot_be_the_target_is_a_fault_of_the_chain(max_age_ms: float) -> None:
    chain = {"from": "camera", "to": "control", "max_age_ms": max_age_ms}
    (fault,) = faults({**cell(see=chain), "objective": {"latency": "see"}})
    assert fault.startswith(f"chains.see.max_age_ms: {max_age_ms} is not allowed; it must be a")
    assert "objective.targets.latency_ms" in fault
    given = {"latency": "see", "targets": {"latency_ms": 50}}
    assert from_document({**cell(see=chain), "objective": given}).objective.latency == "see"


def test_chains_have_columns_of_windows() -> None:
    problem = from_document(cell(see={"from": "camera", "to": "control"}))
    columns = [name for name in column_types("windows", problem) if name.endswith("_see")]
    assert columns == ["age_l95_see", "age_missed_see", "reaction_l95_see"]


def test_a_very_large_age_limit_is_never_reached() -> None:
    largest = Chain("camera", "control", 1e308)
    assert largest.is_bounded
    assert largest.max_age_ns == Chain("camera", "control").max_age_ns
    cell = {
        **CELL,
        "chains": {"see": {"from": "camera", "to": "control", "max_age_ms": 1e308}},
        "objective": {"latency": "see", "targets": {"latency_ms": 50}},
    }
    assert from_document(cell).censor_ms == largest.max_age_ns / 1e6
