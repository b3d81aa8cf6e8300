"""What nodes and links go through: disturbances that come and go, merged in time."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.kernels.disturbances import LinkFault, NodeEffect, link_segments, node_changes
from dwell.kernels.on_off_intervals import OnOffIntervals, interval
from dwell.kernels.rows import LEVELS
from dwell.model.scenario import RAMP_STEPS
from tests.kernels.levels import levels_at

NODES = 3
strengths = np.arange(LEVELS) / RAMP_STEPS


@st.composite
def intervals(draw: st.DrawFn) -> OnOffIntervals:
    """Some of no length, some where the one ahead ends, several of different ones at an instant."""
    lengths = st.tuples(st.integers(0, 3), st.integers(0, 3))
    bounds = np.cumsum(draw(st.lists(lengths, max_size=12)), dtype=np.int64).reshape(-1, 2)
    levels = draw(st.lists(st.integers(1, RAMP_STEPS), min_size=12, max_size=12))
    begin, end = np.ascontiguousarray(bounds.T)
    return OnOffIntervals(begin, end, np.array(levels[: len(begin)], np.int64))


node_loads = st.builds(
    NodeEffect,
    intervals(),
    node=st.integers(0, NODES - 1),
    threads=st.integers(0, 40).map(lambda threads: np.rint(threads * strengths)),
    down=st.booleans(),
)
link_faults = st.builds(
    LinkFault,
    intervals(),
    layers=st.integers(0, 20).map(lambda layer: np.arange(LEVELS) << layer),
    arriving=st.floats(0, 1).map(lambda loss: 1 - loss * strengths),
    rate_mbps=st.floats(1, 1000).map(lambda mbps: np.where(strengths > 0, mbps, math.inf)),
    down=st.booleans(),
)


@given(st.lists(node_loads, max_size=6), st.integers(0, 60))
def test_a_node_has_the_threads_of_all_that_is_on(effects: list[NodeEffect], last_ns: int) -> None:
    expected = []
    for node in range(NODES):
        on_node = [effect for effect in effects if effect.node == node]
        cuts = {
            int(at) for effect in on_node for at in (*effect.intervals.begin, *effect.intervals.end)
        }
        for at in sorted(cut for cut in cuts if cut <= last_ns):
            levels = [int(levels_at(effect.intervals, np.array([at]))[0]) for effect in on_node]
            threads = sum(
                effect.threads[level] for effect, level in zip(on_node, levels, strict=True)
            )
            down = any(
                effect.down and level > 0 for effect, level in zip(on_node, levels, strict=True)
            )
            expected.append([at, node, int(threads), int(down)])
    assert node_changes(effects, NODES, last_ns).tolist() == sorted(expected)


@given(st.lists(link_faults, max_size=6), st.floats(1, 1000), st.floats(0, 0.9))
def test_a_link_has_the_worst_of_all_that_is_on(
    faults: list[LinkFault], rate_mbps: float, loss: float
) -> None:
    cuts = {int(at) for fault in faults for at in (*fault.intervals.begin, *fault.intervals.end)}
    segments, qualities = link_segments(faults, 7, rate_mbps, loss)
    assert segments[:, 0].tolist() == sorted({0, *cuts})
    assert set(segments[:, 1]) == {7}
    for (at, _, down, layers), (rate, lost) in zip(segments, qualities, strict=True):
        levels = [int(levels_at(fault.intervals, np.array([at]))[0]) for fault in faults]
        active = [(f, level) for f, level in zip(faults, levels, strict=True) if level > 0]
        assert down == any(fault.down for fault, _ in active)
        assert layers == np.bitwise_or.reduce([0, *(f.layers[level] for f, level in active)])
        assert rate == min([rate_mbps, *(fault.rate_mbps[level] for fault, level in active)])
        arriving = 1 - loss
        for fault, level in active:
            arriving *= fault.arriving[level]
        assert lost == 1 - arriving


def test_a_node_that_nothing_happens_to_has_no_change_and_a_link_one_segment() -> None:
    assert node_changes([], NODES, 100).shape == (0, 4)
    segments, qualities = link_segments([], 2, math.inf, 0.25)
    assert segments.tolist() == [[0, 2, 0, 0]]
    assert qualities.tolist() == [[math.inf, 0.25]]


def test_of_what_happens_at_one_instant_the_state_after_it_counts() -> None:
    """Two on the first node, one that begins where the other ends, and one on the last node."""
    one, two = np.full(LEVELS, 1.0), np.full(LEVELS, 2.0)
    effects = [
        NodeEffect(interval(10, 20), 2, one, True),
        NodeEffect(interval(20, 30), 0, two, False),
        NodeEffect(interval(10, 20), 0, one, False),
    ]
    assert node_changes(effects, NODES, 25).tolist() == [
        [10, 0, 1, 0],
        [10, 2, 1, 1],
        [20, 0, 2, 0],
        [20, 2, 0, 0],
    ]
