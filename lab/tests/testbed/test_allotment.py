"""Which CPUs nodes get, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dwell.cellfile import from_document
from dwell.errors import LiveError
from dwell.model import FrozenDict, Problem, Quota
from dwell_lab.testbed.allotment import allot
from tests.cells.light import document


@pytest.fixture
def problem() -> Problem:
    return from_document(document())


def test_two_cpus_are_one_for_the_robots_and_one_for_the_edge(problem: Problem) -> None:
    shares = allot([problem], [0, 1])
    assert {node: share.cpus for node, share in shares.items()} == {
        "R1": (0,),
        "R2": (0,),
        "E": (1,),
    }
    assert shares["R1"].quota == Quota(0.4, 4.0)


def test_where_there_are_more_each_node_has_its_own(problem: Problem) -> None:
    shares = allot([problem], [0, 1, 2, 3])
    assert {node: share.cpus for node, share in shares.items()} == {
        "R1": (0,),
        "R2": (1,),
        "E": (3,),
    }


def test_what_does_not_fit_is_refused_with_what_would(problem: Problem) -> None:
    with pytest.raises(LiveError, match=r"all nodes need 1\.6 CPUs; 0\.6 are available"):
        allot([problem], [0])


def test_a_node_without_a_quota_takes_its_cores_whole() -> None:
    nodes = document()["nodes"]
    del nodes["R1"]["quota"]
    problem = from_document(document(nodes=nodes))
    with pytest.raises(LiveError, match=r"nodes\.R1 has no quota"):
        allot([problem], [0, 1])


def test_cells_share_a_node_that_is_the_same_in_both(problem: Problem) -> None:
    other = replace(problem, name="other")
    assert allot([problem, other], [0, 1]) == allot([problem], [0, 1])
    nodes = dict(problem.fabric.nodes)
    nodes["E"] = replace(nodes["E"], quota=Quota(0.5, 4.0))
    fabric = replace(problem.fabric, nodes=FrozenDict(nodes))
    with pytest.raises(LiveError, match=r"nodes\.E: two cells share this node"):
        allot([problem, replace(other, fabric=fabric)], [0, 1])
