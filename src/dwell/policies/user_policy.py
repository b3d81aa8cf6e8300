"""A user's object as the controller works with it."""

from __future__ import annotations

import copy
from collections.abc import Mapping

from dwell.errors import PolicyError
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import CandidatePolicy
from dwell.policies.protocol import MinimalPolicy, Proposer


class UserPolicy(Proposer):
    """A copy of a user's object, and what it does without.

    Parameters
    ----------
    given : policy
        An object with `decide`.

    Raises
    ------
    PolicyError
        If it has none.
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
        """Start it, if it wants to be."""
        start = getattr(self._given, "start", None)
        if start is not None:
            start(problem)
        self.initial = getattr(self._given, "initial", None)
        self.objective = getattr(self._given, "objective", None)
        self.guarded = getattr(self._given, "guarded", True)

    def propose(
        self, *, observed: QoS, estimates: Mapping[str, QoS], tentative: bool = False
    ) -> tuple[Decision | str, MinimalPolicy]:
        """Have it decide, or another copy of it."""
        acting = copy.deepcopy(self._given) if tentative else self._given
        return acting.decide(observed=observed, estimates=estimates), acting

    def commit(self, after: MinimalPolicy) -> None:
        """Go on with the copy that has decided."""
        self._given = after

    def adopt(self, name: str) -> None:
        """Tell it, if it wants to know."""
        adopt = getattr(self._given, "adopt", None)
        if adopt is not None:
            adopt(name)


def as_proposer(policy: MinimalPolicy) -> Proposer:
    """Return a copy of a policy that the controller works with."""
    # A subclass may have another `decide`.
    if isinstance(policy, CandidatePolicy) and type(policy).decide is CandidatePolicy.decide:
        return copy.deepcopy(policy)
    return UserPolicy(policy)
