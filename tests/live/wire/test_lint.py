from __future__ import annotations

from dataclasses import replace

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.live.wire.lint import lint
from tests.cells.light import document
from tests.live.small_world import World, canonical


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


@pytest.mark.parametrize("cycles", [2, 3])
def test_a_guard_that_hears_links_too_seldom_is_warned_of(cycles: int) -> None:
    problem = canonical(20, guard_cycles=cycles)
    world = World(problem)
    world.run(1_000)
    heard = 0
    for _ in range(100):
        world.run(1.7)
        heard += world.stamper.guard.presence.whole("SO", world.network.now_ns)
    assert heard >= 95 or cycles == 2
    assert heard <= 30 or cycles > 2
    live = from_document({**document(), "controller": {"guard_cycles": cycles}})
    found = [str(fault) for fault in lint(live) if "guard_cycles" in str(fault)]
    assert [one.partition(": 2 is for")[0] for one in found] == (
        ["controller.guard_cycles"] * (cycles == 2)
    )
