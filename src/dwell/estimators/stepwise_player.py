"""Stepwise player: simulates candidates of a cell under measured conditions, step by step.

All candidates have the same realisation. Each simulation continues where it stopped, and its newest
steps are averaged until the conditions change.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.candidate_player import CandidatePlayer, with_windows_up_to
from dwell.estimators.declared_cell import LONGEST_WINDOW, STEP, declared_of
from dwell.estimators.present import Present
from dwell.estimators.prices import SEED, prices_of
from dwell.estimators.slow_processes import unseen_error
from dwell.kernels.advance import play
from dwell.kernels.arrays import Arrays, CellArrays
from dwell.kernels.over_age import due_misses
from dwell.kernels.sampling_errors import PAIRS, SeriesSums, Steps, tail_error_ms
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats, Ints
from dwell.model.problem import Problem
from dwell.model.qos import NO_ERROR, QoS, unchecked_qos
from dwell.model.shadow_plan import ShadowFraction
from dwell.model.stretches import share_over

#: Most steps in a candidate's price; the same while the measured demands change.
KEPT, RECENT = 24, 6
#: Least number of common steps of two candidates for the error of their difference.
LEAST_PAIRS = 3
#: Limit of the correlation of successive steps; more would be a drift.
MOST_ALIKE = 0.9


class _Twin:
    """The simulation of a candidate, and the results of its steps."""

    def __init__(self, arrays: Arrays, resources: int, kept: int) -> None:
        self.arrays = arrays
        #: Next cycle to simulate.
        self.cursor = 0
        #: Means of each step, oldest first: L95 (ms) and V_D, each followed by the mean of the same
        #: windows as declared; uncut L95; the cell's own share of every resource.
        self.steps = Steps(kept, PAIRS + 1 + resources)
        #: Mean age (ms) and price per hour of each step, each followed by its value as declared.
        self.terms = Steps(kept, PAIRS)
        #: Last cycle of each step, counted over all repetitions of the realisation.
        self.ends: deque[int] = deque(maxlen=kept)
        #: Latencies of the cycles of each step; which of the cycles with a sink missed.
        self.latency_ns: deque[Ints] = deque(maxlen=kept)
        self.missed: deque[NDArray[np.bool_]] = deque(maxlen=kept)
        self.price: QoS | None = None
        #: Whether the price's L95 and V_D are differences from declared values.
        self.is_relative = False, False

    def add(
        self,
        means: Sequence[float],
        terms: Sequence[float],
        latency_ns: Ints,
        missed: NDArray[np.bool_],
        end: int,
    ) -> None:
        """Add a step; drop the oldest beyond the most."""
        self.steps.add(means)
        self.terms.add(terms)
        self.ends.append(end)
        self.latency_ns.append(latency_ns)
        self.missed.append(missed)

    def keep(self, most: int) -> None:
        """Keep the newest `most` steps."""
        self.steps.keep(most)
        self.terms.keep(most)
        while len(self.latency_ns) > most:
            self.latency_ns.popleft()
            self.ends.popleft()
            self.missed.popleft()


class StepwisePlayer:
    """Simulates the candidates of a problem under measured conditions.

    `seed` is the seed of the declared realisation; `shadow_fraction` is the share of cycles that
    are also sent through each alternative, by simulated candidate. `prices` are the prices as
    declared; `cycles` counts the simulated cycles of all candidates.
    """

    def __init__(
        self, problem: Problem, seed: int = SEED, shadow_fraction: ShadowFraction = 0.0
    ) -> None:
        self.problem, self._seed, self._shadow_fraction = problem, seed, shadow_fraction
        self.declared = declared_of(problem, seed, shadow_fraction)
        self.prices = prices_of(problem, shadow_fraction=shadow_fraction)
        played = with_windows_up_to(LONGEST_WINDOW, problem)
        self._window = played.window_cycles
        self._names, self._resources = tuple(problem.candidates), tuple(problem.fabric.resources)
        self._step, self._censor_ms = max(STEP // self._window, 1), problem.censor_ms
        #: Standard deviations of a step's L95 (ms), V_D, mean age (ms) and price, as declared.
        self._usual = {
            name: [
                float(windows[1:].std()) / math.sqrt(self._step)
                for windows in (of.l95_ms, of.violation_rate, of.age_ms, of.price_per_hour)
            ]
            for name, of in self.declared.windows.items()
        }
        self.cycles = 0
        self._misses = misses = problem.objective.caps.misses
        self._pipeline = problem.pipeline
        #: Least number of steps with enough stretches for the cap on misses.
        self._least = 0
        if misses is not None:
            least_cycles = misses.least_cycles * problem.pipeline.due_interval
            self._least = 1 + -(-least_cycles // (self._step * self._window))
        self._kept = max(KEPT, self._least)
        self._player = CandidatePlayer(
            [(played, self.declared.realisation)],
            shadows=self.declared.shadows,
            measures=True,
        )
        self._twins: dict[str, _Twin] = {}

    def __reduce__(self) -> tuple[type[StepwisePlayer], tuple[Problem, int, ShadowFraction]]:
        # The kernel's tables have addresses; a copy starts without simulations.
        return StepwisePlayer, (self.problem, self._seed, self._shadow_fraction)

    def begin(self, present: Present) -> None:
        """Begin with other measured conditions; discard the results of earlier steps."""
        self.present, self._offset = present, 0
        first = self._player.begin({0: present})
        if not self._twins:
            first.tables.clock[0]["pauses"] = 1
            self._twins = {
                name: _Twin(self._player.tables({0: name}), len(self._resources), self._kept)
                for name in self._names
            }
        for twin in self._twins.values():
            twin.keep(0)
            twin.arrays.replace(changes=first.tables.changes)
        self._restart()

    def go_on(
        self, present: Present, names: Collection[str], steps: int = 1, *, has_grown: bool = False
    ) -> None:
        """Simulate more steps of some candidates; the measured conditions have the same parts.

        If `has_grown`, the parts have newer values, and prices use only the most recent steps.
        """
        self.present = present
        if has_grown:
            since = max(twin.cursor for twin in self._twins.values())
            self._player.grow(present, since, self._offset)
            for name in names:
                self._twins[name].keep(max(RECENT, self._least) - 1)
        fewest = min(len(self._twins[name].steps) for name in names)
        for _ in range(max(steps, self._least - fewest)):
            last = max(self._twins[name].cursor for name in names)
            cycles = self.declared.realisation.cycles
            if last + self._step * self._window > cycles:
                self._offset += cycles
                self._player.grow(present, 0, self._offset)
                self._restart()
            for name in names:
                self._play(self._twins[name], name)

    def _restart(self) -> None:
        for twin in self._twins.values():
            twin.arrays.restart(self._player.first)
            twin.cursor = 0

    def _play(self, twin: _Twin, name: str) -> None:
        first = twin.cursor // self._window
        last = first + self._step
        twin.cursor += self._step * self._window
        for _ in range(self._step):
            play(twin.arrays)
        first = max(first, 1)  # in the first window queues have not settled
        if first < last:
            windows = self._player.windows(twin.arrays, 0, first, last)
            declared = self.declared.windows[name]
            means = (
                _mean(windows.l95_ms),
                _mean(declared.l95_ms[first:last]),
                _mean(windows.missed) / _mean(windows.counted),
                _mean(declared.violation_rate[first:last]),
                _mean(windows.uncut_ms),
                *_mean_shares(windows.shares[:, 1]),
            )
            terms = (
                _mean(windows.age_ms),
                _mean(declared.age_ms[first:last]),
                _mean(windows.price_per_hour),
                _mean(declared.price_per_hour[first:last]),
            )
            cycles, tables = slice(first * self._window, twin.cursor), twin.arrays.tables
            latency_ns = tables.latency_ns[0, cycles].copy()
            played = self._pipeline, self.declared.realisation.release_ns, CellArrays(twin.arrays)
            missed = due_misses(*played, cycles)
            twin.add(means, terms, latency_ns, missed, self._offset + twin.cursor)
        twin.price = None
        self.cycles += self._step * self._window

    def played(self, name: str) -> QoS:
        """Return the means of a candidate with errors; the utilisation is the cell's own."""
        twin = self._twins[name]
        if twin.price is None:
            twin.price = self._price(name, twin)
        return twin.price

    def deviations(self, name: str) -> tuple[float, float]:
        """Return the standard deviations of one window's L95, milliseconds, and V_D."""
        price = self.prices[name]
        usual = price.l95_deviation_ms, price.violation_deviation
        if not self._twins or len(steps := self._twins[name].steps) < 2:
            return usual
        shown = np.ascontiguousarray(steps.table[:, :PAIRS:2])
        # A deviation from few values is itself uncertain.
        few = (len(steps) + 1) / (len(steps) - 1) * math.sqrt(self._step)
        l95_ms, rate = (few * shown.std(axis=0)).tolist()
        return max(l95_ms, usual[0]), max(rate, usual[1])

    def tail_error_ms(self, name: str, off: float) -> float:
        """Return the error of L95 (ms) that an error `off` of the share of lost cycles causes."""
        latency_ns = np.concatenate(self._twins[name].latency_ns)
        return tail_error_ms(latency_ns, self._censor_ms, off)

    def difference_errors(self, name: str, other: str) -> tuple[float, float]:
        """Return the errors of the differences of L95 (ms) and V_D of two simulated candidates.

        The differences are of the steps that both have, over the same cycles.
        """
        pair = name, other
        errors = [self.played(one).error or NO_ERROR for one in pair]
        twins = [self._twins[one] for one in pair]
        common = [end for end in twins[0].ends if end in twins[1].ends]
        if len(common) < LEAST_PAIRS:
            l95_ms, rate = map(math.hypot, *errors)
            return l95_ms, rate
        tables = [twin.steps.table[list(map(twin.ends.index, common))] for twin in twins]
        prices = [self.prices[one] for one in pair]
        known = [(price.l95_error_ms, price.violation_error) for price in prices]
        l95, rates = (
            _paired(
                [table[:, 2 * metric : 2 * metric + 2] for table in tables],
                [twin.is_relative[metric] for twin in twins],
                [of[metric] for of in known],
            )
            for metric in (0, 1)
        )
        few = unseen_error(rates[1], len(common) * self._step * self._window)
        return l95[0], max(rates[0], few)

    def _price(self, name: str, twin: _Twin) -> QoS:
        steps = twin.steps
        count, known = len(steps), self.prices[name]
        l95, rates, (uncut, *own) = steps.sums()
        l95_ms, l95_error_ms, l95_is_relative = _estimated(
            l95, count, known.l95_ms, known.l95_error_ms, usual=self._usual[name][0]
        )
        violation_rate, violation_error, rate_is_relative = _estimated(
            rates,
            count,
            known.violation_rate,
            known.violation_error,
            usual=self._usual[name][1],
            cycles=count * self._step * self._window,
        )
        twin.is_relative = l95_is_relative, rate_is_relative
        l95_ms = min(l95_ms, self._censor_ms)
        uncut_ms = max(uncut / count, l95_ms)
        shares = [share / count for share in own]
        age = None
        if known.age is not None:
            age = self._age(name, known.age)
        return unchecked_qos(
            l95_ms,
            min(violation_rate, 1.0),
            FrozenDict(zip(self._resources, shares, strict=True)),
            None if uncut_ms == l95_ms else uncut_ms,
            (l95_error_ms, violation_error),
            age,
            self._share_over(name),
            None,
            self._price_per_hour(name, known.price_per_hour),
        )

    def _age(self, name: str, known: tuple[float, float]) -> tuple[float, float]:
        """Return the mean age of a candidate and its error, ms."""
        steps, usual = self._twins[name].terms, self._usual[name][2]
        age_ms, error_ms, _ = _estimated(steps.sums()[0], len(steps), *known, usual=usual)
        return min(age_ms, self._censor_ms), error_ms

    def _price_per_hour(self, name: str, known: float | None) -> float | None:
        """Return the price of a candidate's bytes, money per hour, if links have prices."""
        if known is None:
            return None
        steps, usual = self._twins[name].terms, self._usual[name][3]
        return _estimated(steps.sums()[1], len(steps), known, 0.0, usual=usual)[0]

    def _share_over(self, name: str) -> float | None:
        """Return the share of a candidate's stretches with more misses than the cap."""
        if self._misses is None:
            return None
        return share_over(np.concatenate(self._twins[name].missed), self._misses)

    def is_full(self, name: str) -> bool:
        """Whether a candidate's price has the most steps."""
        return len(self._twins[name].steps) == self._kept


def _estimated(
    steps: SeriesSums,
    count: int,
    known: float,
    known_error: float,
    *,
    usual: float,
    cycles: int | None = None,
) -> tuple[float, float, bool]:
    """Return the mean over `count` steps, its standard error, and whether it is relative.

    The same realisation is also simulated as declared; longer simulations give its expected value
    `known`, with error `known_error`. If the difference between the two varies less than the
    measured conditions do, its mean is added to `known`: the mean is relative (a control variate;
    DOI 10.1287/opre.30.5.961). `usual` is the standard deviation of a step as declared, since few
    steps may vary too little; `cycles` is the number of cycles if the mean is a share of cycles.
    """
    mean, squares, products, more, more_squares, more_products, apart = steps
    if not apart:
        return known, known_error, True
    error = _error(count, mean, squares, products, usual)
    more_error = _error(count, more, more_squares, more_products)
    if cycles is not None:
        error = max(error, unseen_error(mean, cycles))
        more_error = max(more_error, unseen_error(apart / count, cycles))
    more_error = math.hypot(more_error, known_error)
    if more_error < error:
        return max(known + more, 0.0), more_error, True
    return mean, error, False


def _paired(
    tables: Sequence[Floats], are_relative: Sequence[bool], known: Sequence[float]
) -> tuple[float, float]:
    """Return the error of the difference of two means over the same steps, and its mean size.

    Parameters
    ----------
    tables : sequence of float64 array, shape (steps, 2)
        A metric of each candidate, and the same as declared.
    are_relative : sequence of bool
        Whether each mean is relative (see `_estimated`).
    known : sequence of float
        Error of the declared value of each.
    """
    one, other = (
        table[:, 0] - table[:, 1] if is_relative else table[:, 0]
        for table, is_relative in zip(tables, are_relative, strict=True)
    )
    apart = one - other
    off = apart - apart.mean()
    squares, products = float((off * off).sum()), float((off[1:] * off[:-1]).sum())
    error = _error(len(apart), float(apart.mean()), squares, products)
    declared = (of for of, is_relative in zip(known, are_relative, strict=True) if is_relative)
    return math.hypot(error, *declared), float(np.abs(apart).mean())


def _mean(windows: Floats | Ints) -> float:
    # Most steps are one window.
    return float(windows.item() if len(windows) == 1 else windows.mean())


def _mean_shares(windows: Floats) -> list[float]:
    mean: Floats = windows[0] if len(windows) == 1 else windows.mean(axis=0)
    shares: list[float] = mean.tolist()
    return shares


def _error(count: int, mean: float, squares: float, products: float, usual: float = 0.0) -> float:
    """Return the error of a mean as if one more value deviated by `usual` (see `SeriesSums`)."""
    if count < 2:
        return abs(mean)
    # A deviation from few values is itself uncertain: about Student's t over 2.
    few = (count + 1) / (count - 1)
    variance = max(squares / (count - 1), (squares + usual * usual) / count)
    factor = _correlation_factor(count, squares, products)
    return few * math.sqrt(variance / count * factor)


def _correlation_factor(count: int, squares: float, products: float) -> float:
    """Return the factor by which correlated steps of a queue increase the variance of a mean.

    It is (1 + r) / (1 - r) for an AR(1) process, where r is the correlation of successive steps.
    An estimate from n steps is 1 / n too low.
    """
    if not squares:
        return 1.0
    r = min(max(products / squares + 1.0 / count, 0.0), MOST_ALIKE)
    return (1.0 + r) / (1.0 - r)
