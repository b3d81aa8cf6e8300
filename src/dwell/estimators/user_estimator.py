"""Adapter from a user's estimator to the interface of the controller."""

from __future__ import annotations

import copy
from collections.abc import Mapping

from dwell.estimators.evidence import Evidence
from dwell.estimators.protocol import CellEstimator, Estimator, Learner, Support
from dwell.model.problem import Problem
from dwell.model.qos import QoS


class UserEstimator(CellEstimator):
    """A user's object, with defaults for its missing methods."""

    def __init__(self, given: Estimator) -> None:
        self._given = given
        self.learns, self.supports = isinstance(given, Learner), hasattr(given, "support")

    def __repr__(self) -> str:
        return f"<UserEstimator: {type(self._given).__name__}>"

    @property
    def given(self) -> Estimator:
        """The user's object."""
        return self._given

    def start(self, problem: Problem) -> None:
        """Start the user's object, if it has a method `start`."""
        start = getattr(self._given, "start", None)
        if start is not None:
            start(problem)
        self.shadow_fraction = getattr(self._given, "shadow_fraction", 0.0)

    def look(self, evidence: Evidence) -> None:
        """Pass a window to the user's object, if it is a `Learner`."""
        if isinstance(self._given, Learner):
            self._given.learn(evidence)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Return the estimates of the user's object."""
        return self._given.estimate(observed=observed, incumbent=incumbent, own=own)

    def support(self) -> Mapping[str, Support]:
        """Return the support of the user's object; call only if `supports` is true."""
        support: Mapping[str, Support] = self._given.support()  # type: ignore[attr-defined]
        return support


def as_started(given: Estimator, problem: Problem, *, copied: bool) -> CellEstimator:
    """Return a started estimator with the interface of the controller.

    If `copied`, start a copy, since the object may have learnt from windows since it was made.
    """
    made = copy.deepcopy(given) if copied else given
    own = made if isinstance(made, CellEstimator) else UserEstimator(made)
    # A built-in estimator starts itself when it is made.
    if copied or own is not made:
        own.start(problem)
    return own
