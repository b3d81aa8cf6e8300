"""Watchdog: a comparison of a cell's windows with their simulation.

A window disagrees if its V_D or L95 differs from the simulated value by more than `AGREES`
deviations. A deviation has two parts: the standard error of the simulated mean, and the spread of
single windows. The compared windows share no cycle. After `WINDOWS` windows in a row that disagree,
the model of the cell is not trusted until `WINDOWS` windows in a row agree.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from dwell.estimators.prices import AGREES, L95_SHARE, RATE, Price
from dwell.estimators.slow_processes import unseen_error
from dwell.model import QoS
from dwell.model.number_arrays import Floats
from dwell.model.qos import NO_ERROR

WINDOWS = 2
#: Length of the first doubt about a candidate in windows; every further doubt is twice as long.
DOUBTED = 8
#: Reasons in the record of a decision.
NOT_AS_PLAYED = "seen is not what was played"
WAS_NOT_AS_PLAYED = "windows there were not what was played"


class SeenWindow(NamedTuple):
    """Measured window of a decision.

    Parameters
    ----------
    l95_ms, violation_rate : float
    last_cycle, cycles : int
        Last cycle, and number of cycles.
    """

    l95_ms: float
    violation_rate: float
    last_cycle: int
    cycles: int


class Expected(NamedTuple):
    """Expected means of windows, and the deviation of a single window from them."""

    l95_ms: float
    violation_rate: float
    l95_deviation_ms: float
    violation_deviation: float

    @classmethod
    def of(cls, windows: Floats, price: Price, due_cycles: int) -> Expected:
        """Compute the expected values from simulated windows.

        Parameters
        ----------
        windows : float64 array, shape (n, 2)
            L95 (ms) and V_D of each window.
        price : Price
            Price of the candidate in the declared cell. It has many more windows, so it includes
            rare events.
        due_cycles : int
            Cycles of a window in which a sink is due.
        """
        count = len(windows)
        l95_ms, rate = windows.mean(axis=0).tolist()
        # A deviation from few values is uncertain, so enlarge it.
        few = (count + 1) / max(count - 1, 1)
        between = (few * windows.std(axis=0)).tolist()
        error = between[0] / math.sqrt(count), between[1] / math.sqrt(count)
        deviations = (
            max(between[0], price.l95_deviation_ms),
            max(between[1], price.violation_deviation),
        )
        return cls._of((l95_ms, rate), error, deviations, count * due_cycles)

    @classmethod
    def of_estimate(cls, qos: QoS, deviations: tuple[float, float], due_cycles: int) -> Expected:
        """Compute the expected values from an estimate and the deviations of single windows."""
        means = qos.l95_ms, qos.violation_rate
        return cls._of(means, qos.error or NO_ERROR, deviations, due_cycles)

    @classmethod
    def _of(
        cls,
        means: tuple[float, float],
        error: tuple[float, float],
        deviations: tuple[float, float],
        cycles: int,
    ) -> Expected:
        l95_ms, rate = means
        # The simulation of prices stops at these errors.
        l95_error_ms = max(error[0], L95_SHARE * l95_ms)
        rate_error = max(error[1], unseen_error(rate, cycles), RATE)
        l95_deviation_ms = math.hypot(l95_error_ms, deviations[0])
        return cls(l95_ms, rate, l95_deviation_ms, math.hypot(rate_error, deviations[1]))

    def agrees_with(self, seen: SeenWindow) -> bool:
        """Whether a window is within `AGREES` deviations."""
        l95_off_ms = abs(seen.l95_ms - self.l95_ms)
        rate_off = abs(seen.violation_rate - self.violation_rate)
        return (
            l95_off_ms <= AGREES * self.l95_deviation_ms
            and rate_off <= AGREES * self.violation_deviation
        )


class Watchdog:
    """Compares the windows of a cell with their simulation.

    Parameters
    ----------
    window_cycles : int
        W.
    after : int
        Last cycle before the first window that counts.
    trusts : bool
        Whether the model is trusted at first.

    Attributes
    ----------
    trusts : bool
        Whether the model is trusted.
    """

    def __init__(self, window_cycles: int, after: int = -1, *, trusts: bool = True) -> None:
        self._window_cycles = window_cycles
        self.trusts, self._against, self._last, self._moves = trusts, 0, after, 0

    def __repr__(self) -> str:
        return f"<Watchdog: {'' if self.trusts else 'not '}as played>"

    def is_due(self, seen: SeenWindow, moves: int = 0) -> bool:
        """Whether a window can be compared: it is complete and begins after the last move.

        Parameters
        ----------
        moves : int
            Number of moves so far that affect the cell.
        """
        if moves != self._moves:
            self._moves, self._last = moves, seen.last_cycle
        whole = self._window_cycles
        return seen.cycles >= whole and seen.last_cycle - whole >= self._last

    def compare(self, seen: SeenWindow, played: Expected) -> bool:
        """Compare a window that is due, and return whether `trusts` has changed."""
        self._last = seen.last_cycle
        self._against = 0 if played.agrees_with(seen) == self.trusts else self._against + 1
        if self._against < WINDOWS:
            return False
        self.trusts, self._against = not self.trusts, 0
        return True


class Doubts:
    """Candidates whose simulation is doubted for some windows.

    Parameters
    ----------
    window_cycles : int
        W.
    """

    def __init__(self, window_cycles: int) -> None:
        self._window_cycles = window_cycles
        #: By candidate, the last cycle of the doubt, and its length in windows.
        self._until: dict[str, int] = {}
        self._spans: dict[str, int] = {}

    def __repr__(self) -> str:
        return f"<Doubts of {', '.join(self._until) or 'nothing'}>"

    def change(self, name: str, cycle: int, *, trusts: bool) -> None:
        """Record that the model of a candidate has become trusted or not trusted at a cycle."""
        if trusts:
            self._until.pop(name, None)
            return
        self._spans[name] = 2 * self._spans.get(name, DOUBTED // 2)
        self.go_on(name, cycle)

    def go_on(self, name: str, cycle: int) -> None:
        """Record that the model of a candidate is still not trusted at a cycle."""
        self._until[name] = cycle + self._spans[name] * self._window_cycles

    def at(self, cycle: int) -> set[str]:
        """Return the doubted candidates at a cycle."""
        return {name for name, until in self._until.items() if cycle <= until}
