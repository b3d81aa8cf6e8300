from __future__ import annotations

from typing import Any

import pytest
import yaml

from dwell.cellfile import load
from dwell.cellfile.study_paths import put, with_settings
from dwell.errors import ProblemError
from dwell.model import Problem
from dwell.model.dotted_paths import steps_of
from tests.cellfile.test_cell import EXAMPLE
from tests.cells.many import many

DOCUMENT: dict[str, Any] = {
    "name": "cell",
    "nodes": {"R1": {"cores": 4}, "R1.5": {"cores": 2}, "big one": {"cores": 9}},
    "links": [{"delay_ms": 1}, {"delay_ms": {"lognormal": {"mean": 1, "cv": 1}}}],
}


@pytest.mark.parametrize(
    ("path", "steps"),
    [
        ("nodes.R1.cores", ("nodes", "R1", "cores")),
        ("nodes.R1.5.cores", ("nodes", "R1.5", "cores")),
        ("nodes.big one.cores", ("nodes", "big one", "cores")),
        ("links[1].delay_ms.lognormal.cv", ("links", 1, "delay_ms", "lognormal", "cv")),
        ("links[0]", ("links", 0)),
        ("objective.caps.latency_ms", ("objective", "caps", "latency_ms")),
    ],
)
def test_paths_are_split_by_what_is_there(path: str, steps: tuple[str | int, ...]) -> None:
    assert steps_of(path, DOCUMENT) == steps


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("", "not a path"),
        (".", "not a path"),
        ("nodes.", "not a path"),
        ("links[x]", "not a path"),
        ("links[0]delay_ms", "not a path"),
        ("links.delay_ms", r"links is a list; take one of its items, as `links\[0\]`"),
        ("links[2].delay_ms", r"there is no links\[2\]; links has 2 items, from \[0\]"),
        ("nodes[0].cores", r"nodes is no list; it has no item \[0\]"),
        ("links[0].delay_ms.lognormal", r"links\[0\].delay_ms is 1; it has no key 'lognormal'"),
        ("name.first", "name is 'cell'; it has no key 'first'"),
        ("nodes.R2.cores", "the cell's nodes have no 'R2'; known: R1, R1.5, big one"),
    ],
)
def test_paths_that_lead_nowhere_are_refused(path: str, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        steps_of(path, DOCUMENT)


def test_what_is_put_changes_nothing_else() -> None:
    before = yaml.safe_dump(DOCUMENT)
    found = put(DOCUMENT, ("links", 1, "delay_ms"), 5)
    assert found["links"] == [{"delay_ms": 1}, {"delay_ms": 5}]
    assert found["nodes"] == DOCUMENT["nodes"]
    assert put(DOCUMENT, ("objective", "caps", "edge"), 1)["objective"] == {"caps": {"edge": 1}}
    assert put(DOCUMENT, (), 7) == 7
    assert yaml.safe_dump(DOCUMENT) == before


@pytest.fixture(scope="module")
def problem() -> Problem:
    return load(EXAMPLE)


def test_settings_leave_all_that_is_drawn(problem: Problem) -> None:
    found = with_settings(problem, {"controller.min_dwell": 7, "objective.caps.utilisation": 0.5})
    assert found.controller.min_dwell == 7
    assert found.objective.caps.utilisation == 0.5
    assert found.objective.weights == problem.objective.weights
    for part in ("name", "pipeline", "fabric", "candidates", "scenarios", "window_cycles"):
        assert getattr(found, part) == getattr(problem, part)


def test_settings_that_are_wrong_are_told_at_once(problem: Problem) -> None:
    with pytest.raises(ProblemError) as caught:
        with_settings(problem, {"nodes.E.cores": 3, "period_ms": 3, "controller..x": 1})
    assert [fault.path for fault in caught.value.faults] == [
        "nodes.E.cores",
        "period_ms",
        "controller..x",
    ]
    with pytest.raises(ProblemError) as caught:
        with_settings(problem, {"controller.min_dwell": -1, "objective.weights.egde": 3})
    assert {fault.path for fault in caught.value.faults} == {
        "controller.min_dwell",
        "objective.weights.egde",
    }


def test_settings_of_a_cell_of_many_candidates_leave_its_shadows_what_they_are() -> None:
    problem = many(22)
    assert with_settings(problem, {"controller.min_dwell": 7}).shadow_fraction == 1 / 21
    given = with_settings(problem, {"controller.shadow_fraction": 0.01})
    assert given.shadow_fraction == 0.01
    with pytest.raises(ProblemError, match="each of 21 alternatives"):
        with_settings(problem, {"controller.shadow_fraction": 0.05})
