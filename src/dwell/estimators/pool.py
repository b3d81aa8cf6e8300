"""Pool of known values of one part of a cycle, declared or measured.

The cell file declares the demands of a part; they apply until windows show other values. Fisher's
method of combining tests compares a window's values with the known values: each value has a place
(quantile) among them, and one test combines all places (R. A. Fisher, Statistical Methods for
Research Workers, 1925). Values of one window are often correlated, for example if the scene changes
slowly; the test allows for their correlation, measured in the undisturbed cell.
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

#: Most values that a pool holds; number of newest values that it keeps at any age.
LARGEST = 200
ENOUGH = 12
#: Deviations from chance that show another regime; fewer than the second show none.
SHIFTED, ALIKE = 4.0, 2.0
#: A run is of another regime only if the mean place of its values is above this, or below 1 - this.
MOVED = 0.75
#: Another regime deviates this many times as much, or as long, as any undisturbed stretch.
MARGIN = 1.2
#: A first job is cold (it loads data for later jobs) if it takes this many times as long as others.
COLD = 1.5
#: Deviations that show a change within a window; fewest values to look for a change.
CHANGED, LEAST = 5.0, 36


class Reference:
    """Values of a part in the undisturbed cell, milliseconds; infinite if lost.

    `values` are in the order of cycles; only the first `kept` of them stay [default: all]. Values
    in a stretch of `block` cycles may be correlated; `likeness` is their mean correlation, by
    places. `ordered` has all values, ascending; values above `patience_ms` are infinite there,
    because a window may end before they are known. `usual` is the median of the finite values,
    `lost` the share of infinite values.
    """

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
        """Compare values with the values of the undisturbed cell."""
        return PlaceSums(len(values), *places(self.ordered, values, self._patience_ms))

    def holds_nothing(self) -> HeldValues:
        """Return an empty store for values that are compared with these."""
        return HeldValues(self.ordered, self._patience_ms, self.likeness, self.block)

    def has_any(self, ordered: Floats) -> bool:
        """Whether any of some ascending values is in the range of the values here."""
        low, high = self.ordered[0], self.ordered[-1]
        return bool(ordered.searchsorted(low, "left") < ordered.searchsorted(high, "right"))

    def deviations(self, shift: PlaceSums, cycles: int) -> float:
        """Deviations from chance of values from a stretch of `cycles` cycles."""
        return shift.deviations(self.likeness, self._together(shift.size, cycles))

    def extremes(self, size: int, cycles: int, deviations: float) -> tuple[float, int]:
        """Return how far, and for how long, the undisturbed cell deviates by chance.

        Stretches of `cycles` cycles with `size` values count if they deviate by `deviations` or
        more. The first result is their largest `PlaceSums.largest` (0 without such stretches), the
        second the most cycles in a row of overlapping or adjacent stretches.
        """
        # Sizes are rounded to powers of √2: fewer searches.
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
        # The largest size that is rounded to this count; it needs the smallest mean.
        size = math.ceil(count * math.sqrt(2.0))
        together = self._together(size, size * every)
        least = _mean_log(size, deviations * _inflation(self.likeness, together))
        for logs in _logs(self.ordered, values):
            sums = np.cumsum(np.vstack((np.zeros(every), logs.reshape(-1, every))), axis=0)
            means = (sums[count:] - sums[:-count]).ravel() / count
            off = np.flatnonzero(means >= least)
            if len(off):
                # Overlapping or adjacent stretches are joined.
                ends = np.flatnonzero(np.diff(off) > span)
                lengths = off[np.append(ends, -1)] - off[np.append(0, ends + 1)]
                largest = max(largest, float(means.max()))
                longest = max(longest, int(lengths.max()) + span)
        return largest, longest

    def _together(self, size: int, cycles: int) -> float:
        """Number of values that share a block, and so may be correlated."""
        return size * min(self.block / cycles, 1.0)

    def _in_time(self, values: Floats) -> Floats:
        if self._patience_ms == math.inf:
            return values
        return np.where(values > self._patience_ms, math.inf, values)


class Pool:
    """Known values of one part, milliseconds: as declared (`reference`) or measured.

    A disturbance adds to the values of a message (`additive`) and multiplies the values of a job.
    """

    #: Time of the first job if it was the only one in its window; else 0.
    _alone: float
    _doubts: _Doubt | None

    def __init__(self, reference: Reference, additive: bool) -> None:
        self.reference, self.additive = reference, additive
        #: The held values; the kernel adds to them.
        self.rows = reference.holds_nothing()
        self._alone, self.rows.row.asks = 0.0, not additive
        self._summary = _Summary(np.empty(0), 0.0, 0.0)
        self.reset()

    def __repr__(self) -> str:
        what = "as declared" if self.is_declared else f"{self.measured} values, {self.usual:g} ms"
        return f"<Pool: {what}>"

    @property
    def held(self) -> Floats:
        """Values of the current regime, oldest first; a new array after each change."""
        return self.rows.values

    @property
    def _doubt(self) -> _Doubt | None:
        """Latest successive decisions that agree with the declared values, if any."""
        return self._doubts

    @_doubt.setter
    def _doubt(self, doubt: _Doubt | None) -> None:
        self._doubts, self.rows.row.doubts = doubt, doubt is not None

    @property
    def is_declared(self) -> bool:
        """Whether the part counts as declared; it may hold measured values."""
        return bool(self.rows.row.is_declared)

    @property
    def measured(self) -> int:
        """Number of measured values in `held`; the others have the declared shape."""
        return int(self.rows.row.measured)

    @property
    def last(self) -> int:
        """Window of the newest measured value; 0 before the first."""
        return int(self.rows.row.last)

    @property
    def touched(self) -> int:
        """Last window that began or extended the current regime; 0 if as declared."""
        return int(self.rows.row.touched)

    @property
    def usual(self) -> float:
        """Median of the finite values; infinite if all values are lost."""
        return self.reference.usual if self.is_declared else middle(self.held)

    @property
    def lost(self) -> float:
        """Share of the values that are lost."""
        return self.reference.lost if self.is_declared else self._summarised().lost

    @property
    def error_ms(self) -> float:
        """Standard error of the values' 95th percentile or of their mean, the larger of the two."""
        return self._summarised().error_ms

    def _summarised(self) -> _Summary:
        """Return the summary of the held values, computed once per change."""
        held = self.held
        if self._summary.of is not held:
            self._summary = _Summary(held, *self.rows.error())
        return self._summary

    def reset(self) -> None:
        """Return to the declared values."""
        self.rows.row.is_declared = True
        self._begin(np.empty(0), 0)

    def replace(self, values: Floats, window: int) -> None:
        """Begin another regime with values that were not measured."""
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
        """Add the values measured in a window; return whether the regime has changed.

        There is at least one value; lost values are infinite. `window` is the number of the
        decision; a value is forgotten after `memory` decisions. The values are from `cycles` cycles
        [default: one per value]. `tests` is the number of such comparisons, of all parts, per
        window of the cell.
        """
        is_first, self.rows.row.last = not self.last, window
        cycles = len(values) if cycles is None else cycles
        # Copied: the next window overwrites them.
        values = values[:: -(-len(values) // LARGEST)].copy()
        reference = self.reference
        if not self.additive and len(reference.ordered):
            values = self._without_cold(values, is_first)
        declared = reference.places(values)
        if not len(reference.values):
            # No declared value to compare with: the part never completed in the undisturbed cell.
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
        """Drop the first job if it took much longer than all others (see `COLD`)."""
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
        """Latest decisions, if any, with mostly larger, or mostly smaller, values than before."""
        row = self.rows.row
        if not row.run_cycles:
            return None
        apart = PlaceSums(row.run_size, row.run_larger, row.run_smaller, row.run_places)
        return _Doubt(self.rows.before, apart, row.run_cycles)

    def _run_before(self, cycles: int) -> _Doubt | None:
        """Return the run so far; None if it would exceed a block with this decision."""
        run = self._run
        return run if run is not None and run.cycles + cycles <= self.reference.block else None

    def _run_on(self, run: _Doubt, apart: PlaceSums, cycles: int) -> _Doubt:
        """Add values to a run; end it unless most of its values are larger, or smaller."""
        run = _Doubt(run.before, run.apart + apart, run.cycles + cycles)
        row, self.rows.before = self.rows.row, run.before
        row.run_size, (row.run_larger, row.run_smaller, row.run_places) = (
            *(run.apart.size, run.apart.sums),
        )
        row.run_cycles = run.cycles if run.apart.is_large else 0
        return run

    def _since(self, run: _Doubt, values: Floats) -> Floats:
        """Return the newest values of a run: held values, then the new `values`."""
        added = run.apart.size - len(values)
        since = np.concatenate((self.held[max(len(self.held) - added, 0) :], values))
        return since[-LARGEST:]

    def _is_over(self, values: Floats, declared: PlaceSums, cycles: int) -> bool:
        """Whether the regime is over, by the decisions that agree with the declared values."""
        reference = self.reference
        if reference.deviations(declared, cycles) >= ALIKE:
            self._doubt = None
            return False
        doubt = self._doubt or _Doubt(np.sort(self.held), PlaceSums(0, 0.0, 0.0, 0.0), 0)
        apart = doubt.apart + PlaceSums.among(values, doubt.before)
        self._doubt = _Doubt(doubt.before, apart, doubt.cycles + cycles)
        # If the regime itself has values in the declared range, a few more do not end it.
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
        """Add a window's values; return whether they, or all held values, show another regime."""
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
        """Whether all held values, with the newest window, show another regime."""
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
        """Apply the slowdown of another part, or its extra delay and losses, to this part."""
        if witness.is_declared:
            self.reset()
        elif max(self.reference.usual, witness.reference.usual) < math.inf:
            self.replace(self._as(witness), window)

    def _as(self, witness: Pool) -> Floats:
        """Return the declared values with another part's slowdown, or extra delay and losses."""
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
        """Return the declared values, scaled (jobs) or shifted (messages) to another median."""
        values, usual = self.reference.values, self.reference.usual
        if self.additive or usual <= 0:
            return np.maximum(values + (to - usual), 0.0)
        return values * (to / usual)

    def _off_declared(self) -> float:
        """Deviations from chance of all held values, against the declared values."""
        return self.reference.deviations(self._shift, self._span)

    @property
    def _span(self) -> int:
        """Number of cycles in the windows of the held values."""
        return max(int(self.rows.row.cycles), 1)

    @property
    def _shift(self) -> PlaceSums:
        row = self.rows.row
        return PlaceSums(row.size, row.larger, row.smaller, row.places)

    def _begin_anew(self, values: Floats, window: int, cycles: int) -> None:
        """Begin another regime; add values of the declared shape if it has fewer than `ENOUGH`."""
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
        """Add values; drop forgotten values, and the oldest beyond `LARGEST`."""
        self.rows.add(values, shift.sums, window, memory, cycles)


@dataclass(frozen=True, slots=True)
class PlaceSums:
    """Sums over values by their place p, from 0 to 1, among known values."""

    #: Number of values.
    size: int
    #: Sum of -log(1 - p).
    larger: float
    #: Sum of -log(p).
    smaller: float
    #: Sum of p.
    places: float

    @classmethod
    def among(cls, values: Floats, known: Floats) -> PlaceSums:
        """Compare values with known values, in ascending order."""
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
        """The three sums, without the size."""
        return self.larger, self.smaller, self.places

    @property
    def largest(self) -> float:
        """Mean of -log(1 - p) or of -log(p), the larger of the two."""
        return max(self.larger, self.smaller, 0.0) / self.size

    @property
    def is_large(self) -> bool:
        """Whether most of the values are larger, or smaller, than most known values."""
        return not 1 - MOVED <= self.places / self.size <= MOVED

    def deviations(self, likeness: float, together: float | None = None) -> float:
        """Deviations from chance by which the values are larger, or smaller, than known values.

        `together` values [default: all] are from one stretch, with mean correlation `likeness`.
        """
        size = self.size
        if not size:
            return 0.0
        # The cube root of a mean of exponential values is nearly normal (Wilson and Hilferty).
        part = 1.0 / (9.0 * size)
        off: float = (cube_root(self.largest) - (1.0 - part)) / math.sqrt(part)
        return off / _inflation(likeness, together or size)


def _inflation(likeness: float, together: float) -> float:
    """Factor by which correlation increases the standard deviation of a mean."""
    return math.sqrt(1.0 + max(together - 1.0, 0.0) * likeness)


def _mean_log(size: int, deviations: float) -> float:
    """Return the `PlaceSums.largest` of `size` independent values at `deviations`."""
    part = 1.0 / (9.0 * size)
    root = 1.0 - part + deviations * math.sqrt(part)
    return float(root * root * root)


class _Summary(NamedTuple):
    """Summary of the held values `of` (see `Pool`)."""

    of: Floats
    lost: float
    error_ms: float


class _Doubt(NamedTuple):
    """Successive decisions whose values are tested together."""

    #: Values known before these decisions, ascending.
    before: Floats
    #: Places of the decisions' values among `before`.
    apart: PlaceSums
    #: Number of cycles of these decisions.
    cycles: int


def share_error(share: float, count: int) -> float:
    """Return the standard error of a share among independent values."""
    return math.sqrt(share * (1.0 - share) / count)


def newest(values: Floats) -> int:
    """Return the index of the first value after a change within a window; 0 without a change.

    Changes after one, two or three quarters of the window are tried, by the difference of the mean
    ranks before and after; infinite values have the largest ranks.
    """
    count = len(values)
    if count < LEAST:
        return 0
    ordered = np.sort(values)
    ranks = ordered.searchsorted(values, "left") + ordered.searchsorted(values, "right")
    ends = np.array([count // 4, count // 2, 3 * count // 4])
    before = np.cumsum(ranks)[ends - 1]
    gap = before / ends - (ranks.sum() - before) / (count - ends)
    # `ranks` are twice the ranks, uniform from 0 to 2n, with variance n²/3.
    off = np.abs(gap) / (count * np.sqrt((1 / ends + 1 / (count - ends)) / 3))
    at = int(off.argmax())
    return int(ends[at]) if off[at] >= CHANGED else 0


def _likeness(ordered: Floats, values: Floats, block: int) -> float:
    """Mean correlation of two values of a stretch, from the variance of the stretches' means."""
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
    """Return -log(1 - p) and -log(p) of values by their places p among known values."""
    left, right = ordered.searchsorted(values, "left"), ordered.searchsorted(values, "right")
    places = (left + right + 1) / (2 * len(ordered) + 2)
    return -logarithms(1.0 - places), -logarithms(places)


def middle(values: Floats) -> float:
    """Return the median of the finite values; infinite if all values are lost."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else math.inf


@cache
def least_deviations(tests: float) -> float:
    """Deviations that show another regime if a window has `tests` comparisons of parts."""
    return math.sqrt(SHIFTED * SHIFTED + 2.0 * float(logarithms(np.array([tests]))[0]))
