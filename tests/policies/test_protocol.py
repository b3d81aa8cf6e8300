"""What a policy is: ours start and decide, and a user's has to decide and no more."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from dwell.model import QoS
from dwell.policies import MinimalPolicy, Policy
from dwell.policies.registry import REGISTRY, by_name
from tests.cells.small import make_problem


class First:
    """The least policy."""

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(iter(estimates))


@pytest.mark.parametrize("name", REGISTRY)
def test_every_policy_of_ours_can_be_started_again(name: str) -> None:
    assert isinstance(by_name(name, make_problem()), Policy)


def test_a_users_has_to_decide_and_no_more() -> None:
    assert isinstance(First(), MinimalPolicy)
    assert not isinstance(First(), Policy)
    assert not isinstance(object(), MinimalPolicy)
