"""Cells laid out for the kernel: what grows, what is shared, what is only read."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.errors import SimulationError
from dwell.kernels import arrays as laid_out
from dwell.kernels import codes
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.kernels.codes import Status
from dwell.kernels.realisation import LinkSegments
from dwell.kernels.rows import Tables
from dwell.model import Problem

CELL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
OUTPUTS = ("latency_ns", "compute_ns", "network_ns", "outcome", "closed", "seen", "shares")


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load(CELL)


def played(problem: Problem, *, windows: int = 5, scenario: str = "edge-cpu-stress") -> Tables:
    real = dwell.draw(problem, scenario=scenario, seed=3, windows=windows)
    arrays = lay_out([(problem, real)])
    arrays.tables.stamps[:] = list(problem.candidates).index("SO")
    assert play(arrays) == Status.FINISHED
    return arrays.tables


def assert_equal(found: Tables, expected: Tables) -> None:
    for name in OUTPUTS:
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


def test_a_ring_that_has_to_grow_changes_nothing(
    canonical: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = replace(canonical, pipeline=replace(canonical.pipeline, period_ms=5.0, deadline_ms=5.0))
    expected = played(slow)
    monkeypatch.setattr(laid_out, "RING_START", 1)
    found = played(slow)
    assert found.clock["n_slots"][0] > 1
    assert_equal(found, expected)


def test_the_ring_needs_no_more_places_than_cycles() -> None:
    problem = dwell.load(CELL.with_name("inner-loop.yaml"))
    late = replace(problem, controller=replace(problem.controller, order_delay_ms=1e5))
    real = dwell.draw(late, scenario="baseline", seed=1, windows=3)
    slots = lay_out([(late, real)], log_windows=True).tables.clock["n_slots"][0]
    assert real.cycles <= slots < 2 * real.cycles


def test_two_threads_may_play_one_realisation(canonical: Problem) -> None:
    expected = played(canonical, windows=40)
    real = dwell.draw(canonical, scenario="edge-cpu-stress", seed=3, windows=40)
    sides = [lay_out([(canonical, real)]) for _ in range(4)]
    for arrays in sides:
        arrays.tables.stamps[:] = list(canonical.candidates).index("SO")
    threads = [threading.Thread(target=play, args=(arrays,)) for arrays in sides]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for arrays in sides:
        assert_equal(arrays.tables, expected)


def test_segments_of_links_may_come_in_any_order(canonical: Problem) -> None:
    real = dwell.draw(canonical, scenario="network-impairment", seed=1, windows=3)
    segments = sorted(real.link_segments, key=lambda one: one.at_ns)
    mixed = replace(real, link_segments=LinkSegments.of(segments))
    sides = [lay_out([(canonical, one)]) for one in (real, mixed)]
    for arrays in sides:
        arrays.tables.stamps[:] = list(canonical.candidates).index("SO")
        play(arrays)
    assert_equal(sides[0].tables, sides[1].tables)


def test_more_than_keys_can_name_is_refused(
    canonical: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = dwell.draw(canonical, seed=1, windows=1)
    monkeypatch.setattr(codes, "MOST_FLOWS", 2)
    with pytest.raises(SimulationError, match="3 flows of a cell are more than the simulator's 2"):
        lay_out([(canonical, real)])


def test_cells_left_out_of_a_copy_change_nothing_for_the_others(canonical: Problem) -> None:
    reals = [dwell.draw(canonical, scenario="baseline", seed=3 + i, windows=4) for i in range(3)]
    kept = [0, 2]
    first, alone = (
        lay_out([(canonical, reals[i]) for i in rows], shared={"E"}) for rows in (range(3), kept)
    )
    for arrays in (first, alone):
        arrays.tables.stamps[:] = list(canonical.candidates).index("SO")
    part = first.copy()
    part.leave_out({1})
    for arrays in (part, alone):
        assert play(arrays) == Status.FINISHED
    for name in OUTPUTS:
        assert np.array_equal(getattr(part.tables, name)[kept], getattr(alone.tables, name)), name
    assert not part.tables.seen["cycles"][1].any()
