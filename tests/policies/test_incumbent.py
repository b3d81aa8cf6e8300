from __future__ import annotations

import math

import pytest

from dwell.errors import PlacementError, PolicyError
from dwell.model import Placement, QoS
from dwell.policies import Static

LOC, SO = Placement({"planning": "R2"}), Placement({"planning": "E"})
CANDIDATES = {"LOC": LOC, "SO": SO}
SEEN = QoS(10.0, 0.0, {"R2": 0.1, "E": 0.1})


def test_dwell_counts_windows_since_the_last_migration() -> None:
    policy = Static(candidates=CANDIDATES, initial="LOC")
    assert [policy.decide(observed=SEEN).dwell for _ in range(3)] == [1, 2, 3]
    policy.adopt("SO")
    moved = policy.decide(observed=SEEN)
    assert (moved.placement, moved.migrated, moved.dwell) == (LOC, True, 0)
    after = policy.decide(observed=SEEN)
    assert (after.migrated, after.dwell) == (False, 1)
    assert math.isnan(after.delta_j)


def test_somebody_else_moves_it() -> None:
    policy = Static(candidates=CANDIDATES, initial="LOC")
    policy.decide(observed=SEEN)
    policy.adopt("SO")
    assert policy.incumbent == "SO"
    decision, _ = policy.propose(observed=SEEN)
    assert (decision.name, decision.dwell) == ("LOC", 0)
    with pytest.raises(PolicyError, match=r"the adopted placement is 'S0'.*known: LOC, SO"):
        policy.adopt("S0")


def test_what_is_proposed_counts_once_it_is_committed() -> None:
    policy = Static(candidates=CANDIDATES, initial="LOC")
    policy.adopt("SO")
    decision, after = policy.propose(observed=SEEN)
    assert (decision.name, policy.incumbent) == ("LOC", "SO")
    policy.commit(after)
    assert policy.incumbent == "LOC"


def test_candidates_place_the_same_tasks() -> None:
    assert Static(candidates=CANDIDATES).initial == "LOC"
    with pytest.raises(PolicyError, match="every candidate must place the same tasks"):
        Static(candidates={"LOC": LOC, "X": Placement({"perception": "E"})})
    with pytest.raises(PolicyError, match="candidates is empty"):
        Static(candidates={})
    with pytest.raises(PolicyError, match="initial is 'OFF', which is no candidate"):
        Static(candidates=CANDIDATES, initial="OFF")
    with pytest.raises(PlacementError):
        Static(candidates={"LOC": {}})  # type: ignore[dict-item]
