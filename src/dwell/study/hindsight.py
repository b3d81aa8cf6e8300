"""Hindsight: an estimator with the exact metrics of every candidate, one window late.

At the end of a window it looks up the latencies of the same cycles in the static runs of all
candidates on the same realisation, and computes the metrics that the controller would have seen.
The loss of a rule with this estimator is due to the rule and to decisions one window late. Any
further loss with a real estimator is due to the estimate.

A real estimator may do better for a rule that uses one window: hindsight includes the random
fluctuation of that window; an estimate over several windows averages it.

The metrics are exact, except utilisation if windows do not begin with the windows of the static
runs (after a migration whose order took time, or arrived after the next release). Utilisation is
then the mean over the overlapping windows, weighted by their overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.control.windows import missed_cycles, seen_l95_ms
from dwell.errors import SimulationError
from dwell.estimators import Evidence
from dwell.model import FrozenDict, Problem, QoS
from dwell.model.number_arrays import Floats, Ints

if TYPE_CHECKING:
    from dwell.record import Run


@dataclass(frozen=True, slots=True)
class _Alone:
    """Windows of a candidate's static run.

    Parameters
    ----------
    release_ns, latency_ns : int64 array, shape (cycles,)
    over_age : bool array, shape (cycles,)
        Whether each cycle has missed by the age of a chain, but not by its latency.
    first : int64 array, shape (windows,)
        First cycle of every window.
    used : dict of str to float64 array, shape (windows,)
        Utilisation of each resource in every window.
    open_ns : int64 array, shape (windows + 1,)
        Begin of every window, and the end of the last.
    busy_ns : dict of str to float64 array, shape (windows + 1,)
        Cumulative busy time of each resource at these instants, as for a single core.
    """

    release_ns: Ints
    latency_ns: Ints
    over_age: NDArray[np.bool_]
    first: Ints
    used: dict[str, Floats]
    open_ns: Ints
    busy_ns: dict[str, Floats]

    def utilisation(self, first: int, open_ns: int, close_ns: int) -> dict[str, float]:
        """Utilisation of each resource in the window that begins with cycle `first`."""
        window = int(np.searchsorted(self.first, first))
        if window < len(self.first) and self.first[window] == first:
            return {node: float(used[window]) for node, used in self.used.items()}
        at_ns, span_ns = np.array([open_ns, close_ns]), float(close_ns - open_ns)
        return {
            node: min(float(np.diff(np.interp(at_ns, self.open_ns, busy_ns))[0]) / span_ns, 1.0)
            for node, busy_ns in self.busy_ns.items()
        }


class Hindsight:
    """Estimates every candidate by its metrics in the same cycles of its static run.

    Parameters
    ----------
    statics : mapping of str to Run, optional
        Static run of every candidate, on the realisation to simulate. Without them, `of` must set
        them before the simulation; a study does so for every realisation.
    """

    def __init__(self, statics: Mapping[str, Run] | None = None) -> None:
        self._alone = {name: _alone(run) for name, run in (statics or {}).items()}
        self._seen: dict[str, QoS] = {}

    def __repr__(self) -> str:
        return "Hindsight()"

    def of(self, statics: Mapping[str, Run]) -> Hindsight:
        """Return the estimator for the realisation of some static runs."""
        return Hindsight(statics)

    def start(self, problem: Problem) -> None:
        """Take the deadline and the censoring of the problem to simulate.

        Raises
        ------
        SimulationError
            If the static run of a candidate is missing.
        ProblemError
            If the cell is not supported (see `Problem.require_simple`).
        """
        problem.require_simple("estimates in hindsight")
        missing = [name for name in problem.candidates if name not in self._alone]
        if missing:
            raise SimulationError(
                f"hindsight knows no run of {', '.join(missing)} alone; a study gives it those, "
                "and elsewhere `Hindsight(statics)` does"
            )
        self._deadline_ns = problem.pipeline.deadline_ns
        self._censor_ms, self._width = problem.censor_ms, problem.window_cycles
        self._candidates = tuple(problem.candidates)

    def learn(self, evidence: Evidence) -> None:
        """Look up the last W cycles in the static runs."""
        last_ns, close_ns = int(evidence.release_ns[-1]), evidence.close_ns
        self._seen = {
            name: self._metrics(self._alone[name], last_ns, close_ns) for name in self._candidates
        }

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Return the metrics of every candidate's static run in the window (see `Estimator`)."""
        return dict(self._seen)

    def _metrics(self, alone: _Alone, last_ns: int, close_ns: int) -> QoS:
        end = int(np.searchsorted(alone.release_ns, last_ns)) + 1
        first = max(end - self._width, 0)
        release_ns, latency_ns = alone.release_ns[first:end], alone.latency_ns[first:end]
        age_ns = close_ns - release_ns
        l95_ms, uncut_ms = seen_l95_ms(latency_ns, age_ns, self._censor_ms)
        missed = int(missed_cycles(latency_ns, age_ns, self._deadline_ns))
        missed += int(np.count_nonzero(alone.over_age[first:end]))
        used = alone.utilisation(first, int(release_ns[0]), close_ns)
        return QoS(float(l95_ms), missed / len(release_ns), FrozenDict(used), float(uncut_ms))


def _alone(run: Run) -> _Alone:
    """Return the arrays of a static run."""
    windows, cycles = run.arrays("windows"), run.arrays("cycles")
    release_ns, first = cycles["release_ns"], windows["first_cycle"]
    # The tables do not include the release that ends the last window. Its length is assumed to be
    # the same as the length of the previous window.
    opened = release_ns[first]
    last = 2 * opened[-1] - opened[-2] if len(opened) > 1 else release_ns[-1]
    open_ns = np.append(opened, last)
    span_ns = np.diff(open_ns)
    used = {name.removeprefix("u_"): windows[name] for name in windows if name.startswith("u_")}
    busy_ns = {
        name: np.concatenate(([0.0], np.cumsum(shares * span_ns))) for name, shares in used.items()
    }
    latency_ns = cycles["latency_ns"]
    over_age = cycles["missed"] & (latency_ns <= run.problem.pipeline.deadline_ns)
    return _Alone(release_ns, latency_ns, over_age, first, used, open_ns, busy_ns)
