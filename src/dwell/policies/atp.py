"""ATP: moves one stage if a threshold is exceeded and a cost of three terms falls.

Tran et al., "Edge-Based QoS-Aware Adaptive Task Placement: A Closed-Loop Control in Multi-Robot
Systems", arXiv 2606.00552. The full text was not available; this is a **reconstruction** from the
abstract. Its sources:

* *Abstract*: candidate placements are scored by a cost of normalised latency, CPU utilisation and
  switching overhead over control windows of two seconds; placement is switched based on measured
  latency and utilisation thresholds.
* *The paper of DTP* (arXiv 2605.19887): a single stage moves. In that paper, ATP uses thresholds
  alone and has no cost of switching (see `dwell.policies.atp_thresholds`). Here the abstract takes
  precedence.
* *Dwell*: the order of the two tests, thresholds first and then the cost; weights and targets from
  the cell's objective, without violations; thresholds that default to the targets; a dwell as in
  DTP.

The policy averages n = max(1, round(every_ms / (d P))) consecutive decision windows, d cycles
apart. At the last of them, after the dwell, it applies two tests to the means:

1. *Thresholds.* On the robot, L95 or U_r must exceed its threshold. Offloaded, L95 or U_e must (U_c
   if the objective weighs cloud nodes separately). Otherwise the stage stays.
2. *Cost.* The stage moves if the other side costs less than staying::

       C(s) = a_L * L95 / L_target + a_r * U_r / U_r_target + a_e * U_e / U_e_target
              [+ a_c * U_c / U_c_target] + a_S * S

   C uses the estimates of both sides, with S = 0 for staying. The difference must exceed the
   `dwell.cost.margin` of the two estimates, which is 0 if they have no standard errors.

At other windows the stage stays (``hold``, or ``dwell`` during the dwell). A move by this policy or
by the guard restarts the average.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dwell.cost import TierUtilisation, cost_error, exceeds, margin, margin_errors, price
from dwell.errors import MetricError
from dwell.model.bounds import EVERY_MS
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.atp_thresholds import ATPThresholds
from dwell.policies.incumbent import CandidatePolicy, check_parameter


class _Shown(NamedTuple):
    """Metrics that the rule reads, observed or estimated: L95 and its error (ms), U_r, U_e, U_c.

    The error of a mean is the mean of errors, because consecutive estimates share their samples.
    """

    l95_ms: float
    l95_error_ms: float
    used: TierUtilisation


class _Window(NamedTuple):
    """The observed metrics of a window, and the estimates of every candidate."""

    observed: _Shown
    expected: Mapping[str, _Shown] | None


def _mean(windows: Sequence[_Shown]) -> _Shown:
    # Added one after another: from Python 3.12 on, `sum` rounds floats otherwise.
    l95_ms = l95_error_ms = robot = edge = cloud = 0.0
    for one in windows:
        l95_ms, l95_error_ms = l95_ms + one.l95_ms, l95_error_ms + one.l95_error_ms
        robot, edge, cloud = robot + one.used.robot, edge + one.used.edge, cloud + one.used.cloud
    count = len(windows)
    used = TierUtilisation(robot / count, edge / count, cloud / count)
    return _Shown(l95_ms / count, l95_error_ms / count, used)


class ATP(ATPThresholds):
    """Toggles one task by thresholds and a cost of three terms (our reconstruction).

    Parameters
    ----------
    candidates, initial, objective, local, offload, latency_ms, robot, edge, min_dwell
        As in `dwell.policies.ATPThresholds`. The cost uses the objective's weights and targets.
    every_ms : float
        Time between two decisions, milliseconds; rounded to whole windows when a run starts.
        Before `start`, the policy decides at every window.
    """

    usual_estimator = CandidatePolicy.usual_estimator

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
        local: str | None = None,
        offload: str | None = None,
        latency_ms: float | None = None,
        robot: float | None = None,
        edge: float | None = None,
        min_dwell: int = 3,
        every_ms: float = 2000.0,
    ) -> None:
        super().__init__(
            candidates=candidates,
            initial=initial,
            objective=objective,
            local=local,
            offload=offload,
            latency_ms=latency_ms,
            robot=robot,
            edge=edge,
            min_dwell=min_dwell,
        )
        self.every_ms = check_parameter("every_ms", every_ms, EVERY_MS)
        #: Windows that a decision is made on.
        self.every_windows = 1

    def __repr__(self) -> str:
        return (
            f"ATP(initial={self.initial!r}, local={self.pair.local!r}, "
            f"offload={self.pair.offload!r}, min_dwell={self.min_dwell}, "
            f"every_ms={self.every_ms:g})"
        )

    def start(self, problem: Problem) -> None:
        """Reset the policy to the initial candidate, n_d = 0 and an empty average."""
        super().start(problem)
        decision_ms = problem.decide_cycles * problem.pipeline.period_ms
        self.every_windows = max(1, round(self.every_ms / decision_ms))

    def _blank(self) -> tuple[_Window, ...]:
        return ()

    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, tuple[_Window, ...]]:
        """Toggle the task if a threshold is exceeded and the other side costs less.

        The memory holds the windows since the last decision. `costs` are J of the current window,
        as for every policy. `delta_j` is the saving in the three terms, NaN if no threshold is
        exceeded. If one is, every window of the average needs estimates.
        """
        costs = self._costs(estimates)
        expected: Mapping[str, _Shown] | None = None
        if estimates is not None:
            expected = {name: self._shown(estimates[name]) for name in self.candidates}
        windows = (*self._standing.memory, _Window(self._shown(observed), expected))
        dwells = self._standing.dwell < self.min_dwell
        if len(windows) < self.every_windows:
            return self._stay("dwell" if dwells else "hold", costs), windows
        if dwells:
            return self._stay("dwell", costs), ()
        mean = _mean([window.observed for window in windows])
        other, over = self._question(mean.l95_ms, mean.used)
        saved, least = math.nan, 0.0
        if over:
            known = [window.expected for window in windows if window.expected is not None]
            if len(known) < len(windows):
                raise MetricError(
                    f"estimates is None in {len(windows) - len(known)} of the {len(windows)} "
                    f"windows decided on; give one for each of {', '.join(self.candidates)}"
                )
            now = self.incumbent
            here, there = (_mean([one[name] for one in known]) for name in (now, other))
            moved = self._pricing.switching(now)[other]
            saved = self._cost(here, 0.0) - self._cost(there, moved)
            least = margin(self._error(here), self._error(there))
        if over and exceeds(saved, least):
            return self._move(other, "migrate", costs, saved), ()
        return self._stay("hold", costs, saved), ()

    def _shown(self, qos: QoS) -> _Shown:
        used = self._pricing.used(qos)
        l95_error_ms, *_ = margin_errors(qos, len(self.candidates))
        return _Shown(qos.l95_ms, l95_error_ms, used)

    def _error(self, shown: _Shown) -> float:
        """Return the standard error of C."""
        return cost_error((shown.l95_error_ms, 0.0), self.objective)

    def _cost(self, shown: _Shown, switching: float) -> float:
        """Return C of the module docstring: J without violations."""
        return price(shown.l95_ms, 0.0, *shown.used, switching, self.objective)
