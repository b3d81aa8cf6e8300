"""The cell that faults befall: valid, within its quotas, and at home where it wants to be."""

from __future__ import annotations

import pytest
import yaml

import dwell
from dwell.cellfile import from_document
from dwell.model import Problem
from dwell_lab.chaos.light_cell import CANDIDATES, EXEC_MS, PATIENT_MS, document


def cell(home: str, **more: object) -> Problem:
    text = yaml.safe_dump(document(home, **more))  # type: ignore[arg-type]
    return from_document(yaml.safe_load(text))


@pytest.mark.parametrize("home", EXEC_MS)
def test_its_controller_stays_at_home(home: str) -> None:
    problem = cell(home)
    assert (problem.initial, set(problem.candidates)) == (home, set(CANDIDATES))
    run = dwell.simulate(problem, seed=1, windows=60)
    assert set(run.windows["placement"]) == {home}
    assert not run.cycles["missed"].any()


@pytest.mark.parametrize("home", EXEC_MS)
def test_its_work_is_within_its_quotas(home: str) -> None:
    problem = cell(home, quotas=True, period_ms=PATIENT_MS)
    for placement in problem.candidates.values():
        for name, node in problem.fabric.nodes.items():
            busy_ms = sum(
                task.on[name].exec_ms.expectation
                for task in problem.pipeline.tasks.values()
                if placement[task.name] == name
            )
            assert node.quota is not None
            assert busy_ms < node.capacity * PATIENT_MS


def test_a_standby_is_for_what_can_run_nowhere_else() -> None:
    with_, without = cell("SO"), cell("SO", standby=False)
    spare = {
        name: [on.standby for on in task.on.values()] for name, task in with_.pipeline.tasks.items()
    }
    assert spare == {"sensing": [1], "perception": [0, 0], "planning": [0, 0], "control": [1]}
    assert not any(
        on.standby for task in without.pipeline.tasks.values() for on in task.on.values()
    )
