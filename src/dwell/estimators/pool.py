"""Pool: what is known of one part of a cycle, as declared or as it was measured.

The demands of a part are those that the cell file declares until windows show otherwise. What a
window brings is compared with what is known by Fisher's method of combining tests: of every value
its place among the known ones, all places together (R. A. Fisher, Statistical Methods for Research
Workers, 1925). Values of one window are often alike, as those of a scene that changes slowly are;
how much alike is measured in the undisturbed cell, and the test knows of it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.elementary import cube_root, logarithms
from dwell.kernels.meter import places

Floats: TypeAlias = NDArray[np.float64]

#: Most values that a pool holds, and fewest that it keeps however old they are.
LARGEST = 200
ENOUGH = 12
#: Deviations from chance that are another regime; that are none, where what is declared is taken
#: back; and that tell new values from measured ones there.
SHIFTED, ALIKE, APART = 4.0, 2.0, 2.0
#: Mean place of a window's values that is another regime; of all that is held, any is.
MOVED = 0.75
#: Deviations that are a change within a window, of at least so many values.
CHANGED, LEAST = 5.0, 36


class Reference:
    """Values of a part in the undisturbed cell.

    Parameters
    ----------
    values : float64 array, shape (n,)
        In the order of cycles, `block` of them from each stretch; infinite where lost.
    block : int
        Cycles of a stretch, whose values may be alike.
    kept : int, optional
        Number of first values that are kept as `values`; all where None.

    Attributes
    ----------
    ordered : float64 array
        All values, ascending.
    usual : float
        Median of those that are not lost; infinite where all are.
    likeness : float
        Mean correlation of two values of a stretch, by their places.
    """

    __slots__ = ("likeness", "ordered", "usual", "values")

    def __init__(self, values: Floats, block: int, kept: int | None = None) -> None:
        self.values = values[:kept]
        self.ordered = np.sort(values)
        self.usual = middle(values)
        self.likeness = _likeness(self.ordered, values, block)

    def __repr__(self) -> str:
        return f"<Reference of {len(self.values)} values, usually {self.usual:g} ms>"


class Pool:
    """What is known of one part.

    Parameters
    ----------
    reference : Reference
        What it is as declared.
    additive : bool
        Whether what disturbs the part adds to its values (a message) or multiplies them (a job).

    Attributes
    ----------
    held : float64 array
        Values that were measured, in the order in which they came; those of the present regime.
    is_declared : bool
        Whether it is as declared, whatever is held.
    measured : int
        How many of `held` were measured; others have the declared shape.
    last : int
        The window that the newest measured one is from; 0 before there is any.
    touched : int
        The window in which it last ceased to be as declared, or got another value since; 0 while it
        is as declared.
    """

    __slots__ = (
        "_chunks",
        "_shift",
        "additive",
        "held",
        "is_declared",
        "last",
        "measured",
        "reference",
        "touched",
    )

    def __init__(self, reference: Reference, additive: bool) -> None:
        self.reference, self.additive = reference, additive
        self.last = 0
        self.reset()

    def __repr__(self) -> str:
        what = "as declared" if self.is_declared else f"{self.measured} values, {self.usual:g} ms"
        return f"<Pool: {what}>"

    @property
    def usual(self) -> float:
        """Median of the values that are not lost; infinite where all are."""
        return self.reference.usual if self.is_declared else middle(self.held)

    @property
    def lost(self) -> float:
        """Share of the values that are lost."""
        held = self.reference.ordered if self.is_declared else self.held
        return float(np.isinf(held).mean()) if len(held) else 0.0

    @property
    def error_ms(self) -> float:
        """Standard error of what the values take in the mean."""
        known = self.held[np.isfinite(self.held)]
        if len(known) < 2:
            return 0.0
        return float(known.std()) / math.sqrt(max(self.measured, 1))

    def reset(self) -> None:
        """Return to what is declared."""
        self.is_declared = True
        self._begin(np.empty(0), 0)
        self.touched = 0

    def replace(self, values: Floats, window: int) -> None:
        """Begin another regime with values that nobody measured."""
        self.is_declared = False
        self._begin(values, window)

    def learn(self, values: Floats, window: int, memory: float) -> bool:
        """Take in the values that a window measured; returns whether another regime has begun.

        Parameters
        ----------
        values : float64 array, shape (n,)
            At least one, infinite where it was lost.
        memory : float
            Windows after which a value is forgotten.
        """
        self.last = window
        # A copy: they are overwritten by the next window's.
        values = values[:: -(-len(values) // LARGEST)].copy()
        reference = self.reference
        declared = PlaceSums.among(values, reference.ordered)
        if not len(reference.values):
            # Never came to an end where it is as declared, so that nothing can be told from it.
            is_first, self.is_declared = self.is_declared, False
            self._add(values, declared, window, memory)
            return is_first
        off = declared.deviations(reference.likeness)
        if self.is_declared:
            if off >= SHIFTED and declared.is_large:
                self._begin_anew(values, window)
                return True
            self._add(values, declared, window, memory)
            if self._off_declared() < SHIFTED:
                return False
            self.is_declared, self.touched = False, window
            return True
        apart = PlaceSums.among(values, np.sort(self.held))
        if off < ALIKE and (
            apart.deviations(reference.likeness) >= APART or self._off_declared() < ALIKE
        ):
            self.reset()
            return True
        is_another = apart.is_large and apart.deviations(reference.likeness) >= SHIFTED
        if is_another and len(self.held) >= ENOUGH:
            self._begin_anew(values, window)
            return True
        self._add(values, declared, window, memory)
        return False

    def follow(self, witness: Pool, window: int) -> None:
        """Be otherwise as another part is: so many times its usual values, or so much more."""
        if witness.is_declared:
            self.reset()
        elif max(self.reference.usual, witness.reference.usual) < math.inf:
            self.replace(self._as(witness), window)

    def _as(self, witness: Pool) -> Floats:
        """The declared values, with the extra delay and the losses, or the slowdown, of another."""
        values, usual, now = self.reference.values, witness.reference.usual, witness.usual
        if not self.additive:
            return values * (now / usual) if usual > 0 and now < math.inf else values
        if now < math.inf:
            values = values + max(now - usual, 0.0)
        lost = witness.lost - float(np.isinf(values).mean())
        if lost > 0:
            values = values.copy()
            finite = np.flatnonzero(np.isfinite(values))
            values[finite[: round(lost * len(values))]] = np.inf
        return values

    def moved(self, to: float) -> Floats:
        """The declared values, stretched or shifted so that their median is another."""
        values, usual = self.reference.values, self.reference.usual
        if self.additive or usual <= 0:
            return np.maximum(values + (to - usual), 0.0)
        return values * (to / usual)

    def _off_declared(self) -> float:
        """Deviations by which all that is held is not as declared."""
        together = max(chunk.shift.size for chunk in self._chunks)
        return self._shift.deviations(self.reference.likeness, together)

    def _begin_anew(self, values: Floats, window: int) -> None:
        """Begin another regime; where its values are few, with the declared shape."""
        values = values[newest(values) :]
        new = middle(values)
        few = len(values) < ENOUGH and max(new, self.reference.usual) < math.inf
        shape = self.moved(new) if few else np.empty(0)
        self.replace(shape[:: max(len(shape) // ENOUGH, 1)][:ENOUGH], window)
        self._add(values, PlaceSums.among(values, self.reference.ordered), window, math.inf)

    def _begin(self, values: Floats, window: int) -> None:
        self.held = values
        self._shift = PlaceSums.among(values, self.reference.ordered)
        self._chunks = deque([_Chunk(window, self._shift)])
        self.measured, self.touched = 0, window

    def _add(self, values: Floats, shift: PlaceSums, window: int, memory: float) -> None:
        """Add values, and drop the oldest: what is forgotten, and what is beyond `LARGEST`."""
        chunks = self._chunks
        chunks.append(_Chunk(window, shift))
        total = self._shift + shift
        while (
            chunks[0].window <= window - memory and total.size - chunks[0].shift.size >= ENOUGH
        ) or total.size > LARGEST:
            total = total - chunks.popleft().shift
        self._shift = total
        self.held = np.concatenate((self.held, values))[-total.size :]
        self.measured = min(self.measured + len(values), total.size)
        if not self.is_declared:
            self.touched = window


@dataclass(frozen=True, slots=True)
class PlaceSums:
    """How values lie among known ones.

    Parameters
    ----------
    size : int
        How many they are.
    larger, smaller, places : float
        Sums of -log(1 - p), of -log(p), and of p, their places among the known ones.
    """

    size: int
    larger: float
    smaller: float
    places: float

    @classmethod
    def among(cls, values: Floats, known: Floats) -> PlaceSums:
        """Compare values with known ones, which ascend."""
        return cls(len(values), *places(known, values))

    def __add__(self, other: PlaceSums) -> PlaceSums:
        return self._with(other, 1)

    def __sub__(self, other: PlaceSums) -> PlaceSums:
        return self._with(other, -1)

    def _with(self, other: PlaceSums, sign: int) -> PlaceSums:
        return PlaceSums(
            self.size + sign * other.size,
            self.larger + sign * other.larger,
            self.smaller + sign * other.smaller,
            self.places + sign * other.places,
        )

    @property
    def is_large(self) -> bool:
        """Whether most of the values are larger, or smaller, than most known ones."""
        return not 1 - MOVED <= self.places / self.size <= MOVED

    def deviations(self, likeness: float, together: int | None = None) -> float:
        """Deviations from chance by which the values are larger, or smaller, than the known ones.

        Parameters
        ----------
        likeness : float
            Mean correlation of two values of a window.
        together : int, optional
            How many of them are of one window at most; all where None.
        """
        size = self.size
        if not size:
            return 0.0
        # Of a sum of exponential values, by the cube root of its mean (Wilson and Hilferty).
        part = 1.0 / (9.0 * size)
        largest = max(self.larger, self.smaller, 0.0) / size
        off: float = (cube_root(largest) - (1.0 - part)) / math.sqrt(part)
        return off / math.sqrt(1.0 + ((together or size) - 1) * likeness)


class _Chunk(NamedTuple):
    """What a window has brought."""

    window: int
    shift: PlaceSums


def newest(values: Floats) -> int:
    """Return the first of a window's values since its last change, if there was one; else 0.

    The quarters before and after a change differ in their ranks; infinite values are the largest.
    """
    count = len(values)
    if count < LEAST:
        return 0
    ordered = np.sort(values)
    ranks = ordered.searchsorted(values, "left") + ordered.searchsorted(values, "right")
    ends = np.array([count // 4, count // 2, 3 * count // 4])
    before = np.cumsum(ranks)[ends - 1]
    gap = before / ends - (ranks.sum() - before) / (count - ends)
    # Twice the ranks have four times the variance of a uniform distribution over them.
    off = np.abs(gap) / (count * np.sqrt((1 / ends + 1 / (count - ends)) / 3))
    at = int(off.argmax())
    return int(ends[at]) if off[at] >= CHANGED else 0


def _likeness(ordered: Floats, values: Floats, block: int) -> float:
    """Mean correlation of two values of a stretch: by how much their mean place varies more."""
    stretches = len(values) // block
    if stretches < 2 or block < 2 or ordered[0] == ordered[-1]:
        return 0.0
    left, right = ordered.searchsorted(values, "left"), ordered.searchsorted(values, "right")
    logs = -logarithms(1.0 - (left + right + 1) / (2 * len(ordered) + 2))
    variance = float(logs.var())
    if variance == 0.0:
        return 0.0
    means = logs[: stretches * block].reshape(stretches, block).mean(axis=1)
    inflated = float(means.var(ddof=1)) * block / variance
    return max((inflated - 1.0) / (block - 1), 0.0)


def middle(values: Floats) -> float:
    """Median of the values that are not lost; infinite where all are."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else math.inf
