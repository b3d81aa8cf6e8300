"""Rows of a live run: what was decided and not done, and columns that are those of the schema."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dwell.control import Controller, Proposal
from dwell.live.roles.run_rows import columns_of, decision_values, sends_shadows
from dwell.model import Problem, QoS
from dwell.record import row_of
from tests.cells.small import make_problem

PROBLEM = make_problem()


def proposed(controller: Controller) -> Proposal:
    """Have a controller propose that the cell moves from LOC."""
    used = dict.fromkeys(controller.problem.fabric.nodes, 0.5)
    late = QoS(3 * controller.problem.pipeline.deadline_ms, 1.0, used)
    while not (proposal := controller.propose_by(late, used)).decision.migrated:
        controller.commit(proposal)
        assert len(controller.decisions) < 10
    return proposal


def test_what_was_decided_and_not_done_is_no_migration() -> None:
    done, refused = (Controller(PROBLEM, "latency-first") for _ in range(2))
    for controller in (done, refused):
        controller.looked = controller.looked._replace(window=5)
    done.commit(proposed(done))
    refused.reject(proposed(refused), "nobody answered")
    rows = [decision_values(one, one.decisions[-1]) for one in (done, refused)]
    assert rows[0]["window"] == 5 + len(done.decisions) - 1
    assert [row["migrated"] for row in rows] == [True, False]
    assert rows[1]["placement"] == rows[0]["incumbent"] == "LOC"
    assert rows[1]["refused"] == f"{rows[0]['placement']}: nobody answered"
    assert rows[0]["refused"] is None
    assert rows[1]["reason"] == rows[0]["reason"]
    types = columns_of(done)["decisions"]
    for values in rows:
        assert list(row_of(types, values)) == [values[name] for name in types]


def test_what_is_no_number_is_null() -> None:
    controller = Controller(PROBLEM, "latency-first")
    controller.commit(proposed(controller))
    row = [math.nan if isinstance(one, float) else one for one in controller.decisions[-1]]
    values = decision_values(controller, row)
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
