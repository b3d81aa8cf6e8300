"""Pool: what is known of one part of a cycle, as declared or as it was measured.

The demands of a part are those that the cell file declares until windows show otherwise. What a
window brings is compared with what is known by Fisher's method of combining tests: of every value
its place among the known ones, all places together (R. A. Fisher, Statistical Methods for Research
Workers, 1925). Values of one window are often alike, as those of a scene that changes slowly are;
how much alike is measured in the undisturbed cell, and the test knows of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from dwell.kernels.elementary import cube_root, logarithms
from dwell.kernels.pools import HeldValues, places
from dwell.model.number_arrays import Floats

#: Most values that a pool holds, and fewest that it keeps however old they are.
LARGEST = 200
ENOUGH = 12
#: Deviations from chance that are another regime, and that are none.
SHIFTED, ALIKE = 4.0, 2.0
#: Mean place of a window's values that is another regime; of all that is held, any is.
MOVED = 0.75
#: How much more than any stretch of the undisturbed cell another regime must deviate.
MARGIN = 1.2
#: How much longer than all others a first job takes that is cold: it loads what others find.
COLD = 1.5
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
    patience_ms : float
        A value beyond counts as lost: at the end of a window it may be.

    Attributes
    ----------
    ordered : float64 array
        All values, ascending; infinite where beyond `patience_ms`.
    usual : float
        Median of those that are not lost; infinite where all are.
    lost : float
        Share of the values that are lost.
    likeness : float
        Mean correlation of two values of a stretch, by their places.
    """

    __slots__ = (
        "_extremes",
        "_in_order",
        "_patience_ms",
        "block",
        "likeness",
        "lost",
        "ordered",
        "usual",
        "values",
    )

    def __init__(
        self,
        values: Floats,
        block: int,
        kept: int | None = None,
        patience_ms: float = math.inf,
    ) -> None:
        self.values, self.block = values[:kept], block
        self.usual = middle(values)
        self.lost = float(np.isinf(values).mean()) if len(values) else 0.0
        is_late = ((values > patience_ms) & np.isfinite(values)).any()
        self._patience_ms = patience_ms if is_late else math.inf
        self._in_order = self._in_time(values)
        self.ordered = np.sort(self._in_order)
        self.likeness = _likeness(self.ordered, self._in_order, block)
        self._extremes: dict[tuple[int, int, float], tuple[float, int]] = {}

    def __repr__(self) -> str:
        return f"<Reference of {len(self.values)} values, usually {self.usual:g} ms>"

    def places(self, values: Floats) -> PlaceSums:
        """Compare values with those of the undisturbed cell."""
        return PlaceSums(len(values), *places(self.ordered, values, self._patience_ms))

    def holds_nothing(self) -> HeldValues:
        """Return room for values that are compared with these."""
        return HeldValues(self.ordered, self._patience_ms, self.likeness, self.block)

    def has_any(self, ordered: Floats) -> bool:
        """Whether any of some ascending values is between its smallest and its largest."""
        low, high = self.ordered[0], self.ordered[-1]
        return bool(ordered.searchsorted(low, "left") < ordered.searchsorted(high, "right"))

    def deviations(self, shift: PlaceSums, cycles: int) -> float:
        """Deviations from chance of values that are from a stretch of so many cycles."""
        return shift.deviations(self.likeness, self._together(shift.size, cycles))

    def extremes(self, size: int, cycles: int, deviations: float) -> tuple[float, int]:
        """Return how far the undisturbed cell deviates by so many deviations and more.

        Parameters
        ----------
        size : int
            How many values of each stretch of `cycles` are compared.

        Returns
        -------
        largest : float
            Largest `PlaceSums.largest` of any stretch; 0 where none deviates so.
        longest : int
            Cycles for which stretches go on deviating so, at most.
        """
        # Steps of √2, so that few stretches are looked at.
        count = math.isqrt(1 << ((size * size).bit_length() - 1))
        key = count, max(cycles // size, 1), deviations
        if key not in self._extremes:
            self._extremes[key] = self._search(*key)
        return self._extremes[key]

    def _search(self, count: int, every: int, deviations: float) -> tuple[float, int]:
        values = self._in_order[: len(self._in_order) // every * every]
        largest, longest, span = 0.0, 0, count * every
        if len(values) < span:
            return largest, longest
        # Of the most values that this stands for, which need deviate least.
        size = math.ceil(count * math.sqrt(2.0))
        together = self._together(size, size * every)
        least = _mean_log(size, deviations * _inflation(self.likeness, together))
        for logs in _logs(self.ordered, values):
            sums = np.cumsum(np.vstack((np.zeros(every), logs.reshape(-1, every))), axis=0)
            means = (sums[count:] - sums[:-count]).ravel() / count
            off = np.flatnonzero(means >= least)
            if len(off):
                # Stretches that overlap, or touch each other, are one.
                ends = np.flatnonzero(np.diff(off) > span)
                lengths = off[np.append(ends, -1)] - off[np.append(0, ends + 1)]
                largest = max(largest, float(means.max()))
                longest = max(longest, int(lengths.max()) + span)
        return largest, longest

    def _together(self, size: int, cycles: int) -> float:
        """How many values of a longer stretch may be alike."""
        return size * min(self.block / cycles, 1.0)

    def _in_time(self, values: Floats) -> Floats:
        if self._patience_ms == math.inf:
            return values
        return np.where(values > self._patience_ms, math.inf, values)


class Pool:
    """What is known of one part.

    Parameters
    ----------
    reference : Reference
        What it is as declared.
    additive : bool
        Whether what disturbs the part adds to its values (a message) or multiplies them (a job).
    """

    __slots__ = ("_alone", "_doubts", "_summary", "additive", "reference", "rows")

    #: The first job of all, if no other was measured in its window; else 0.
    _alone: float
    _doubts: _Doubt | None

    def __init__(self, reference: Reference, additive: bool) -> None:
        self.reference, self.additive = reference, additive
        #: What is held; the kernel adds to it.
        self.rows = reference.holds_nothing()
        self._alone, self.rows.row.asks = 0.0, not additive
        self._summary = _Summary(np.empty(0), 0.0, 0.0)
        self.reset()

    def __repr__(self) -> str:
        what = "as declared" if self.is_declared else f"{self.measured} values, {self.usual:g} ms"
        return f"<Pool: {what}>"

    @property
    def held(self) -> Floats:
        """Values of the present regime, in the order in which they came; one array per change."""
        return self.rows.values

    @property
    def _doubt(self) -> _Doubt | None:
        """Decisions since which the regime may be over."""
        return self._doubts

    @_doubt.setter
    def _doubt(self, doubt: _Doubt | None) -> None:
        self._doubts, self.rows.row.doubts = doubt, doubt is not None

    @property
    def is_declared(self) -> bool:
        """Whether it is as declared, whatever is held."""
        return bool(self.rows.row.is_declared)

    @property
    def measured(self) -> int:
        """How many of `held` were measured; others have the declared shape."""
        return int(self.rows.row.measured)

    @property
    def last(self) -> int:
        """The window that the newest measured one is from; 0 before there is any."""
        return int(self.rows.row.last)

    @property
    def touched(self) -> int:
        """The window in which it last ceased to be as declared, or got a value since; else 0."""
        return int(self.rows.row.touched)

    @property
    def usual(self) -> float:
        """Median of the values that are not lost; infinite where all are."""
        return self.reference.usual if self.is_declared else middle(self.held)

    @property
    def lost(self) -> float:
        """Share of the values that are lost."""
        return self.reference.lost if self.is_declared else self._summarised().lost

    @property
    def error_ms(self) -> float:
        """Standard error of the values' 95th percentile, and no less than of their mean."""
        return self._summarised().error_ms

    def _summarised(self) -> _Summary:
        """Return figures of the held values, computed once per change of these."""
        held = self.held
        if self._summary.of is not held:
            self._summary = _Summary(held, *self.rows.error())
        return self._summary

    def reset(self) -> None:
        """Return to what is declared."""
        self.rows.row.is_declared = True
        self._begin(np.empty(0), 0)

    def replace(self, values: Floats, window: int) -> None:
        """Begin another regime with values that nobody measured."""
        self.rows.row.is_declared = False
        self._begin(values, window)

    def learn(
        self,
        values: Floats,
        window: int,
        memory: float,
        cycles: int | None = None,
        tests: float = 1.0,
    ) -> bool:
        """Take in the values that a window measured; returns whether another regime has begun.

        Parameters
        ----------
        values : float64 array, shape (n,)
            At least one, infinite where it was lost.
        memory : float
            Windows after which a value is forgotten.
        cycles : int, optional
            Cycles of the window; as many as values where None.
        tests : float
            How often any part is compared so in a window of the cell.
        """
        is_first, self.rows.row.last = not self.last, window
        cycles = len(values) if cycles is None else cycles
        # A copy: they are overwritten by the next window's.
        values = values[:: -(-len(values) // LARGEST)].copy()
        reference = self.reference
        if not self.additive and len(reference.ordered):
            values = self._without_cold(values, is_first)
        declared = reference.places(values)
        if not len(reference.values):
            # Never came to an end where it is as declared, so that nothing can be told from it.
            was_declared, self.rows.row.is_declared = self.is_declared, False
            self._add(values, declared, window, memory, cycles)
            return was_declared
        if self.is_declared:
            return self._leave_declared(values, declared, window, memory, cycles, tests)
        if self._is_over(values, declared, cycles):
            self.reset()
            return True
        run = self._run_before(cycles) or _Doubt(np.sort(self.held), PlaceSums(0, 0.0, 0.0, 0.0), 0)
        run = self._run_on(run, PlaceSums.among(values, run.before), cycles)
        is_another = run.apart.is_large and run.apart.deviations(reference.likeness) >= SHIFTED
        if is_another and len(run.before) >= ENOUGH:
            self._begin_anew(self._since(run, values), window, run.cycles)
            return True
        self._add(values, declared, window, memory, cycles)
        return False

    def _without_cold(self, values: Floats, is_first: bool) -> Floats:
        """Drop the first job of all if it took far longer than all others."""
        usual = COLD * float(self.reference.ordered[-1])
        self.rows.row.asks = False
        if is_first and len(values) > 1:
            return values[int(values[0] > max(COLD * values[1:].max(), usual)) :]
        if self._alone > max(COLD * values.max(), usual):
            self.reset()
        self._alone = float(values[0]) if is_first else 0.0
        self.rows.row.asks = is_first
        return values

    @property
    def _run(self) -> _Doubt | None:
        """Successive decisions whose values are larger, or smaller, than most known before."""
        row = self.rows.row
        if not row.run_cycles:
            return None
        apart = PlaceSums(row.run_size, row.run_larger, row.run_smaller, row.run_places)
        return _Doubt(self.rows.before, apart, row.run_cycles)

    def _run_before(self, cycles: int) -> _Doubt | None:
        """Return the run of the decisions before; None if a stretch ends before this decision."""
        run = self._run
        return run if run is not None and run.cycles + cycles <= self.reference.block else None

    def _run_on(self, run: _Doubt, apart: PlaceSums, cycles: int) -> _Doubt:
        """Add values to a run, which goes on as long as most are larger, or smaller."""
        run = _Doubt(run.before, run.apart + apart, run.cycles + cycles)
        row, self.rows.before = self.rows.row, run.before
        row.run_size, (row.run_larger, row.run_smaller, row.run_places) = (
            *(run.apart.size, run.apart.sums),
        )
        row.run_cycles = run.cycles if run.apart.is_large else 0
        return run

    def _since(self, run: _Doubt, values: Floats) -> Floats:
        """Return the values of a run, of which the newest have not been added."""
        added = run.apart.size - len(values)
        since = np.concatenate((self.held[max(len(self.held) - added, 0) :], values))
        return since[-LARGEST:]

    def _is_over(self, values: Floats, declared: PlaceSums, cycles: int) -> bool:
        """Whether the regime is over: by all windows since its last value, where few came."""
        reference = self.reference
        if reference.deviations(declared, cycles) >= ALIKE:
            self._doubt = None
            return False
        doubt = self._doubt or _Doubt(np.sort(self.held), PlaceSums(0, 0.0, 0.0, 0.0), 0)
        apart = doubt.apart + PlaceSums.among(values, doubt.before)
        self._doubt = _Doubt(doubt.before, apart, doubt.cycles + cycles)
        # Where the regime has usual values, too, a few more of them do not end it.
        least = SHIFTED if reference.has_any(doubt.before) else ALIKE
        off = reference.deviations(apart, self._doubt.cycles)
        return off >= least or self._off_declared() < ALIKE

    def _leave_declared(
        self,
        values: Floats,
        declared: PlaceSums,
        window: int,
        memory: float,
        cycles: int,
        tests: float,
    ) -> bool:
        """Whether a window, or all that is held with it, is of another regime."""
        reference = self.reference
        # The chance of a deviation beyond x falls with exp(-x²/2).
        least = least_deviations(tests)
        none = _Doubt(reference.ordered, PlaceSums(0, 0.0, 0.0, 0.0), 0)
        run = self._run_on(self._run_before(cycles) or none, declared, cycles)
        if run.apart.is_large and reference.deviations(run.apart, run.cycles) >= least:
            largest, _ = reference.extremes(run.apart.size, run.cycles, least)
            if run.apart.largest > MARGIN * largest:
                self._begin_anew(self._since(run, values), window, run.cycles)
                return True
        self._add(values, declared, window, memory, cycles)
        return self.has_left(window, cycles, least)

    def has_left(self, window: int, cycles: int, least: float) -> bool:
        """Whether all that is held is of another regime, once a window has been added to it."""
        row = self.rows.row
        if self._off_declared() < least:
            row.lasting = 0
            return False
        row.lasting += cycles
        largest, longest = self.reference.extremes(self._shift.size, self._span, least)
        if self._shift.largest <= MARGIN * largest and row.lasting <= MARGIN * longest:
            return False
        row.is_declared, row.touched = False, window
        return True

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
        return self.reference.deviations(self._shift, self._span)

    @property
    def _span(self) -> int:
        """Cycles of the windows that what is held is from."""
        return max(int(self.rows.row.cycles), 1)

    @property
    def _shift(self) -> PlaceSums:
        row = self.rows.row
        return PlaceSums(row.size, row.larger, row.smaller, row.places)

    def _begin_anew(self, values: Floats, window: int, cycles: int) -> None:
        """Begin another regime; where its values are few, with the declared shape."""
        values = values[newest(values) :]
        new = middle(values)
        few = len(values) < ENOUGH and max(new, self.reference.usual) < math.inf
        shape = self.moved(new) if few else np.empty(0)
        self.replace(shape[:: max(len(shape) // ENOUGH, 1)][:ENOUGH], window)
        shift = self.reference.places(values)
        self._add(values, shift, window, math.inf, cycles)

    def _begin(self, values: Floats, window: int) -> None:
        self.rows.begin(values, self.reference.places(values).sums, window)
        self._doubt = None

    def _add(
        self, values: Floats, shift: PlaceSums, window: int, memory: float, cycles: int
    ) -> None:
        """Add values, and drop the oldest: what is forgotten, and what is beyond `LARGEST`."""
        self.rows.add(values, shift.sums, window, memory, cycles)


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
        return PlaceSums(
            self.size + other.size,
            self.larger + other.larger,
            self.smaller + other.smaller,
            self.places + other.places,
        )

    @property
    def sums(self) -> tuple[float, float, float]:
        """The sums alone."""
        return self.larger, self.smaller, self.places

    @property
    def largest(self) -> float:
        """Mean of -log(1 - p), or of -log(p) where it is larger."""
        return max(self.larger, self.smaller, 0.0) / self.size

    @property
    def is_large(self) -> bool:
        """Whether most of the values are larger, or smaller, than most known ones."""
        return not 1 - MOVED <= self.places / self.size <= MOVED

    def deviations(self, likeness: float, together: float | None = None) -> float:
        """Deviations from chance by which the values are larger, or smaller, than the known ones.

        Parameters
        ----------
        likeness : float
            Mean correlation of two values of a window.
        together : float, optional
            How many of them are of one stretch; all where None.
        """
        size = self.size
        if not size:
            return 0.0
        # Of a sum of exponential values, by the cube root of its mean (Wilson and Hilferty).
        part = 1.0 / (9.0 * size)
        off: float = (cube_root(self.largest) - (1.0 - part)) / math.sqrt(part)
        return off / _inflation(likeness, together or size)


def _inflation(likeness: float, together: float) -> float:
    """By how much the mean of so many values deviates more than that of independent ones."""
    return math.sqrt(1.0 + max(together - 1.0, 0.0) * likeness)


def _mean_log(size: int, deviations: float) -> float:
    """Return the `PlaceSums.largest` of so many independent values with so many deviations."""
    part = 1.0 / (9.0 * size)
    root = 1.0 - part + deviations * math.sqrt(part)
    return float(root * root * root)


class _Summary(NamedTuple):
    """Figures of the values that a pool holds.

    Parameters
    ----------
    of : float64 array
        The values.
    lost, error_ms : float
        See `Pool`.
    """

    of: Floats
    lost: float
    error_ms: float


class _Doubt(NamedTuple):
    """Successive decisions whose values are compared with known ones together.

    Parameters
    ----------
    before : float64 array
        What was known before them, ascending.
    apart : PlaceSums
        Their values among those.
    cycles : int
        Cycles that they are from.
    """

    before: Floats
    apart: PlaceSums
    cycles: int


def share_error(share: float, count: int) -> float:
    """Return the standard error of a share among independent values."""
    return math.sqrt(share * (1.0 - share) / count)


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
    logs, _ = _logs(ordered, values)
    variance = float(logs.var())
    if variance == 0.0:
        return 0.0
    means = logs[: stretches * block].reshape(stretches, block).mean(axis=1)
    inflated = float(means.var(ddof=1)) * block / variance
    return max((inflated - 1.0) / (block - 1), 0.0)


def _logs(ordered: Floats, values: Floats) -> tuple[Floats, Floats]:
    """-log(1 - p) and -log(p) of values, by their places p among known ones."""
    left, right = ordered.searchsorted(values, "left"), ordered.searchsorted(values, "right")
    places = (left + right + 1) / (2 * len(ordered) + 2)
    return -logarithms(1.0 - places), -logarithms(places)


def middle(values: Floats) -> float:
    """Median of the values that are not lost; infinite where all are."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else math.inf


@cache
def least_deviations(tests: float) -> float:
    """Deviations that are another regime, where parts are compared so many times in a window."""
    return math.sqrt(SHIFTED * SHIFTED + 2.0 * float(logarithms(np.array([tests]))[0]))
