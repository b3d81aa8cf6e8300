"""Watchdog: whether a cell's windows show what was played for it.

A window disagrees if its V_D or L95 is further from the played one than `AGREES` deviations. A
deviation has two parts: the standard error of what was played, and by how much windows differ
there. The compared windows share no cycle. After `WINDOWS` of them that disagree the model of
the cell is not trusted, until as many agree.
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
#: For how many windows a candidate is doubted first, after its model was not trusted.
DOUBTED = 8
#: Reasons in the record of a decision.
NOT_AS_PLAYED = "seen is not what was played"
WAS_NOT_AS_PLAYED = "windows there were not what was played"


class SeenWindow(NamedTuple):
    """What a decision looks at.

    Parameters
    ----------
    l95_ms, violation_rate : float
    last_cycle, cycles : int
        The last of its cycles, and their number.
    """

    l95_ms: float
    violation_rate: float
    last_cycle: int
    cycles: int


class Expected(NamedTuple):
    """What windows come to: means, and the deviation of one window from them."""

    l95_ms: float
    violation_rate: float
    l95_deviation_ms: float
    violation_deviation: float

    @classmethod
    def of(cls, windows: Floats, price: Price, window_cycles: int) -> Expected:
        """Tell it from windows that were played.

        Parameters
        ----------
        windows : float64 array, shape (n, 2)
            L95, milliseconds, and V_D of each.
        price : Price
            The same candidate as declared: it has many more windows, so it includes rare events.
        """
        count = len(windows)
        l95_ms, rate = windows.mean(axis=0).tolist()
        # Of few values the deviation is itself hardly known.
        few = (count + 1) / max(count - 1, 1)
        between = (few * windows.std(axis=0)).tolist()
        error = between[0] / math.sqrt(count), between[1] / math.sqrt(count)
        deviations = (
            max(between[0], price.l95_deviation_ms),
            max(between[1], price.violation_deviation),
        )
        return cls._of((l95_ms, rate), error, deviations, count * window_cycles)

    @classmethod
    def of_estimate(cls, qos: QoS, deviations: tuple[float, float], window_cycles: int) -> Expected:
        """Tell it from an estimate, and by how much windows differ."""
        means = qos.l95_ms, qos.violation_rate
        return cls._of(means, qos.error or NO_ERROR, deviations, window_cycles)

    @classmethod
    def _of(
        cls,
        means: tuple[float, float],
        error: tuple[float, float],
        deviations: tuple[float, float],
        cycles: int,
    ) -> Expected:
        l95_ms, rate = means
        # Prices are played until they are known so well.
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
    """Compares the windows of a cell with what was played for it.

    Parameters
    ----------
    window_cycles : int
        W.
    after : int
        Cycle after which windows count.
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
        """Whether a window can be compared: a whole one, after all moves.

        Parameters
        ----------
        moves : int
            How many moves there were that matter to the cell.
        """
        if moves != self._moves:
            self._moves, self._last = moves, seen.last_cycle
        whole = self._window_cycles
        return seen.cycles >= whole and seen.last_cycle - whole >= self._last

    def compare(self, seen: SeenWindow, played: Expected) -> bool:
        """Compare a window that is due; returns whether the model is trusted from now on or not."""
        self._last = seen.last_cycle
        self._against = 0 if played.agrees_with(seen) == self.trusts else self._against + 1
        if self._against < WINDOWS:
            return False
        self.trusts, self._against = not self.trusts, 0
        return True


class Doubts:
    """Candidates that are doubted.

    Parameters
    ----------
    window_cycles : int
        W.
    """

    def __init__(self, window_cycles: int) -> None:
        self._window_cycles = window_cycles
        #: Of each candidate the cycle until which it is doubted, and for how many windows.
        self._until: dict[str, int] = {}
        self._spans: dict[str, int] = {}

    def __repr__(self) -> str:
        return f"<Doubts of {', '.join(self._until) or 'nothing'}>"

    def change(self, name: str, cycle: int, *, trusts: bool) -> None:
        """Take note that the model of a candidate is trusted from a close on, or is not."""
        if trusts:
            self._until.pop(name, None)
            return
        self._spans[name] = 2 * self._spans.get(name, DOUBTED // 2)
        self.go_on(name, cycle)

    def go_on(self, name: str, cycle: int) -> None:
        """Take note of a close at which it is still not trusted."""
        self._until[name] = cycle + self._spans[name] * self._window_cycles

    def at(self, cycle: int) -> set[str]:
        """Return the candidates that are doubted at a cycle."""
        return {name for name, until in self._until.items() if cycle <= until}
