"""A user's object as the controller works with it."""

from __future__ import annotations

import copy
from collections.abc import Mapping

from dwell.estimators.evidence import Evidence
from dwell.estimators.protocol import CellEstimator, Estimator, Learner, Support
from dwell.model.problem import Problem
from dwell.model.qos import QoS


class UserEstimator(CellEstimator):
    """A user's object, and what it does without.

    Parameters
    ----------
    given : Estimator
        An object with `estimate`.
    """

    def __init__(self, given: Estimator) -> None:
        self._given = given
        self.learns, self.supports = isinstance(given, Learner), hasattr(given, "support")

    def __repr__(self) -> str:
        return f"<UserEstimator: {type(self._given).__name__}>"

    @property
    def given(self) -> Estimator:
        """The object that estimates."""
        return self._given

    def start(self, problem: Problem) -> None:
        """Start it, if it wants to be."""
        start = getattr(self._given, "start", None)
        if start is not None:
            start(problem)
        self.shadow_fraction = getattr(self._given, "shadow_fraction", 0.0)

    def look(self, evidence: Evidence) -> None:
        """Have it learn, if it does."""
        if isinstance(self._given, Learner):
            self._given.learn(evidence)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Have it estimate."""
        return self._given.estimate(observed=observed, incumbent=incumbent, own=own)

    def support(self) -> Mapping[str, Support]:
        """Ask it, if it knows."""
        support: Mapping[str, Support] = self._given.support()  # type: ignore[attr-defined]
        return support


def as_started(given: Estimator, problem: Problem, *, copied: bool) -> CellEstimator:
    """Return an estimator that the controller works with, at the begin of a run.

    Parameters
    ----------
    copied : bool
        Whether to start a copy: the object may have seen windows since it was made.
    """
    made = copy.deepcopy(given) if copied else given
    own = made if isinstance(made, CellEstimator) else UserEstimator(made)
    # One of ours starts itself when it is made.
    if copied or own is not made:
        own.start(problem)
    return own
