"""Static: the placement that never moves."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import CandidatePolicy


class Static(CandidatePolicy):
    """Wants its candidate whatever happens; every decision is a hold there.

    Where somebody else has moved the cell, every decision is for the way back.

    Parameters
    ----------
    candidates, initial
        As in `dwell.policies.DTP`; `initial` is the candidate that it stays on.
    objective : Objective, optional
        Where given, J of every estimated candidate is recorded; it decides nothing.
    """

    guarded = False
    # Shadow jobs would load a placement that never moves.
    usual_estimator = "profile"

    def _decide(self, observed: QoS, estimates: Mapping[str, QoS] | None) -> tuple[Decision, None]:
        costs = self._costs(estimates)
        if self.incumbent != self.initial:
            return self._move(self.initial, "migrate", costs), None
        return self._stay("hold", costs), None
