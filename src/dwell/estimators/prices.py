"""Prices: what windows of a candidate come to where the cell stays on it.

The kernel plays every candidate alone, as `simulate` does with a policy that never moves: with
queues, links and cycles that overlap. All candidates meet the same draws, so that they
differ by where their tasks run and not by luck. More is simulated until the means are known well
enough (`L95_SHARE`, `RATE`) and every slow process has shown all that it does
(`dwell.estimators.slow_processes`), or until `MOST_CYCLES` or `MOST_EVENTS` are reached. How much
that is depends on counts and values alone, so that a price is a fixed number. Traces wrap. Shadow
jobs are simulated where they matter (`dwell.estimators.sent_shadows`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.sent_shadows import SentShadows, hindered, stamps_of
from dwell.estimators.slow_processes import mean_and_error, slow_processes, unseen_error
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.kernels.codes import CycleOutcome
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model.fabric import Fabric
from dwell.model.frozen import FrozenDict
from dwell.model.instants import NEVER_NS, longest_run
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import order_statistic
from dwell.model.pipeline import Pipeline
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS
from dwell.model.scenario import Scenario
from dwell.model.shadow_plan import ShadowFraction, by_candidate

SEED = 20_250_601
#: Standard errors that are good enough: of L95 as a share of it, and of V_D.
L95_SHARE, RATE = 0.01, 0.0025
#: Deviations from the mean within which a window agrees with the price.
AGREES = 4.0
#: One in so many pairs of windows in succession may be further off, both of them.
RARE = 300
#: How much of a candidate is played at most.
MOST_CYCLES, MOST_EVENTS = 100_000, 10_000_000
#: Windows that are played first: those in which queues settle, which do not count, and others; of a
#: scenario as many as a run has if nothing else is asked for.
SETTLING, FIRST, DISTURBED = 5, 20, 300
#: Errors by which the means of the two halves of the windows may differ.
UNSETTLED = 3.0
#: How much more is played than seems to be needed, since the error is itself an estimate.
AMPLE = 1.2
#: Of how many questions the answers are kept.
KEPT = 512
#: Longer windows are played as windows of so many cycles.
LONGEST_WINDOW = 4_000


@dataclass(frozen=True, slots=True)
class Price:
    """Means over the windows of a candidate that stays, with their standard errors.

    Parameters
    ----------
    l95_ms, l95_error_ms : float
        L95 as a controller sees it, never more than ``problem.censor_ms``.
    uncut_l95_ms : float
        The same without that bound, by what the cycles of a window took in the end; infinite where
        more than 5 % of them are lost, or never come to an end.
    violation_rate, violation_error : float
        V_D.
    latency_ms : float
        Mean latency of the cycles that came to an end; NaN where none did.
    own : mapping of str to float
        Share of each resource that the cell's jobs take: a node, or a kind of accelerator.
    foreign, foreign_deviation : mapping of str to float
        Share of each resource that neither those nor shadow jobs take, with the standard deviation
        from decision to decision.
    cycles : int
        How many cycles were played, those at the begin that do not count included.
    lost_windows : float
        Share of the windows that lose more than 5 % of their cycles.
    is_settled : bool
        Whether the halves of the windows have the same means, to three of their errors.
    l95_deviation_ms, violation_deviation : float
        Deviation of one window from the means: by how much windows differ, by the errors of the
        means, which know of slow processes, and so large that both of two windows in succession
        are beyond `AGREES` deviations in one of `RARE` cases at most.
    """

    l95_ms: float
    l95_error_ms: float
    uncut_l95_ms: float
    violation_rate: float
    violation_error: float
    latency_ms: float
    own: Mapping[str, float]
    foreign: Mapping[str, float]
    foreign_deviation: Mapping[str, float]
    cycles: int
    lost_windows: float
    is_settled: bool
    l95_deviation_ms: float
    violation_deviation: float

    @property
    def qos(self) -> QoS:
        """The same as a QoS, with what others take as declared."""
        used = {name: min(share + self.foreign[name], 1.0) for name, share in self.own.items()}
        error = self.l95_error_ms, self.violation_error
        return QoS(self.l95_ms, self.violation_rate, used, self.uncut_l95_ms, error)

    @property
    def is_good_enough(self) -> bool:
        """Whether no more has to be played."""
        return self.wanted <= 1.0

    @property
    def wanted(self) -> float:
        """How many times as much must be played."""
        l95 = self.l95_error_ms / (L95_SHARE * self.l95_ms) if self.l95_error_ms else 0.0
        errors = max(l95, self.violation_error / RATE)
        return errors * errors


@dataclass(frozen=True, slots=True)
class Question:
    """All of a problem that its prices depend on."""

    pipeline: Pipeline
    fabric: Fabric
    candidates: Mapping[str, Placement]
    window_cycles: int
    censor_ms: float
    close_grace_ms: float
    scenario: Scenario
    decide_cycles: int
    name: str
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
        """Ask for the prices of a problem (see `prices_of`), whose phase is nothing to it alone."""
        fractions = by_candidate(shadow_fraction, problem.candidates)
        # Who is not hindered costs the same with shadows and without.
        sent = {name: fractions[name] if name in hindered(problem) else 0.0 for name in fractions}
        if problem.pipeline.phase_ms is not None:
            problem = problem.at_phase(None)
        return cls(
            pipeline=problem.pipeline,
            fabric=problem.fabric,
            candidates=problem.candidates,
            window_cycles=problem.window_cycles,
            censor_ms=problem.censor_ms,
            close_grace_ms=problem.controller.close_grace_ms,
            scenario=problem.scenario(scenario),
            decide_cycles=problem.decide_cycles,
            name=scenario,
            seed=seed,
            cycles=cycles,
            shadow_fractions=FrozenDict(sent if any(sent.values()) else {}),
            problem=problem,
        )


_known: dict[Question, Mapping[str, Price]] = {}


def prices_of(
    problem: Problem,
    scenario: str = "baseline",
    *,
    seed: int = SEED,
    cycles: int | None = None,
    shadow_fraction: ShadowFraction = 0.0,
) -> Mapping[str, Price]:
    """Return the price of every candidate; what was asked before is not played again.

    Parameters
    ----------
    scenario : str
        Whose disturbances the cell meets.
    seed : int
        Seed of the draws.
    cycles : int, optional
        How many cycles of each candidate count; as many as are needed where None.
    shadow_fraction : float, or mapping of str to float
        Share of the cycles that are also sent through each alternative, by the candidate that is
        priced.

    Raises
    ------
    KernelError
        If the compiled kernel cannot be loaded.
    """
    question = Question.of(problem, scenario, seed, cycles, shadow_fraction)
    known = _known.get(question)
    if known is None:
        known = _answer(question)
        take_over({question: known})
    return known


def known_prices() -> dict[Question, Mapping[str, Price]]:
    """Return what this process has been asked of late, for another one to `take_over`."""
    return dict(_known)


def take_over(known: Mapping[Question, Mapping[str, Price]]) -> None:
    """Know prices that have been played already; those that were known longest are forgotten."""
    _known.update(known)
    for question in list(_known)[:-KEPT]:
        del _known[question]


def _answer(question: Question) -> Mapping[str, Price]:
    problem = question.problem
    if problem.window_cycles > LONGEST_WINDOW:
        every = min(problem.decide_cycles, LONGEST_WINDOW)
        controller = replace(problem.controller, decide_cycles=every)
        problem = replace(problem, window_cycles=LONGEST_WINDOW, controller=controller)
    most = most_windows(problem, question.cycles)
    slow = slow_processes(problem, question.name)
    loop = slow.whole_loops(problem.window_cycles, most - SETTLING)
    least_cycles = slow.least_cycles(problem.pipeline.period_ms)
    least = SETTLING + math.ceil(least_cycles / problem.window_cycles)
    windows = min(_first_windows(problem, question.scenario), most)
    if question.cycles is not None:
        windows = most
    elif loop is not None and (whole := SETTLING + math.ceil(FIRST / loop) * loop) <= most:
        windows = most = whole
    elif slow.is_timed:
        most = windows  # more would change the share of the time that is disturbed
    found: dict[str, Price] = {}
    left = list(problem.candidates)
    if question.shadow_fractions:
        found |= prices_of(problem, question.name, seed=question.seed, cycles=question.cycles)
        left = [name for name in left if question.shadow_fractions[name]]
    while True:
        drawing = Drawing(problem, question.name, seed=question.seed, windows=windows, wraps=True)
        realisation = drawing.take(windows)
        shadows = None
        if question.shadow_fractions:
            shadows = SentShadows(problem, realisation, question.shadow_fractions)
        is_last = windows == most
        found |= {
            name: price_of(problem, realisation, name, shadows, is_last=is_last) for name in left
        }
        if windows >= least:
            left = [name for name in left if not found[name].is_good_enough]
        if not left or windows == most:
            break
        counted = windows - min(SETTLING, windows - 1)
        wanted = AMPLE * max(found[name].wanted for name in left) * counted
        windows = min(max(SETTLING + math.ceil(min(wanted, most)), least), most)
    return FrozenDict({name: found[name] for name in problem.candidates})


def _first_windows(problem: Problem, scenario: Scenario) -> int:
    """How many windows are played first: those in which a scenario shows all that it does."""
    if not scenario:
        return SETTLING + FIRST
    window_s = problem.window_ms / 1e3
    ends = [
        item.end_s / window_s if math.isfinite(item.end_s) else item.at_s / window_s + DISTURBED
        for item in scenario
    ]
    return max(DISTURBED, math.ceil(max(ends)))


def most_windows(problem: Problem, cycles: int | None = None) -> int:
    """How many windows are played of a candidate: so that `cycles` count, or at most; one or more.

    An event is a release, a completion or a message.
    """
    pipeline, width = problem.pipeline, problem.window_cycles
    events = 1 + len(pipeline.tasks) + len(pipeline.flows)
    most = min(MOST_CYCLES, MOST_EVENTS // events) // width
    if cycles is not None:
        most = SETTLING + -(-cycles // width)
    return max(min(most, longest_run(pipeline.period_ms) // width), 1)


def price_of(
    problem: Problem,
    realisation: Realisation,
    name: str,
    shadows: SentShadows | None = None,
    *,
    is_last: bool = True,
) -> Price:
    """Price a candidate by its windows on one realisation.

    Parameters
    ----------
    is_last : bool
        Whether no more may be simulated, and errors have to take account of slow processes.
    """
    sent = shadows.realisation if shadows else None
    arrays = lay_out([(problem, realisation)], shadows=[sent], decides=True)
    index = list(problem.candidates).index(name)
    arrays.replace(stamps=stamps_of(arrays, index, shadows))
    play(arrays)
    tables = arrays.tables  # those that had to grow are others
    first = min(SETTLING, realisation.windows - 1)
    seen = tables.seen[0, first:]
    slow = slow_processes(problem, realisation.scenario)
    windows_ms, rates = seen["l95_ms"], seen["missed"] / problem.window_cycles
    l95_ms, violation_rate = float(windows_ms.mean()), float(rates.mean())
    (_, l95_error_ms), (_, violation_error) = mean_and_error(windows_ms), mean_and_error(rates)
    if l95_error_ms and not violation_error:
        # It is random, and still every window misses as many: none, or all, as a rule.
        violation_error = unseen_error(violation_rate, len(seen) * problem.window_cycles)
    if is_last:
        l95_error_ms, violation_error = slow.errors(
            problem, realisation, name, windows_ms, rates, (l95_error_ms, violation_error)
        )
    since = first * problem.window_cycles
    latency_ns, outcome = tables.latency_ns[0, since:], tables.outcome[0, since:]
    done = outcome == CycleOutcome.DONE
    finished_ms = latency_ns[done] / 1e6
    usual_ms = float(np.median(finished_ms)) if len(finished_ms) else 0.0
    # What is still under way, and no older than usual, may come to an end or not.
    age_ms = (realisation.release_ns[-1] - realisation.release_ns[since:-1]) / 1e6
    is_young = (outcome == CycleOutcome.IN_FLIGHT) & (age_ms <= max(problem.censor_ms, usual_ms))
    lost = int(np.count_nonzero(~done & ~is_young))
    uncut_ms, is_lost = _known_later(latency_ns.reshape(len(seen), -1), windows_ms)
    open_windows = is_young.reshape(len(seen), -1).any(axis=1)
    if not open_windows.all():
        uncut_ms, is_lost = uncut_ms[~open_windows], is_lost[~open_windows]
    _, own, _, _ = np.moveaxis(tables.shares[0, first:], 1, 0)
    foreign = _foreign(tables.shares[0, first:])
    stretches = foreign
    if len(looks := tables.look_shares[0, since // problem.decide_cycles :, 0]):
        stretches = _foreign(looks)
    by_resource = partial(_by_resource, problem)
    return Price(
        l95_ms=l95_ms,
        l95_error_ms=l95_error_ms,
        uncut_l95_ms=math.inf if lost > 0.05 * len(done) else max(float(uncut_ms.mean()), l95_ms),
        violation_rate=violation_rate,
        violation_error=violation_error,
        latency_ms=float(finished_ms.mean()) if len(finished_ms) else math.nan,
        own=by_resource(own.mean(axis=0)),
        foreign=by_resource(foreign.mean(axis=0)),
        foreign_deviation=by_resource(stretches.std(axis=0)),
        cycles=realisation.cycles,
        lost_windows=float(is_lost.mean()),
        is_settled=bool(slow.loops)
        or slow.is_timed
        or (_is_settled(windows_ms, l95_error_ms) and _is_settled(rates, violation_error)),
        l95_deviation_ms=_deviation(windows_ms, l95_error_ms),
        violation_deviation=_deviation(rates, violation_error),
    )


def _deviation(windows: Floats, error: float) -> float:
    """Return the deviation of one window from the mean (see `Price`)."""
    off = np.abs(windows - windows.mean())
    two = np.sort(np.append(0.0, np.minimum(off[:-1], off[1:])))[::-1]
    rare = float(two[len(off) // RARE])
    return max(float(windows.std()), error * math.sqrt(len(windows)), rare / AGREES)


def _is_settled(by_window: Floats, error: float) -> bool:
    """Whether the halves of the windows have the same mean."""
    half = len(by_window) // 2
    if half < 2:
        return True
    (first, error_1), (last, error_2) = map(mean_and_error, (by_window[:half], by_window[half:]))
    # Of half as many windows the error is larger by a factor of sqrt(2) at least.
    least = math.sqrt(2) * error
    off = abs(first - last) - UNSETTLED * math.hypot(max(error_1, least), max(error_2, least))
    return off <= 1e-9  # more than sums are rounded by


def _foreign(shares: Floats) -> Floats:
    """Share of each resource that neither own nor shadow jobs take, shape (rows, resources)."""
    busy, own, shadow, _ = np.moveaxis(shares, 1, 0)
    foreign: Floats = np.maximum(busy - own - shadow, 0.0)
    return foreign


def _by_resource(problem: Problem, shares: Floats) -> Mapping[str, float]:
    # Shares that are equal but for the rounding of sums are equal.
    return FrozenDict(zip(problem.fabric.resources, shares.round(12).tolist(), strict=True))


def _known_later(latency_ns: Ints, seen_ms: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return L95 of every window by the final latencies, milliseconds, and whether it is lost.

    L95 of a lost window is the value at its close.

    Parameters
    ----------
    latency_ns : int64 array, shape (windows, W)
        `NEVER_NS` where a cycle did not come to an end.
    """
    l95_ns = order_statistic(latency_ns, 95)
    is_lost = l95_ns >= NEVER_NS
    return np.where(is_lost, seen_ms, np.maximum(l95_ns / 1e6, seen_ms)), is_lost
