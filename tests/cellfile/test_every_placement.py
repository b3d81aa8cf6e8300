"""`candidates: all` in a cell file."""

from __future__ import annotations

from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.model.document import to_document
from dwell.model.every_placement import EveryPlacement
from tests.cellfile.faulty import DOCUMENT, faults_of_document

MOVES: dict[str, Any] = DOCUMENT["candidates"]
FIRST, SECOND, *_ = MOVES
TO = {FIRST: MOVES[FIRST], SECOND: MOVES[SECOND]}


def with_candidates(candidates: object, **controller: object) -> dict[str, Any]:
    return {
        **DOCUMENT,
        "candidates": candidates,
        "controller": {"policy": "dtp", "fallbacks": [], **controller},
    }


@pytest.mark.parametrize(
    ("given", "every", "named"),
    [
        ("all", EveryPlacement(), []),
        ({"all": True}, EveryPlacement(), []),
        ({"keep": 4, "all": True, **TO}, EveryPlacement(4), [FIRST, SECOND]),
        ({"all": "found", **TO}, EveryPlacement(8, True), [FIRST, SECOND]),
    ],
)
def test_a_search_is_read_and_written(
    given: object, every: EveryPlacement, named: list[str]
) -> None:
    problem = from_document(with_candidates(given))
    assert (problem.every_placement, list(problem.candidates)) == (every, named)
    assert from_document(to_document(problem)) == problem


@pytest.mark.parametrize(
    ("given", "path", "message"),
    [
        ({"all": MOVES[FIRST]}, "candidates.all", "no candidate can have the name `all`"),
        ({"all": False}, "candidates.all", "it must be true"),
        (
            {"all": True, "keep": MOVES[FIRST]},
            "candidates.keep",
            "no candidate can have the name `keep`",
        ),
        ({"keep": 3, **TO}, "candidates.keep", "needs `all: true`"),
        ({"all": True, "keep": 1}, "candidates.keep", "a whole number from 2 to 8"),
        ({"all": True, "keep": 9}, "candidates.keep", "a whole number from 2 to 8"),
        ({"all": "found"}, "candidates", "none is declared"),
        ("every", "candidates", "it must be `all`, or a mapping"),
    ],
)
def test_a_faulty_search_is_refused(given: object, path: str, message: str) -> None:
    (fault,) = faults_of_document(with_candidates(given))
    assert fault.path == path
    assert message in fault.message


def test_a_search_keeps_all_fallbacks() -> None:
    names = dict.fromkeys(("X", "Y", "Z"), MOVES[FIRST])
    given = with_candidates({"all": True, "keep": 2, **names}, fallbacks=["X", "Y", "Z"])
    (fault,) = faults_of_document(given)
    assert str(fault) == (
        "candidates.keep: 2 is not allowed; it must be at least 3, the number of fallbacks"
    )


@pytest.mark.parametrize(
    ("objective", "key"),
    [
        ({"weights": {"age": 1}, "targets": {"age_ms": 50}}, "weights.age"),
        ({"caps": {"misses": {"m": 1, "k": 20}}}, "caps.misses"),
    ],
)
def test_a_search_refuses_objectives_that_it_does_not_support(
    objective: dict[str, Any], key: str
) -> None:
    (fault,) = faults_of_document({**with_candidates("all"), "objective": objective})
    assert fault.path == f"objective.{key}"
    assert "the search of placements does not support it" in fault.message
    assert from_document({**with_candidates(TO), "objective": objective}).objective.beyond_cycles
