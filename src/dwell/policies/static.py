"""Static: the placement that never moves."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import CandidatePolicy
from dwell.policies.pricing import check_metrics


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

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS] | None = None) -> Decision:
        """Hold, or return to the candidate.

        Raises
        ------
        MetricError
            If `observed` is no QoS, or (with an objective) an estimate is missing.
        """
        check_metrics(observed, "observed")
        costs = self._costs(estimates)
        if self._incumbent.name != self.initial:
            return self._incumbent.move(self.initial, "migrate", costs)
        return self._incumbent.stay("hold", costs)
