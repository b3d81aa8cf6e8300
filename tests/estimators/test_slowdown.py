"""How foreign threads slow a job."""

from __future__ import annotations

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.estimators.slowdown import slowdown
from dwell.model import Node
from dwell.model.fabric import Scheduler

nodes = st.builds(
    Node, st.just("E"), st.just("edge"), st.integers(1, 64), st.sampled_from(get_args(Scheduler))
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


@given(nodes, st.integers(1, 100), st.floats(0, 1000), st.floats(0, 10))
def test_more_threads_never_slow_less(
    node: Node, threads: int, foreign: float, more: float
) -> None:
    assert slowdown(node, threads, 0.0) == 1.0
    assert 1.0 <= slowdown(node, threads, foreign) <= slowdown(node, threads, foreign + more)
