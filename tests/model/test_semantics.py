from __future__ import annotations

import pytest

from dwell.model.semantics import CellParts, find_faults, nearest, nearest_of, too_many_shadows


@pytest.mark.parametrize(
    ("word", "known", "hint"),
    [
        ("perceptoin", ["perception", "planning"], "did you mean 'perception'?"),
        ("x", ["perception", "planning"], "known: perception, planning"),
        ("x", [], "none is declared"),
    ],
)
def test_an_unknown_name_has_a_remedy(word: str, known: list[str], hint: str) -> None:
    assert nearest(word, known) == hint


def test_all_known_names_are_said_once() -> None:
    assert nearest_of("SOO", ["LOC", "SO"], "candidates") == (
        "did you mean 'SO'? (candidates here: LOC, SO)"
    )
    assert nearest_of("x", ["LOC", "SO"], "candidates") == "known: LOC, SO"


def test_alternatives_share_the_cycles() -> None:
    assert too_many_shadows(0.5, 3) is None or not too_many_shadows(0.5, 3)
    assert too_many_shadows(0.51, 3)
    assert not too_many_shadows(1.0, 2)


def test_what_could_not_be_read_is_known_by_its_name_and_asked_nothing_more() -> None:
    parts = CellParts(nodes={"R1": None, "E": None}, tasks={"sensing": None})
    parts.candidates = {"LOC": {"sensing": "Edge"}, "SO": {"sensin": "E"}}
    (fault,) = find_faults(parts)
    assert str(fault) == "candidates.SO.sensin: unknown task 'sensin'; did you mean 'sensing'?"
