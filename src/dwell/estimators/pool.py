"""Pool: the times of one part of a cycle in its present regime."""

from __future__ import annotations

import math
from collections import deque
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

#: Most times that a pool holds, and fewest that it keeps however old they are.
LARGEST = 400
ENOUGH = 12
#: P(new > old) outside [1 - SHIFT, SHIFT] is another regime, if there are LEAST new times and that
#: is more than so many standard deviations away from chance.
SHIFT = 0.85
LEAST = 2
LEAST_DEVIATIONS = 2.2
#: More times than these are looked up faster in order.
FEW = 24

NOTHING: Floats = np.empty(0)


class Pool:
    """Times of one part: the profile's to begin with, then the newest measured ones.

    Parameters
    ----------
    prior : float64 array, shape (n,)
        The profile's times, in no particular order; infinite where it is lost.
    additive : bool
        Whether what disturbs the part adds to its times (a message) or multiplies them (a job).
    places : float64 array, shape (m,)
        Quantile of every draw, in [0, 1), by which it is paired with those of other pools.
    normals : float64 array, shape (m,)
        Standard normal numbers that widen the draws.

    Attributes
    ----------
    ordered : float64 array
        All times, ascending.
    usual : float
        Median of the profile's times that are not lost; infinite where all are.
    measured : int
        How many of the times were measured.
    last : int
        The window that the newest measured one is from; 0 before there is any.
    touched : int
        The window in which the times last changed; 0 while they are the profile's.
    drawn : float64 array, shape (m,)
        The times that cycles are composed of (see `draw`).
    """

    __slots__ = (
        "_chunks",
        "_held",
        "_normals",
        "_places",
        "_rows",
        "_rows_of",
        "_untested",
        "_widened",
        "additive",
        "drawn",
        "last",
        "measured",
        "ordered",
        "prior",
        "touched",
        "usual",
    )

    def __init__(self, prior: Floats, additive: bool, places: Floats, normals: Floats) -> None:
        self.prior, self.additive = prior, additive
        self.usual = middle(prior)
        self.last = 0
        self._untested = NOTHING
        self._places, self._normals = places, normals
        self._rows, self._rows_of = np.empty(0, np.int64), 0
        self.drawn, self._widened = NOTHING, math.nan
        self.reset()

    def reset(self) -> None:
        """Return to the profile's times."""
        self.replace(self.prior, 0)

    def replace(self, times: Floats, window: int) -> None:
        """Begin again with times that nobody measured."""
        #: The times in the order in which they came, and how many of them each window brought.
        self._held = times
        self._chunks = deque([(window, len(times))])
        self.measured = 0
        self._change(window)

    def learn(self, times: Floats, window: int, memory: float) -> bool | None:
        """Take in the times that a window measured.

        Parameters
        ----------
        times : float64 array, shape (n,)
            At least one, infinite where it was lost.
        memory : float
            Windows after which a time is forgotten.

        Returns
        -------
        bool or None
            Whether they are of another regime: then everything older is gone. None where there are
            too few to tell; they are looked at again with the next.
        """
        self.last = window
        # A copy: a column of a window's table must not keep the table alive.
        times = times[:: -(-len(times) // LARGEST)].copy()
        tested = np.concatenate((self._untested, times)) if len(self._untested) else times
        enough = len(tested) >= LEAST
        self._untested = NOTHING if enough else tested
        if enough and self._shifted(tested):
            self._begin(tested, window)
            return True
        self._add(times, window, memory)
        return False if enough else None

    def draw(self, deviation: float) -> None:
        """Set `drawn`: times of the pool, each multiplied by a lognormal factor.

        Parameters
        ----------
        deviation : float
            Standard deviation of the factor's logarithm; 0 draws the times as they are.
        """
        if deviation == self._widened:
            return
        size = len(self.ordered)
        if size != self._rows_of:
            self._rows, self._rows_of = (self._places * size).astype(np.int64), size
        self.drawn = self.ordered.take(self._rows)
        if deviation > 0:
            self.drawn *= np.exp(deviation * self._normals)
        self._widened = deviation

    def moved(self, to: float) -> Floats:
        """The profile's times, stretched or shifted so that their median is another."""
        if self.additive or self.usual <= 0:
            return np.maximum(self.prior + (to - self.usual), 0.0)
        return self.prior * (to / self.usual)

    def _shifted(self, times: Floats) -> bool:
        """Whether times are of another regime than the pool's (Mann-Whitney statistic)."""
        old, count = self.ordered, len(times)
        if count > FEW:
            times = times.copy()
            times.sort()
        ranks = old.searchsorted(times, "left")
        ranks += old.searchsorted(times, "right")
        exceeds = int(np.add.reduce(ranks)) / (2 * count * len(old))
        if 1 - SHIFT <= exceeds <= SHIFT:
            return False
        deviation: float = ((1 / count + 1 / len(old)) / 12) ** 0.5
        return abs(exceeds - 0.5) > LEAST_DEVIATIONS * deviation

    def _begin(self, times: Floats, window: int) -> None:
        """Begin another regime; where its times are few, with the shape of the profile's."""
        new = middle(times)
        few = len(times) < ENOUGH and max(new, self.usual) < math.inf
        shape = np.sort(self.moved(new)) if few else NOTHING
        self.replace(shape[:: max(len(shape) // ENOUGH, 1)], window)
        self._add(times, window, math.inf)

    def _add(self, times: Floats, window: int, memory: float) -> None:
        """Add times, and drop the oldest: what is forgotten, and what is beyond `LARGEST`."""
        chunks, held = self._chunks, len(self._held)
        chunks.append((window, len(times)))
        size = held + len(times)
        while chunks[0][0] <= window - memory and size - chunks[0][1] >= ENOUGH:
            size -= chunks.popleft()[1]
        while size > LARGEST:
            since, count = chunks.popleft()
            left = max(count - (size - LARGEST), 0)
            size -= count - left
            if left:
                chunks.appendleft((since, left))
        # At most `LARGEST` times come at once, so that none of the new ones is dropped.
        self._held = np.concatenate((self._held[held + len(times) - size :], times))
        self.measured = min(self.measured + len(times), size)
        self._change(window)

    def _change(self, window: int) -> None:
        self.touched = window
        self.ordered = self._held.copy()
        self.ordered.sort()
        self._widened = math.nan  # nothing is drawn from these times yet


def middle(times: Floats) -> float:
    """Median of the times that are not lost; infinite where all are."""
    finite = times[np.isfinite(times)]
    return float(np.median(finite)) if len(finite) else math.inf
