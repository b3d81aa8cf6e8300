"""LatencyFirst: moves to the candidate with the lowest estimated L95."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.cost import exceeds, margin, margin_errors
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import CandidatePolicy
from dwell.policies.pricing import explain_estimate


class LatencyFirst(CandidatePolicy):
    """Moves to the lowest estimated L95 in every window, with neither hysteresis nor dwell.

    FogROS2-LS (Chen et al., ICRA 2024) selects among replicas of a service in the same way. The
    rule ignores deadline, utilisation, caps and the price of a move. On a tie the incumbent wins,
    then the earlier candidate. If estimates have errors, the lowest L95 must be below the
    incumbent's by more than their `dwell.cost.margin`.

    Parameters
    ----------
    candidates, initial
        As in `dwell.policies.DTP`.
    objective : Objective, optional
        If given, decisions record J of every candidate; J has no influence.
    """

    by_price = True
    usual_estimator = "profile"

    def _decide(self, observed: QoS, estimates: Mapping[str, QoS] | None) -> tuple[Decision, None]:
        known, now = self._known(estimates), self.incumbent
        name = now
        try:
            best, lowest = name, known[name].l95_ms
            for name in self.candidates:
                latency = known[name].l95_ms
                if latency < lowest:
                    best, lowest = name, latency
        except (AttributeError, KeyError, TypeError):
            explain_estimate(known, name, self.candidates)
            raise
        costs = self._costs(known)
        here, there = known[now], known[best]
        errors = [margin_errors(one, len(self.candidates))[0] for one in (here, there)]
        if best == now or not exceeds(here.l95_ms - lowest, margin(*errors)):
            return self._stay("hold", costs), None
        return self._move(best, "migrate", costs), None
