"""Static: the placement that never moves."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import CandidatePolicy


class Static(CandidatePolicy):
    """Keeps the cell on one candidate; every decision there is a hold.

    If the guard has moved the cell, every decision is to move back.

    Parameters
    ----------
    candidates, initial
        As in `dwell.policies.DTP`; the cell stays on `initial`.
    objective : Objective, optional
        If given, decisions record J of every estimated candidate; J has no influence.
    """

    guarded = False
    # Shadow jobs would load a placement that never moves.
    usual_estimator = "profile"

    def _decide(self, observed: QoS, estimates: Mapping[str, QoS] | None) -> tuple[Decision, None]:
        costs = self._costs(estimates)
        if self.incumbent != self.initial:
            return self._move(self.initial, "migrate", costs), None
        return self._stay("hold", costs), None
