from __future__ import annotations

import math

import pytest

from dwell.errors import PlacementError, PolicyError
from dwell.model import Placement
from dwell.policies.incumbent import CandidatePolicy, Incumbent

LOC, SO = Placement({"planning": "R2"}), Placement({"planning": "E"})
CANDIDATES = {"LOC": LOC, "SO": SO}


def test_dwell_counts_windows_since_the_last_migration() -> None:
    active = Incumbent(CANDIDATES, "LOC")
    assert [active.stay("hold").dwell for _ in range(3)] == [1, 2, 3]
    moved = active.move("SO", "migrate", {"SO": 1.0}, 0.5)
    assert (moved.placement, moved.migrated, moved.dwell, moved.delta_j) == (SO, True, 0, 0.5)
    assert (active.previous, active.name) == ("LOC", "SO")
    after = active.stay("dwell")
    assert (after.migrated, after.dwell, active.previous) == (False, 1, "SO")
    assert math.isnan(after.delta_j)


def test_somebody_else_moves_it() -> None:
    active = Incumbent(CANDIDATES, "LOC")
    active.stay("hold")
    active.adopt("SO")
    assert (active.previous, active.name, active.dwell) == ("LOC", "SO", 0)
    with pytest.raises(PolicyError, match=r"the adopted placement is 'S0'.*known: LOC, SO"):
        active.adopt("S0")


def test_candidates_place_the_same_tasks() -> None:
    assert CandidatePolicy(candidates=CANDIDATES).initial == "LOC"
    with pytest.raises(PolicyError, match="every candidate must place the same tasks"):
        CandidatePolicy(candidates={"LOC": LOC, "X": Placement({"perception": "E"})})
    with pytest.raises(PolicyError, match="candidates is empty"):
        CandidatePolicy(candidates={})
    with pytest.raises(PolicyError, match="initial is 'OFF', which is no candidate"):
        CandidatePolicy(candidates=CANDIDATES, initial="OFF")
    with pytest.raises(PlacementError):
        CandidatePolicy(candidates={"LOC": {}})  # type: ignore[dict-item]
