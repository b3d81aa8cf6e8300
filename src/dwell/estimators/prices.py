"""Prices of candidates: mean QoS over the windows of a cell that stays on one candidate.

The kernel simulates every candidate alone, as `simulate` does with a policy that never moves: with
queues, links and overlapping cycles. All candidates have the same realisation, so only the places
of their tasks differ. The simulation grows until the means are precise enough (`L95_SHARE`,
`RATE`) and every slow process has had its full effect (`dwell.estimators.slow_processes`), or
until `MOST_CYCLES` or `MOST_EVENTS` are reached. Its length depends on counts and values alone, so
a price is a fixed number. Traces wrap. Shadow jobs are simulated if they can delay a candidate's
own jobs (`dwell.estimators.sent_shadows`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.candidate_player import (
    CandidatePlayer,
    PlayedWindows,
    with_windows_up_to,
)
from dwell.estimators.remembered import Remembered
from dwell.estimators.sent_shadows import SentShadows, hindered
from dwell.estimators.slow_processes import mean_and_error, slow_processes, unseen_error
from dwell.kernels.arrays import Arrays, CellArrays
from dwell.kernels.codes import CycleOutcome
from dwell.kernels.over_age import due_misses
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model.frozen import FrozenDict
from dwell.model.instants import NEVER_NS, longest_run
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import order_statistic_of_smallest
from dwell.model.problem import Problem
from dwell.model.qos import NO_AGE, QoS
from dwell.model.scenario import Scenario
from dwell.model.shadow_plan import ShadowFraction, by_candidate
from dwell.model.stretches import share_over

SEED = 20_250_601
#: Standard errors to reach: of L95 as a share of it, and of V_D.
L95_SHARE, RATE = 0.01, 0.0025
#: Deviations from the mean within which a window agrees with the price.
AGREES = 4.0
#: In one of this many pairs of successive windows, both may deviate more than `AGREES` allows.
RARE = 300
#: Longest simulation of a candidate.
MOST_CYCLES, MOST_EVENTS = 100_000, 10_000_000
#: Windows at the start in which queues settle, which do not count; counted windows of the first
#: simulation; fewest windows with a scenario, the default length of a run.
SETTLING, FIRST, DISTURBED = 5, 20, 300
#: Errors by which the means of the two halves of the windows may differ.
UNSETTLED = 3.0
#: Factor on the windows that seem necessary, since the error is itself an estimate.
AMPLE = 1.2
#: Number of questions whose prices are kept.
KEPT = 512
#: Longest simulated window, cycles.
LONGEST_WINDOW = 4_000


@dataclass(frozen=True, slots=True)
class Price:
    """Means over the windows of a cell that stays on one candidate, with standard errors.

    The deviation of one window (`l95_deviation_ms`, `violation_deviation`) is the largest of three:
    the standard deviation of the windows; the error of the mean, which includes slow processes,
    scaled to one window; the deviation with which at most one in `RARE` pairs of successive windows
    is beyond `AGREES` deviations.
    """

    #: L95 as a controller measures it, at most ``problem.censor_ms``.
    l95_ms: float
    l95_error_ms: float
    #: L95 by the final latencies, without that bound; infinite if more than 5 % of the cycles are
    #: lost or never complete.
    uncut_l95_ms: float
    #: V_D.
    violation_rate: float
    violation_error: float
    #: Mean latency of the completed cycles; NaN without any.
    latency_ms: float
    #: Share of each resource, a node or a kind of accelerator, that the cell's own jobs use.
    own: Mapping[str, float]
    #: Share of each resource that neither own nor shadow jobs use.
    foreign: Mapping[str, float]
    #: Standard deviation of `foreign` between decisions.
    foreign_deviation: Mapping[str, float]
    #: Simulated cycles, including the first windows, which do not count.
    cycles: int
    #: Share of the windows that lose more than 5 % of their cycles.
    lost_windows: float
    #: Whether the two halves of the windows have the same means, within `UNSETTLED` errors.
    is_settled: bool
    l95_deviation_ms: float
    violation_deviation: float
    #: Mean age of the newest command and its standard error, milliseconds, if J weighs it.
    age: tuple[float, float] | None = None
    #: Share of the stretches of k cycles with more than m misses, if misses are capped.
    misses: float | None = None
    #: Price of transmitted bytes, money per hour, if links have prices.
    price_per_hour: float | None = None

    @property
    def qos(self) -> QoS:
        """The price as a QoS, with the declared foreign load."""
        used = {name: min(share + self.foreign[name], 1.0) for name, share in self.own.items()}
        error = self.l95_error_ms, self.violation_error
        metrics = self.l95_ms, self.violation_rate, used, self.uncut_l95_ms
        further = *(self.age or NO_AGE), self.misses
        return QoS(*metrics, error, *further, price_per_hour=self.price_per_hour)

    @property
    def is_good_enough(self) -> bool:
        """Whether the simulation is long enough."""
        return self.wanted <= 1.0

    @property
    def wanted(self) -> float:
        """Factor by which the simulation must grow."""
        l95 = self.l95_error_ms / (L95_SHARE * self.l95_ms) if self.l95_error_ms else 0.0
        age_ms, age_error_ms = self.age or (1.0, 0.0)
        age = age_error_ms / (L95_SHARE * age_ms) if age_error_ms else 0.0
        errors = max(l95, self.violation_error / RATE, age)
        return errors * errors


@dataclass(frozen=True, slots=True)
class Question:
    """The properties of a problem that determine its prices."""

    #: All values of the problem that determine its prices.
    values: tuple[object, ...] = field(repr=False)
    scenario: str
    seed: int
    cycles: int | None
    shadow_fractions: Mapping[str, float]
    problem: Problem = field(compare=False, repr=False)

    @classmethod
    def of(
        cls,
        problem: Problem,
        scenario: str,
        seed: int,
        cycles: int | None,
        shadow_fraction: ShadowFraction = 0.0,
    ) -> Question:
        """Return the key of a problem's prices (see `prices_of`); its phase does not matter."""
        fractions = by_candidate(shadow_fraction, problem.candidates)
        # Shadow jobs change the price only of a candidate that they can delay.
        sent = {name: fractions[name] if name in hindered(problem) else 0.0 for name in fractions}
        if problem.pipeline.phase_ms is not None:
            problem = problem.at_phase(None)
        objective = problem.objective
        values = (
            *(problem.pipeline, problem.fabric, problem.candidates, problem.scenario(scenario)),
            *(problem.window_cycles, problem.decide_cycles, problem.controller.close_grace_ms),
            *(problem.censor_ms, objective.latency, objective.weighs_age, objective.caps.misses),
        )
        fractions = FrozenDict(sent if any(sent.values()) else {})
        return cls(values, scenario, seed, cycles, fractions, problem)


#: Known prices of this process; another process can take them over.
KNOWN_PRICES = Remembered[Question, Mapping[str, Price]](KEPT)


def prices_of(
    problem: Problem,
    scenario: str = "baseline",
    *,
    seed: int = SEED,
    cycles: int | None = None,
    shadow_fraction: ShadowFraction = 0.0,
) -> Mapping[str, Price]:
    """Return the price of every candidate; known prices are not simulated again.

    `cycles` is the number of cycles of each candidate that count [default: as many as necessary].
    `shadow_fraction` is the share of the cycles that are also sent through each alternative, or
    this share by candidate. Raise `KernelError` if the compiled kernel cannot be loaded.
    """
    question = Question.of(problem, scenario, seed, cycles, shadow_fraction)
    return KNOWN_PRICES.answer(question, lambda: _answer(question))


def _answer(question: Question) -> Mapping[str, Price]:
    problem = with_windows_up_to(LONGEST_WINDOW, question.problem)
    most = most_windows(problem, question.cycles)
    slow, misses = slow_processes(problem, question.scenario), problem.objective.caps.misses
    loop = slow.whole_loops(problem.window_cycles, most - SETTLING)
    least_cycles = slow.least_cycles(problem.pipeline.period_ms)
    if misses is not None:
        least_cycles = max(least_cycles, misses.least_cycles * problem.pipeline.due_interval)
    least = SETTLING + math.ceil(least_cycles / problem.window_cycles)
    windows = min(_first_windows(problem, problem.scenario(question.scenario)), most)
    if misses is not None:
        windows = min(max(windows, least), most)
    if question.cycles is not None:
        windows = most
    elif loop is not None and (whole := SETTLING + math.ceil(FIRST / loop) * loop) <= most:
        windows = most = whole
    elif slow.is_timed:
        most = windows  # more would change the share of the time that is disturbed
    found: dict[str, Price] = {}
    left = list(problem.candidates)
    if question.shadow_fractions:
        found |= prices_of(problem, question.scenario, seed=question.seed, cycles=question.cycles)
        left = [name for name in left if question.shadow_fractions[name]]
    while True:
        drawing = Drawing(
            problem, question.scenario, seed=question.seed, windows=windows, wraps=True
        )
        realisation = drawing.take(windows)
        shadows = None
        if question.shadow_fractions:
            shadows = SentShadows(problem, realisation, question.shadow_fractions)
        player = CandidatePlayer([(problem, realisation)], shadows=shadows, decides=True)
        found |= {name: price_of(player, name, is_last=windows == most) for name in left}
        if windows >= least:
            left = [name for name in left if not found[name].is_good_enough]
        if not left or windows == most:
            break
        counted = windows - min(SETTLING, windows - 1)
        wanted = AMPLE * max(found[name].wanted for name in left) * counted
        windows = min(max(SETTLING + math.ceil(min(wanted, most)), least), most)
    return FrozenDict({name: found[name] for name in problem.candidates})


def _first_windows(problem: Problem, scenario: Scenario) -> int:
    """Return the number of windows to simulate first, enough for all disturbances."""
    if not scenario:
        return SETTLING + FIRST
    window_s = problem.window_ms / 1e3
    ends = [
        item.end_s / window_s if math.isfinite(item.end_s) else item.at_s / window_s + DISTURBED
        for item in scenario
    ]
    return max(DISTURBED, math.ceil(max(ends)))


def most_windows(problem: Problem, cycles: int | None = None) -> int:
    """Return the largest number of windows of a candidate, at least 1.

    If `cycles` is given, at least that many cycles count, up to the longest possible run; otherwise
    `MOST_CYCLES`, without idle cycles, and `MOST_EVENTS` (releases, completions and messages) are
    the limits.
    """
    pipeline, width = problem.pipeline, problem.window_cycles
    events = 1 + len(pipeline.tasks) + len(pipeline.flows)
    if pipeline.has_rates:
        rates = *pipeline.rates.values(), *pipeline.message_rates.values()
        events = math.ceil(1 + sum(1 / every for every in rates))
    most = min(MOST_CYCLES * pipeline.due_interval, MOST_EVENTS // events) // width
    if cycles is not None:
        most = SETTLING + -(-cycles // width)
    return max(min(most, longest_run(pipeline.period_ms) // width), 1)


def price_of(player: CandidatePlayer, name: str, *, is_last: bool = True) -> Price:
    """Price a candidate by its windows in the realisation of a single cell.

    If `is_last`, the simulation cannot grow any more, and errors include slow processes.
    """
    ((problem, realisation),) = player.cells
    arrays, first = player.play({0: name}), min(SETTLING, realisation.windows - 1)
    windows, tables = player.windows(arrays, 0, first), arrays.tables
    slow = slow_processes(problem, realisation.scenario)
    windows_ms, rates = windows.l95_ms, windows.violation_rate
    l95_ms, violation_rate = float(windows_ms.mean()), float(rates.mean())
    (_, l95_error_ms), (_, violation_error) = mean_and_error(windows_ms), mean_and_error(rates)
    if l95_error_ms and not violation_error:
        # Windows are random, but all miss the same number of deadlines: usually none, or all.
        violation_error = unseen_error(violation_rate, int(windows.counted.sum()))
    if is_last:
        l95_error_ms, violation_error = slow.errors(
            problem, realisation, name, windows_ms, rates, (l95_error_ms, violation_error)
        )
    since = first * problem.window_cycles
    latency_ns, outcome = tables.latency_ns[0, since:], tables.outcome[0, since:]
    done = outcome == CycleOutcome.DONE
    cap = problem.objective.caps.misses
    finished_ms = latency_ns[done] / 1e6
    uncut_l95_ms, lost_windows = _uncut(problem, realisation, windows, latency_ns, outcome)
    shares = windows.shares[: _closed(problem, realisation, windows)]
    own, foreign = shares[:, 1], _foreign(shares)
    stretches = foreign
    if len(looks := tables.look_shares[0, since // problem.decide_cycles :, 0]):
        stretches = _foreign(looks)
    by_resource = partial(_by_resource, problem)
    return Price(
        l95_ms=l95_ms,
        l95_error_ms=l95_error_ms,
        uncut_l95_ms=max(uncut_l95_ms, l95_ms),
        violation_rate=violation_rate,
        violation_error=violation_error,
        latency_ms=float(finished_ms.mean()) if len(finished_ms) else math.nan,
        own=by_resource(own.mean(axis=0)),
        foreign=by_resource(foreign.mean(axis=0)),
        foreign_deviation=by_resource(stretches.std(axis=0)),
        cycles=realisation.cycles,
        lost_windows=lost_windows,
        is_settled=bool(slow.loops)
        or slow.is_timed
        or (_is_settled(windows_ms, l95_error_ms) and _is_settled(rates, violation_error)),
        l95_deviation_ms=_deviation(windows_ms, l95_error_ms),
        violation_deviation=_deviation(rates, violation_error),
        age=_age(player, name, windows, is_last=is_last) if problem.objective.weighs_age else None,
        price_per_hour=float(windows.price_per_hour.mean()) if problem.fabric.has_prices else None,
        misses=None if cap is None else share_over(_missed(player, arrays, since), cap),
    )


def _uncut(
    problem: Problem,
    realisation: Realisation,
    windows: PlayedWindows,
    latency_ns: Ints,
    outcome: NDArray[np.int8],
) -> tuple[float, float]:
    """Return L95 without the bound for J, ms, and the share of the windows whose L95 is lost.

    The L95 is infinite if over 5 % of the cycles are lost; of ages, if over 5 % of the windows are.
    """
    if problem.objective.latency is not None:
        is_lost = np.isinf(windows.uncut_ms)
        share = float(is_lost.mean())
        return math.inf if share > 0.05 else float(windows.uncut_ms[~is_lost].mean()), share
    done, is_idle = outcome == CycleOutcome.DONE, outcome == CycleOutcome.IDLE
    usual_ms = float(np.median(latency_ns[done] / 1e6)) if done.any() else 0.0
    # A cycle that is unfinished and no older than usual may complete or not: it is left out.
    age_ms = (realisation.release_ns[-1] - realisation.release_ns[-1 - len(outcome) : -1]) / 1e6
    is_young = (outcome == CycleOutcome.IN_FLIGHT) & (age_ms <= max(problem.censor_ms, usual_ms))
    lost = int(np.count_nonzero(~done & ~is_young & ~is_idle))
    uncut_ms, is_lost = _known_later(latency_ns, windows)
    open_windows = is_young.reshape(len(uncut_ms), -1).any(axis=1)
    if not open_windows.all():
        uncut_ms, is_lost = uncut_ms[~open_windows], is_lost[~open_windows]
    over = lost > 0.05 * np.count_nonzero(~is_idle)
    return math.inf if over else float(uncut_ms.mean()), float(is_lost.mean())


def _missed(player: CandidatePlayer, arrays: Arrays, since: int) -> NDArray[np.bool_]:
    """Return whether each cycle with a due sink, from `since` on, has missed."""
    ((problem, realisation),) = player.cells
    played = problem.pipeline, realisation.release_ns, CellArrays(arrays)
    return due_misses(*played, slice(since, realisation.cycles))


def _closed(problem: Problem, realisation: Realisation, windows: PlayedWindows) -> int:
    """Return how many of the windows have their last deadline by the last release, at least one.

    After it nothing is released: load falls, and ages grow.
    """
    pipeline, release_ns = problem.pipeline, realisation.release_ns
    later_ns = pipeline.deadline_ns - pipeline.period_ns
    beyond = release_ns[problem.window_cycles :: problem.window_cycles] + later_ns > release_ns[-1]
    return max(len(windows.age_ms) - int(beyond.sum()), 1)


def _age(
    player: CandidatePlayer, name: str, windows: PlayedWindows, *, is_last: bool
) -> tuple[float, float]:
    """Return the mean age of some windows of a candidate, and its standard error."""
    ((problem, realisation),) = player.cells
    closed = _closed(problem, realisation, windows)
    series = windows.age_ms[:closed], windows.violation_rate[:closed]
    age_ms, error_ms = mean_and_error(series[0])
    if is_last:
        slow = slow_processes(problem, realisation.scenario)
        error_ms, _ = slow.errors(problem, realisation, name, *series, (error_ms, 0.0))
    return age_ms, error_ms


def _deviation(windows: Floats, error: float) -> float:
    """Return the deviation of one window from the mean (see `Price`)."""
    off = np.abs(windows - windows.mean())
    two = np.sort(np.append(0.0, np.minimum(off[:-1], off[1:])))[::-1]
    rare = float(two[len(off) // RARE])
    return max(float(windows.std()), error * math.sqrt(len(windows)), rare / AGREES)


def _is_settled(by_window: Floats, error: float) -> bool:
    """Whether the two halves of the windows have the same mean."""
    half = len(by_window) // 2
    if half < 2:
        return True
    (first, error_1), (last, error_2) = map(mean_and_error, (by_window[:half], by_window[half:]))
    # With half the windows, the error is at least sqrt(2) times as large.
    least = math.sqrt(2) * error
    off = abs(first - last) - UNSETTLED * math.hypot(max(error_1, least), max(error_2, least))
    return off <= 1e-9  # a larger difference is more than rounding of sums


def _foreign(shares: Floats) -> Floats:
    """Return the share of each resource without own and shadow jobs, shape (rows, resources)."""
    busy, own, shadow, _ = np.moveaxis(shares, 1, 0)
    foreign: Floats = np.maximum(busy - own - shadow, 0.0)
    return foreign


def _by_resource(problem: Problem, shares: Floats) -> Mapping[str, float]:
    # Without the rounding of sums, equal shares compare equal.
    return FrozenDict(zip(problem.fabric.resources, shares.round(12).tolist(), strict=True))


def _known_later(latency_ns: Ints, windows: PlayedWindows) -> tuple[Floats, NDArray[np.bool_]]:
    """Return L95 of every window by the final latencies, milliseconds, and whether it is lost.

    L95 of a lost window is its value at the end of the window. `latency_ns` has `NEVER_NS` for
    cycles that did not complete; idle cycles do not count.
    """
    seen_ms = windows.l95_ms
    by_window = latency_ns.reshape(len(seen_ms), -1)
    l95_ns = order_statistic_of_smallest(by_window, 95, windows.counted)
    is_lost = l95_ns >= NEVER_NS
    return np.where(is_lost, seen_ms, np.maximum(l95_ns / 1e6, seen_ms)), is_lost
