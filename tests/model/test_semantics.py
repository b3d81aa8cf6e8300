from __future__ import annotations

import pytest

from dwell.model import Constant, Execution, Link, Task
from dwell.model.semantics import (
    CellParts,
    bad_name,
    find_faults,
    nearest,
    nearest_of,
    too_many_shadows,
)


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


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cafe\u0301", ("U+0301 (COMBINING ACUTE ACCENT)", "as one character")),
        ("\u0915\u094d", ("U+094D (DEVANAGARI SIGN VIRAMA)", "use letters")),
        ("a\u200bb", ("U+200B (ZERO WIDTH SPACE)", "use letters")),
        ("a/b", ("U+002F (SOLIDUS)", "use letters")),
        ("a\x07", ("U+0007", "use letters")),
        ("a  b", ("single spaces",)),
        ("-a", ("first",)),
        ("a" * 65, ("at most 64 characters",)),
    ],
)
def test_a_name_at_fault_says_which_character_it_is(name: str, words: tuple[str, ...]) -> None:
    for word in words:
        assert word in bad_name(name)


@pytest.mark.parametrize(
    "name", ["caf\u00e9", "R 1", "_a.b+c:d-e", "\u0420\u043e\u0431\u043e\u0442", "9"]
)
def test_letters_of_any_script_make_a_name(name: str) -> None:
    assert bad_name(name) == ""


def test_a_name_that_only_looks_declared_is_not_said_to_be_unknown() -> None:
    links = [("links[0]", Link("R", "e\u0301", Constant(1.0)))]
    faults = find_faults(
        CellParts(nodes={"R": None, "\u00e9": None}, tasks={"a": None}, links=links)
    )
    (fault,) = [fault for fault in faults if fault.path == "links[0].to"]
    assert "U+0301" in fault.message


def test_a_node_that_a_task_misspells_makes_no_fault_of_a_placement() -> None:
    once = Execution(Constant(1.0))
    parts = CellParts(
        nodes={"R": None, "E": None},
        tasks={"a": Task("a", {"R": once, "Edge": once})},
        candidates={"SO": {"a": "E"}},
    )
    assert [fault.path for fault in find_faults(parts)] == ["tasks.a.on.Edge"]
