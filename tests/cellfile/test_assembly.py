"""What parts of a cell say of each other: links, candidates, states, shadows."""

from __future__ import annotations

import copy

import pytest

from dwell.cellfile import from_document
from dwell.errors import ProblemError
from dwell.model.document import to_document
from tests.cellfile.faulty import DOCUMENT, faults_of_document
from tests.cells.many import document_of


def test_a_link_stands_once() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["links"].append({"from": "E", "to": "R1", "delay_ms": 2})
    (fault,) = faults_of_document(document)
    assert fault.path == "links[3]"
    assert "E->R1 is declared again (first at links[0])" in fault.message


def test_a_candidate_needs_its_links() -> None:
    document = copy.deepcopy(DOCUMENT)
    del document["links"][1]
    faults = faults_of_document(document)
    assert [fault.path for fault in faults] == ["candidates.SO", "candidates.HYB"]
    assert "E->R2 for planning -> actuation" in faults[0].message


@pytest.mark.parametrize("estimator", ["shadow", "corrected"])
def test_shadows_of_all_alternatives_are_at_most_all_cycles(estimator: str) -> None:
    document = copy.deepcopy(DOCUMENT)
    document["controller"] |= {"estimator": estimator, "shadow_fraction": 0.6}
    (fault,) = faults_of_document(document)
    assert fault.path == "controller.shadow_fraction"
    assert "each of 2 alternatives is more than all cycles; at most 0.5" in fault.message
    document["controller"] |= {"shadow_fraction": 0.5}
    assert from_document(document)
    document["controller"] |= {"shadow_fraction": "auto"}
    problem = from_document(document)
    assert to_document(problem)["controller"]["shadow_fraction"] == "auto"
    assert from_document(to_document(problem)) == problem
    # An estimator without shadows asks for none.
    for other in ("profile", "scaling"):
        document["controller"] |= {"estimator": other, "shadow_fraction": 1.0}
        assert from_document(document)


def test_state_needs_a_link_to_be_carried_over() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["controller"]["migration"] = "cold"
    document["tasks"]["planning"]["state_bytes"] = 1000
    assert from_document(document)
    document["links"] = [
        link for link in document["links"] if {link["from"], link["to"]} != {"R2", "E"}
    ]
    faults = {fault.path: fault.message for fault in faults_of_document(document)}
    assert "E->R2" in faults["tasks.planning.state_bytes"]
    assert "R2->E" in faults["tasks.planning.state_bytes"]


def test_what_refers_to_a_part_at_fault_is_not_at_fault() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["nodes"]["E"] = {"tier": "edge", "accelerators": 7}
    document["tasks"]["perception"]["on"]["E"] = {"exec_ms": 6, "accelerator": "gpu"}
    document["tasks"]["planning"]["on"]["R2"] = "fast"
    document["candidates"]["SO"]["planning"] = 5
    document["controller"]["fallbacks"] = ["SO"]
    assert {fault.path for fault in faults_of_document(document)} == {
        "nodes.E.accelerators",
        "tasks.planning.on.R2",
        "candidates.SO.planning",
    }


def test_a_fault_in_episodes_is_no_difference_to_what_shares_their_name() -> None:
    good = {"name": "a", "every_s": 1, "for_s": {"exponential": {"mean": 2}}}
    bad = {**good, "for_s": {"exponential": {"mean": -2}}}
    document = copy.deepcopy(DOCUMENT)
    document["scenarios"]["x"] = [{"node": "E", "episodes": each} for each in (good, bad, good)]
    with pytest.raises(ProblemError) as caught:
        from_document(document)
    (fault,) = caught.value.faults
    assert fault.path == "scenarios.x[1].episodes.for_s.exponential.mean"


def test_only_a_shadow_fraction_that_is_given_can_be_too_large() -> None:
    assert from_document(document_of(21, shadow_fraction=0.05))
    assert from_document(document_of(22))
    (fault,) = faults_of_document(document_of(22, shadow_fraction=0.05))
    assert fault.path == "controller.shadow_fraction"
    assert "0.05 of the cycles through each of 21 alternatives" in fault.message
