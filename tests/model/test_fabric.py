"""Fabric: which nodes and links there can be."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from dwell.errors import ProblemError
from dwell.model import Bursts, Constant, Fabric, Link, Node, Quota

BURSTS = Bursts(Constant(1.0), Constant(1.0), threads=1, add_delay_ms=Constant(1.0))


def test_bursts_have_a_share_of_the_time_and_threads_in_the_mean() -> None:
    bursts = Bursts(Constant(300.0), Constant(100.0), threads=2)
    assert bursts.share == 0.25
    assert Node("E", "edge", bursts=bursts).burst_threads == 0.5
    assert Node("E", "edge").burst_threads == 0.0


@pytest.mark.parametrize(
    ("make", "path", "words"),
    [
        (lambda: Fabric({}), "nodes", "at least one"),
        (lambda: Fabric({"R": Node("E", "edge")}), "nodes.R", "named as its key, 'R'"),
        (
            lambda: Fabric({"R": Node("R", "edge")}, {"x": Link("R", "E", Constant(1))}),
            "links.x",
            "'R->E' is not allowed",
        ),
        (lambda: Node("R", "rover"), "tier", "robot, edge, cloud"),  # type: ignore[arg-type]
        (lambda: Node("R", "robot", cores=1.5), "cores", "a whole number"),  # type: ignore[arg-type]
        (lambda: Node("R", "robot", bursts=BURSTS), "bursts.add_delay_ms", "only a link"),
        (lambda: Link("R", "E", Constant(1), bursts=BURSTS), "bursts.threads", "only a node"),
        (lambda: Link("R", "R", Constant(1)), "to", "another node"),
        (lambda: Link("R", "E", Constant(1), rate_mbps=1e-9), "rate_mbps", "at least 0.0001"),
        (lambda: Bursts(Constant(0), Constant(1)), "every_ms", "0 is not allowed"),
        (lambda: Quota(0.0, 10.0), "quota.cpu", "0 is not allowed"),
        (lambda: Quota(1.0, 10.0, tick_ms=1e-4), "quota.tick_ms", "0, or 0.001 at least"),
        (lambda: Node("R", "robot", background=1.0), "background", "less than 1"),
    ],
)
def test_what_a_constructor_refuses(make: Callable[[], object], path: str, words: str) -> None:
    with pytest.raises(ProblemError) as caught:
        make()
    (fault,) = caught.value.faults
    assert fault.path == path
    assert words in fault.message


def test_a_quota_is_what_a_node_can_do_where_it_has_fewer_cores_worth() -> None:
    assert Node("R", "robot", cores=4).capacity == 4
    assert Node("R", "robot", cores=4, quota=Quota(1.5, 10.0)).capacity == 1.5
    assert Node("R", "robot", cores=1, quota=Quota(1.5, 10.0)).capacity == 1.0
