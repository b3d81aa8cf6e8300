"""ATP: one stage moved where thresholds ask for it and a cost of three terms agrees.

Tran et al., "Edge-Based QoS-Aware Adaptive Task Placement: A Closed-Loop Control in Multi-Robot
Systems", arXiv 2606.00552. The full text was not at hand; this is a **reconstruction** from the
abstract. What is from where:

* *Abstract*: candidate placements are scored by a cost of normalised latency, CPU utilisation and
  switching overhead over control windows of two seconds; placement is switched based on measured
  latency and utilisation thresholds.
* *The paper of DTP* (arXiv 2605.19887): a single stage moves. It also says that ATP decides by
  thresholds alone, without a cost of switching (`dwell.policies.atp_thresholds`); the abstract
  holds.
* *Ours*: thresholds open the question and the cost answers it; the weights and targets are those of
  the cell's objective, violations not among them; thresholds default to the targets; a dwell as in
  DTP.

Windows are taken together until `every_ms` is reached, max(1, round(every_ms / (W P))) of them. At
the close of the last of them, with means over them, and unless the dwell goes on:

1. *Question.* On the robot, is L95 or U_r above its threshold; offloaded, L95 or U_e (U_c where the
   objective weighs cloud nodes apart)? If not, it stays.
2. *Answer.* It moves if the other side costs less than staying::

       C(s) = a_L * L95 / L_target + a_r * U_r / U_r_target + a_e * U_e / U_e_target
              [+ a_c * U_c / U_c_target] + a_S * S

   with what was estimated of both sides, and S = 0 for staying; less by more than the
   `dwell.cost.margin` of the two, which is 0 where estimates say no errors.

At other closes it stays (``hold``, or ``dwell`` while the dwell lasts). A move, its own or somebody
else's, begins the next such windows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dwell.cost import TierUtilisation, cost_error, margin, price
from dwell.errors import MetricError
from dwell.model.bounds import EVERY_MS
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import NO_ERROR, Decision, QoS
from dwell.policies.atp_thresholds import ATPThresholds
from dwell.policies.incumbent import check_parameter


class _Shown(NamedTuple):
    """Metrics that the rule reads, observed or estimated: L95 and its error (ms), U_r, U_e, U_c.

    The error of a mean is the mean of errors: estimates of windows in a row have the same samples.
    """

    l95_ms: float
    l95_error_ms: float
    used: TierUtilisation


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
        As in `dwell.policies.ATPThresholds`; weights and targets of the objective are those of the
        cost, too.
    every_ms : float
        Time between two decisions, milliseconds; rounded to whole windows when a run starts. A
        policy that was never started decides at every close.
    """

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
        self._begin()

    def __repr__(self) -> str:
        return (
            f"ATP(initial={self.initial!r}, local={self.pair.local!r}, "
            f"offload={self.pair.offload!r}, min_dwell={self.min_dwell}, "
            f"every_ms={self.every_ms:g})"
        )

    def start(self, problem: Problem) -> None:
        """Begin again: the initial candidate, n_d = 0, and no window seen."""
        super().start(problem)
        window_ms = problem.window_cycles * problem.pipeline.period_ms
        self.every_windows = max(1, round(self.every_ms / window_ms))
        self._begin()

    def adopt(self, name: str) -> None:
        """Take over `name` as the incumbent with n_d = 0: somebody else moved the cell there."""
        super().adopt(name)
        self._begin()

    def _begin(self) -> None:
        """Forget the windows since the last decision."""
        self._observed: tuple[_Shown, ...] = ()
        self._estimated: tuple[Mapping[str, _Shown] | None, ...] = ()

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS] | None = None) -> Decision:
        """Toggle the task if a threshold asks for it and the other side costs less.

        Parameters
        ----------
        observed : QoS
            Metrics of the window under the incumbent.
        estimates : mapping of str to QoS, optional
            Metrics by candidate; needed in every window of those that a question is answered on.

        Returns
        -------
        Decision
            `costs` are J of the window, as every policy records them; `delta_j` is what moving
            saves in the three terms, NaN where no threshold asked.

        Raises
        ------
        MetricError
            If a metric, or the estimate of a candidate, is missing. Nothing has changed then.
        """
        incumbent = self._incumbent
        shown = (*self._observed, self._shown(observed))
        costs = self._costs(estimates)
        expected: Mapping[str, _Shown] | None = None
        if estimates is not None:
            expected = {name: self._shown(estimates[name]) for name in self.candidates}
        told = (*self._estimated, expected)
        dwells = incumbent.dwell < self.min_dwell
        if len(shown) < self.every_windows:
            self._observed, self._estimated = shown, told
            return incumbent.stay("dwell" if dwells else "hold", costs)
        if dwells:
            self._begin()
            return incumbent.stay("dwell", costs)
        mean = _mean(shown)
        other, over = self._question(mean.l95_ms, mean.used)
        saved, least = math.nan, 0.0
        if over:
            known = [one for one in told if one is not None]
            if len(known) < len(told):
                raise MetricError(
                    f"estimates is None in {len(told) - len(known)} of the {len(told)} windows "
                    f"decided on; give one for each of {', '.join(self.candidates)}"
                )
            here, there = (_mean([one[name] for one in known]) for name in (incumbent.name, other))
            moved = self._pricing.switching(incumbent.name)[other]
            saved = self._cost(here, 0.0) - self._cost(there, moved)
            least = margin(self._error(here), self._error(there))
        self._begin()
        if over and saved > least:
            return incumbent.move(other, "migrate", costs, saved)
        return incumbent.stay("hold", costs, saved)

    def _shown(self, qos: QoS) -> _Shown:
        used = self._pricing.used(qos)
        l95_error_ms, _ = qos.error or NO_ERROR
        return _Shown(qos.l95_ms, l95_error_ms, used)

    def _error(self, shown: _Shown) -> float:
        """Return the standard error of C."""
        return cost_error((shown.l95_error_ms, 0.0), self.objective)

    def _cost(self, shown: _Shown, switching: float) -> float:
        """C of the module's head: J without violations."""
        return price(shown.l95_ms, 0.0, *shown.used, switching, self.objective)
