from __future__ import annotations

from dataclasses import replace

import dwell
from dwell.cellfile import from_document
from dwell.live.wire.lint import lint
from tests.cells.light import document


def test_a_grace_shorter_than_the_guard_is_warned_of() -> None:
    problem = from_document(document())
    patient = replace(
        problem,
        controller=replace(
            problem.controller, fallbacks=("LOC",), guard_cycles=3, close_grace_ms=10_000.0
        ),
    )
    assert not [fault for fault in lint(patient) if "close_grace_ms" in str(fault)]
    hasty = replace(patient, controller=replace(patient.controller, close_grace_ms=1.0))
    (found,) = (str(fault) for fault in lint(hasty) if "close_grace_ms" in str(fault))
    assert "up to 7 cycles are lost instead of 4" in found


def test_a_state_that_lags_behind_is_warned_of() -> None:
    cell = document()
    cell["tasks"]["planning"]["state_bytes"] = 9
    for after_ms in (0, 10):
        both = {"replicas": ["LOC", "SO"], "after_ms": after_ms}
        problem = from_document({**cell, "candidates": {**cell["candidates"], "BOTH": both}})
        found = [str(fault) for fault in lint(problem) if "BOTH" in str(fault)]
        assert [one.partition(": 10 is not")[0] for one in found] == (
            ["candidates.BOTH.after_ms"] * bool(after_ms)
        )


def test_a_cell_for_the_simulator_is_not_warned_of() -> None:
    assert not list(lint(dwell.load("examples/canonical.yaml")))
