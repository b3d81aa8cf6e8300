"""Watchdog: whether a cell's windows show what was played for it.

A window disagrees if its V_D or L95 is further from the played one than `FACTOR` deviations. A
deviation has two parts: the standard error of what was played, and by how much windows differ
there. Windows that are compared share no cycle. After `WINDOWS` of them that disagree the model of
the cell is not trusted, until as many agree.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.prices import L95_SHARE, RATE, SETTLING, Price
from dwell.estimators.slow_processes import unseen_error

Floats: TypeAlias = NDArray[np.float64]

FACTOR, WINDOWS = 4.0, 2
#: Reason in the record of a decision.
NOT_AS_PLAYED = "seen is not what was played"


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


class Played(NamedTuple):
    """What windows come to: means, and the deviation of one window from them."""

    l95_ms: float
    violation_rate: float
    l95_deviation_ms: float
    violation_deviation: float

    @classmethod
    def of(cls, windows: Floats, price: Price, window_cycles: int) -> Played:
        """Tell it from windows that were played.

        Parameters
        ----------
        windows : float64 array, shape (n, 2)
            L95, milliseconds, and V_D of each.
        price : Price
            The same candidate as declared. Much more has been played of it, so that it knows of
            what the few windows may not have met.
        """
        count = len(windows)
        l95_ms, rate = windows.mean(axis=0).tolist()
        # Of few values the deviation is itself hardly known.
        few = (count + 1) / max(count - 1, 1)
        between = (few * windows.std(axis=0)).tolist()
        usual = math.sqrt(max(price.cycles / window_cycles - SETTLING, 1.0))
        errors = (
            max(between[0] / math.sqrt(count), L95_SHARE * l95_ms),
            max(between[1] / math.sqrt(count), unseen_error(rate, count * window_cycles), RATE),
        )
        return cls(
            l95_ms,
            rate,
            math.hypot(errors[0], max(between[0], usual * price.l95_error_ms)),
            math.hypot(errors[1], max(between[1], usual * price.violation_error)),
        )

    def agrees_with(self, seen: SeenWindow) -> bool:
        """Whether a window is within `FACTOR` deviations."""
        l95_off_ms = abs(seen.l95_ms - self.l95_ms)
        rate_off = abs(seen.violation_rate - self.violation_rate)
        return (
            l95_off_ms <= FACTOR * self.l95_deviation_ms
            and rate_off <= FACTOR * self.violation_deviation
        )


class Watchdog:
    """Compares the windows of a cell with what was played for it.

    Parameters
    ----------
    window_cycles : int
        W.

    Attributes
    ----------
    trusts : bool
        Whether the model is trusted.
    """

    def __init__(self, window_cycles: int) -> None:
        self._window_cycles = window_cycles
        self.trusts, self._against, self._last, self._places = True, 0, -1, -1

    def __repr__(self) -> str:
        return f"<Watchdog: {'' if self.trusts else 'not '}as played>"

    def is_due(self, seen: SeenWindow, places: int) -> bool:
        """Whether a window can be compared: a whole one, after all that changed.

        Parameters
        ----------
        places : int
            Counts changes of placements that matter to the cell; windows before one do not count.
        """
        if places != self._places:
            self._places, self._last = places, seen.last_cycle
        whole = self._window_cycles
        return seen.cycles >= whole and seen.last_cycle - whole >= self._last

    def compare(self, seen: SeenWindow, played: Played) -> bool:
        """Compare a window that is due; returns whether the model is trusted from now on or not."""
        self._last = seen.last_cycle
        self._against = 0 if played.agrees_with(seen) == self.trusts else self._against + 1
        if self._against < WINDOWS:
            return False
        self.trusts, self._against = not self.trusts, 0
        return True
