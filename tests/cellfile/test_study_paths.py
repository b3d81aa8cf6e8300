from __future__ import annotations

from typing import Any

import pytest

from dwell.cellfile.study_paths import put, steps_of
from dwell.errors import ProblemError

CELL: dict[str, Any] = {
    "nodes": {"R1": {"cores": 4}, "edge.two": {"cores": 8}},
    "links": [{"from": "R1", "delay_ms": 1}],
    "name": "cell",
}


@pytest.mark.parametrize(
    ("path", "steps"),
    [
        ("nodes.R1.cores", ("nodes", "R1", "cores")),
        ("nodes.edge.two.cores", ("nodes", "edge.two", "cores")),
        ("links[0].delay_ms.exponential.mean", ("links", 0, "delay_ms", "exponential", "mean")),
        ("controller.min_dwell", ("controller", "min_dwell")),
    ],
)
def test_a_path_in_steps(path: str, steps: tuple[str | int, ...]) -> None:
    if path.startswith("links"):
        CELL["links"][0]["delay_ms"] = {"exponential": {"mean": 1}}
    assert steps_of(path, CELL) == steps


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("", "not a path"),
        ("nodes.", "not a path"),
        ("links[0]delay_ms", "not a path"),
        ("links.R1", "links is a list; take one of its items"),
        ("links[1].delay_ms", r"there is no links\[1\]; links has 1 items"),
        ("nodes[0]", r"nodes is no list; it has no item \[0\]"),
        ("name.first", "name is 'cell'; it has no key 'first'"),
        ("nodes.R2.cores", "the cell's nodes have no 'R2'; known: R1, edge.two"),
    ],
)
def test_a_path_that_leads_nowhere(path: str, words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        steps_of(path, CELL)


def test_what_is_put_leaves_the_document_as_it_was() -> None:
    before: dict[str, Any] = {"links": [{"a": 1}, {"b": 2}]}
    after = put(before, ("links", 1, "c", "d"), 3)
    assert after == {"links": [{"a": 1}, {"b": 2, "c": {"d": 3}}]}
    assert before == {"links": [{"a": 1}, {"b": 2}]}
    assert put(before, (), 7) == 7
