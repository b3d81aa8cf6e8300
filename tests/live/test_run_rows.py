"""Rows of a live run: what was decided and not done, and columns that are those of the schema."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dwell.control import Controller
from dwell.live.run_rows import columns_of, decision_values, sends_shadows
from dwell.model import Problem, QoS
from dwell.record import row_of
from tests.cells.small import make_problem

PROBLEM = make_problem()


def decided(controller: Controller) -> tuple[object, ...]:
    """Have a controller decide that the cell moves from LOC; return the row of its log."""
    used = dict.fromkeys(controller.problem.fabric.nodes, 0.5)
    late = QoS(3 * controller.problem.pipeline.deadline_ms, 1.0, used)
    while not (row := (controller.decide(late, used), controller.log.decisions[-1]))[1][3]:
        assert len(controller.log.decisions) < 10
    return row[1]


def test_what_was_decided_and_not_done_is_no_migration() -> None:
    controller = Controller(PROBLEM, "latency-first")
    row = decided(controller)
    types = columns_of(controller)["decisions"]
    done = decision_values(controller, row, None, 5)
    refused = decision_values(controller, row, "nobody answered", 5)
    assert done["window"] == 5 + len(controller.log.decisions) - 1
    assert done["migrated"]
    assert not refused["migrated"]
    assert refused["placement"] == done["incumbent"] == "LOC"
    assert refused["refused"] == f"{done['placement']}: nobody answered"
    assert done["refused"] is None
    assert refused["reason"] == done["reason"]
    for values in (done, refused):
        assert list(row_of(types, values)) == [values[name] for name in types]


def test_what_is_no_number_is_null() -> None:
    controller = Controller(PROBLEM, "latency-first")
    row = [math.nan if isinstance(one, float) else one for one in decided(controller)]
    values = decision_values(controller, row, None, 0)
    assert not any(isinstance(one, float) and math.isnan(one) for one in values.values())


def test_tables_are_those_that_were_asked_for() -> None:
    controller = Controller(PROBLEM, "LOC")
    assert set(columns_of(controller)) == {"cycles", "windows", "decisions"}
    assert set(columns_of(controller, jobs=True)) > {"jobs", "processes"}


@pytest.mark.parametrize(
    ("policy", "fallbacks", "sends"),
    [("LOC", (), False), ("dtp+corrected", (), True), ("dtp+profile", ("LOC",), True)],
)
def test_shadows_are_sent_to_measure_or_to_prove(
    policy: str, fallbacks: tuple[str, ...], sends: bool
) -> None:
    settings = replace(PROBLEM.controller, fallbacks=fallbacks)
    problem: Problem = replace(PROBLEM, controller=settings)
    controller = Controller(problem, policy)
    assert sends_shadows(controller) == sends
    assert ("shadow_cycles" in columns_of(controller)["windows"]) == sends
