"""The tracking error, sampled evenly in time from the world's records."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from examples.visual_servoing.servoing.error_sampler import (
    REACH_NS,
    SAMPLE_NS,
    SAMPLES,
    ErrorSampler,
)
from examples.visual_servoing.servoing.scene import Scene, axes
from examples.visual_servoing.servoing.world import Motion, World, Worth

S = 1_000_000_000
STILL = (0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World.create(tmp_path / "world", Scene(), 0)


def test_every_sample_is_the_error_at_its_instant(world: World) -> None:
    stretch_ns = SAMPLES * SAMPLE_NS
    sampler = ErrorSampler(world, 2 * S)
    sampler.sample(2 * S + stretch_ns)
    told = sampler.told(origin_ns=S)
    assert told["begin_s"] == 1.0
    assert told["step_s"] == stretch_ns / S
    squares = [world.errors(2 * S + i * SAMPLE_NS)[0] ** 2 for i in range(SAMPLES)]
    assert told["rms_mm"] == [pytest.approx(math.sqrt(sum(squares) / SAMPLES), abs=1e-4)]


def test_who_looks_late_sees_the_past_as_it_was(world: World) -> None:
    prompt, late = ErrorSampler(world, 2 * S), ErrorSampler(world, 2 * S)
    prompt.sample(3 * S)
    # From here on the arm is where it ought to be: that says nothing of what was before.
    there = axes(world.scene.wanted(3 * S))
    world.write(Motion(3 * S, there, STILL, STILL), Worth())
    late.sample(3 * S)
    assert late.told(0) == prompt.told(0)
    late.sample(3 * S + SAMPLE_NS)
    assert late.newest()[0] < prompt.newest()[0]


def test_what_nobody_looked_at_in_time_is_not_known(world: World) -> None:
    sampler = ErrorSampler(world, 2 * S)
    sampler.sample(2 * S + 2 * REACH_NS)
    told = sampler.told(0)
    values = told["rms_mm"]
    assert isinstance(values, list)
    assert values[0] is None
    assert values[-1] > 0


def test_before_it_begins_nothing_is_known(world: World) -> None:
    sampler = ErrorSampler(world, 2 * S)
    sampler.sample(S)
    assert math.isnan(sampler.newest()[0])
    assert sampler.told(0)["rms_px"] == []
