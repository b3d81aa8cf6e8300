from __future__ import annotations

import math

import pytest

from dwell.errors import ProblemError
from dwell.model import Caps, Objective, Targets, Weights


def test_a_weight_may_be_0_but_not_all_of_them() -> None:
    assert Weights(latency=0).violations == 3.0
    with pytest.raises(ProblemError, match="all weights are 0"):
        Weights(0, 0, 0, 0, 0)
    with pytest.raises(ProblemError, match=r"weights\.edge.*-1"):
        Weights(edge=-1)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, 1e10])
def test_a_target_is_a_divisor(value: float) -> None:
    with pytest.raises(ProblemError, match=r"targets\.robot"):
        Targets(30.0, robot=value)


def test_without_caps_nothing_is_over_one() -> None:
    assert Caps() == Caps(math.inf, math.inf)
    with pytest.raises(ProblemError, match=r"caps\.latency_ms"):
        Caps(latency_ms=0)


def test_cloud_nodes_that_weigh_apart_need_a_target() -> None:
    with pytest.raises(ProblemError, match=r"targets\.cloud.*missing"):
        Objective(Weights(cloud=0.1), Targets(30.0))
    apart = Objective(Weights(cloud=0.1), Targets(30.0, cloud=0.5), tiers={"C": "cloud"})
    assert apart.tiers["C"] == "cloud"
    with pytest.raises(ProblemError, match="one of robot, edge, cloud"):
        Objective(Weights(), Targets(30.0), tiers={"R1": "moon"})  # type: ignore[dict-item]
    counted = Objective(Weights(), Targets(30.0), accelerators={"E.gpu": "edge"})
    assert counted.accelerators == {"E.gpu": "edge"}
