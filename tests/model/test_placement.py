from __future__ import annotations

import pytest

from dwell.errors import PlacementError
from dwell.model import Placement

LOC = Placement({"perception": "R1", "planning": "R2"})


def test_what_moves_between_two() -> None:
    other = Placement({"planning": "R2", "perception": "E"})
    assert LOC.moved(other) == ("perception",)
    assert LOC.moved(LOC) == ()


@pytest.mark.parametrize("nodes", [{}, {"": "R1"}, {"planning": ""}, {"planning": 3}, {1: "R1"}])
def test_every_task_has_a_node(nodes: dict[str, str]) -> None:
    with pytest.raises(PlacementError):
        Placement(nodes)


def test_it_is_a_key_whatever_its_order() -> None:
    assert {LOC: 1}[Placement([("planning", "R2"), ("perception", "R1")])] == 1
    assert eval(repr(LOC)) == LOC
