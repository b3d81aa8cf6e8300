"""A problem, its document, and the problem read from that again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.cellfile import from_document, load
from dwell.errors import ProblemError
from dwell.model import (
    Constant,
    Execution,
    Fabric,
    Node,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Targets,
    Task,
    Trace,
    TraceTable,
    Weights,
)
from dwell.model.document import digest, to_document
from tests.cells.many import many
from tests.cells.strategies import problems

SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]


def _problem(exec_ms: Process) -> Problem:
    return Problem(
        name="one task",
        pipeline=Pipeline({"t": Task("t", {"n": Execution(exec_ms)})}, (), 10.0, 10.0),
        fabric=Fabric({"n": Node("n", "robot")}),
        candidates={"LOC": Placement({"t": "n"})},
        objective=Objective(Weights(), Targets(10.0), tiers={"n": "robot"}),
    )


@settings(suppress_health_check=SLOW)
@given(problems())
def test_a_document_gives_an_equal_problem(problem: Problem) -> None:
    text = json.dumps(to_document(problem), allow_nan=False)
    again = from_document(json.loads(text))
    assert again == problem
    for part in ("candidates", "scenarios"):
        assert list(getattr(again, part)) == list(getattr(problem, part))
    assert list(again.pipeline.tasks) == list(problem.pipeline.tasks)
    assert list(again.fabric.links) == list(problem.fabric.links)
    assert to_document(again) == to_document(problem)


@settings(max_examples=10, suppress_health_check=[*SLOW, HealthCheck.function_scoped_fixture])
@given(problem=problems())
def test_a_document_written_as_json_is_a_cell_file(problem: Problem, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(json.dumps(to_document(problem), indent=2), encoding="utf-8")
    assert load(path) == problem


def test_what_is_not_there_is_left_out() -> None:
    document = to_document(_problem(Constant(2)))
    assert document["tasks"]["t"]["on"]["n"]["exec_ms"] == 2
    assert "scale" not in document["tasks"]["t"]
    assert document["objective"]["caps"] == {}
    assert "tiers" not in document["objective"]
    assert "accelerators" not in document["objective"]
    assert document["dwell"] == 1


def test_a_process_without_a_word_is_refused() -> None:
    class Odd:
        expectation = 1.0

        def marginal(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
            return np.ones(size)

    with pytest.raises(ProblemError) as caught:
        to_document(_problem(cast(Process, Odd())))
    (fault,) = caught.value.faults
    assert fault.path == "tasks.t.on.n.exec_ms"
    assert "Odd" in fault.message


@given(st.lists(st.floats(0, 1e9), min_size=1, max_size=20), st.data())
def test_a_digest_tells_values_groups_and_instants(
    values: list[float], data: st.DataObject
) -> None:
    column = np.array(values)
    instants = np.arange(len(values), dtype=np.float64)

    def digest_of(values: NDArray[np.float64] = column, start: int = 0, begin_ms: float = 0) -> str:
        starts = np.array([0] if start == 0 else [0, start])
        table = TraceTable(
            "f.csv", {"a": values, "b": instants}, starts=starts, time_ms=instants + begin_ms
        )
        return digest(Trace(table, "a"))

    changed = column.copy()
    changed[data.draw(st.integers(0, len(values) - 1))] += 1
    assert digest_of() == digest_of(column.copy())
    assert digest_of() != digest_of(changed)
    assert digest_of() != digest_of(begin_ms=1)
    if len(values) > 1:
        assert digest_of() != digest_of(start=1)


@pytest.mark.parametrize("candidates", [3, 21, 22, 100])
def test_a_problem_read_again_sends_as_many_shadows(candidates: int) -> None:
    problem = many(candidates)
    again = from_document(json.loads(json.dumps(to_document(problem))))
    assert again == problem
    assert again.shadow_fraction == problem.shadow_fraction
