"""Adapter from a user's policy to the controller's interface."""

from __future__ import annotations

import copy
from collections.abc import Mapping

from dwell.errors import PolicyError
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import CandidatePolicy
from dwell.policies.protocol import MinimalPolicy, Proposer


class UserPolicy(Proposer):
    """A copy of a user's policy, with defaults for its optional methods and attributes.

    Raises PolicyError if the object has no method `decide`.
    """

    def __init__(self, given: MinimalPolicy) -> None:
        if isinstance(given, type) or not callable(getattr(given, "decide", None)):
            raise PolicyError(
                f"{given!r} is no policy: it must be an object with a method "
                "decide(observed=..., estimates=...)"
            )
        self._given = copy.deepcopy(given)

    def __repr__(self) -> str:
        return f"<UserPolicy: {type(self._given).__name__}>"

    @property
    def given(self) -> MinimalPolicy:
        """The copy that decides."""
        return self._given

    def start(self, problem: Problem) -> None:
        """Call the user's ``start``, if defined, and read the optional attributes."""
        start = getattr(self._given, "start", None)
        if start is not None:
            start(problem)
        self.initial = getattr(self._given, "initial", None)
        self.objective = getattr(self._given, "objective", None)
        self.guarded = getattr(self._given, "guarded", True)

    def propose(
        self, *, observed: QoS, estimates: Mapping[str, QoS], tentative: bool = False
    ) -> tuple[Decision | str, MinimalPolicy]:
        """Return the user's decision; a tentative decision is made by a copy."""
        acting = copy.deepcopy(self._given) if tentative else self._given
        return acting.decide(observed=observed, estimates=estimates), acting

    def commit(self, after: MinimalPolicy) -> None:
        """Replace the policy by the copy that decided."""
        self._given = after

    def adopt(self, name: str) -> None:
        """Call the user's ``adopt``, if defined."""
        adopt = getattr(self._given, "adopt", None)
        if adopt is not None:
            adopt(name)


def as_proposer(policy: MinimalPolicy) -> Proposer:
    """Return a copy of a policy with the controller's interface."""
    # A subclass with its own `decide` counts as a user's policy.
    if isinstance(policy, CandidatePolicy) and type(policy).decide is CandidatePolicy.decide:
        return copy.deepcopy(policy)
    return UserPolicy(policy)
