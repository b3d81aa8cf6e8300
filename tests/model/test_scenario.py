"""Disturbances: where they are, and from when to when."""

from __future__ import annotations

import math

import pytest

from dwell.model import Constant, Disturbance, Episodes, LinkDisturbance, NodeDisturbance
from dwell.model.scenario import is_always_on


def test_where_and_until_when() -> None:
    node = NodeDisturbance("E", at_s=2.0, for_s=3.0)
    link = LinkDisturbance("R1", "E", at_s=2.0)
    assert (node.place, node.end_s) == ("E", 5.0)
    assert (link.place, link.end_s) == ("R1->E", math.inf)


@pytest.mark.parametrize(
    ("item", "always"),
    [
        (NodeDisturbance("E", stress_threads=1), True),
        (LinkDisturbance("R1", "E", loss=0.1), True),
        (NodeDisturbance("E", stress_threads=1, at_s=1.0), False),
        (NodeDisturbance("E", stress_threads=1, for_s=60.0), False),
        (NodeDisturbance("E", stress_threads=1, ramp_s=5.0), False),
        (
            LinkDisturbance("R1", "E", episodes=Episodes("rare", Constant(9.0), Constant(1.0))),
            False,
        ),
    ],
)
def test_what_is_always_on(item: Disturbance, *, always: bool) -> None:
    assert is_always_on(item) is always
