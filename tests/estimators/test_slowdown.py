"""How foreign threads slow a job, by hand and there and back."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.estimators.slowdown import explaining_threads, slowdown
from dwell.model import Node
from dwell.model.fabric import SCHEDULERS

nodes = st.builds(
    Node, st.just("E"), st.just("edge"), st.integers(1, 64), st.sampled_from(SCHEDULERS)
)


@pytest.mark.parametrize(
    ("scheduler", "threads", "foreign", "factor"),
    [
        # Four cores: a job of one thread does not feel three others.
        ("fair", 1, 3, 1.0),
        ("fair", 1, 4, 1.25),
        ("fair", 4, 4, 2.0),
        # Alone, a job of eight threads takes twice its time already; that is the profile's.
        ("fair", 8, 4, 1.5),
        ("fifo", 1, 3, 1.75),
        ("priority", 4, 4, 2.0),
        ("fifo", 1, 0, 1.0),
        ("fifo", 8, 4, 2.0),
    ],
)
def test_by_hand(scheduler: str, threads: int, foreign: float, factor: float) -> None:
    node = Node("E", "edge", 4, scheduler)  # type: ignore[arg-type]
    assert slowdown(node, threads, foreign) == factor


@given(nodes, st.integers(1, 100), st.floats(0, 1000))
def test_what_explains_a_slowdown_causes_it(node: Node, threads: int, foreign: float) -> None:
    factor = slowdown(node, threads, foreign)
    explained = explaining_threads(node, threads, factor)
    assert factor >= 1.0
    assert slowdown(node, threads, explained) == pytest.approx(factor)
    # The fewest that do.
    assert explained <= foreign * (1 + 1e-9) + 1e-9


@given(nodes, st.integers(1, 100), st.floats(0, 1.0))
def test_what_is_not_slow_needs_no_explanation(node: Node, threads: int, factor: float) -> None:
    assert explaining_threads(node, threads, factor) == 0.0
