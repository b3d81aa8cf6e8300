"""Validation: what the simulator predicts for a cell, beside what runs of that cell measured.

Runs of one scenario and policy are a group. For every run of a group the calibrated cell is
simulated with as many windows, the same warm-up, the disturbances at the times at which they were
played, and many seeds; windows that the run leaves out are left out of its simulations too.

What a prediction has to reach was set before anything was measured:

* L95 within 10 %;
* V_D within 2 percentage points, or explained by the error that L95 is allowed: the measured V_D
  lies between those of the predicted latencies, all of them multiplied by 0.9 and by 1.1, and L95
  itself is met. That can be where much of the latency's mass lies at the deadline;
* U of every node within 5 percentage points;
* the same dominant placement;
* a smaller error of L95 than that of the sum-of-means predictor, and no larger one of V_D (but for
  what is within 2 points for both).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.display import Displayed
from dwell.errors import DwellError, RunError
from dwell.model import Problem
from dwell.study.intervals import Interval, rule_of_three
from dwell.study.judged_prediction import (
    Judged,
    Outcome,
    chance,
    judge,
    relative,
    within,
    worst,
)
from dwell.study.measured_run import MeasuredRun, read_measured
from dwell.study.predicting import Simulated, Simulator, Unit
from dwell.study.qos_sample import Piece, QosSample, piece_of
from dwell.study.resampling import resample_units, resample_windows
from dwell.study.software import versions
from dwell.study.sum_of_means import sum_of_means, sums_of_shares
from dwell.study.validated_jobs import finished_jobs, job_times
from dwell.study.workers import available_processes, spread

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run
    from dwell.testbed.speeds import Usual

__all__ = [
    "GOALS",
    "L95_ALLOWED",
    "LEAST_MINUTES",
    "POINTS_ALLOWED",
    "SEEDS",
    "USE_ALLOWED",
    "Group",
    "Validation",
    "validate",
]

Floats: TypeAlias = NDArray[np.float64]
Progress: TypeAlias = Callable[[int, int], None]

L95_ALLOWED = 0.10
POINTS_ALLOWED = 0.02
USE_ALLOWED = 0.05
#: Measured time of a group below which its verdicts say little.
LEAST_MINUTES = 5.0
#: Number of simulations of each run.
SEEDS = 20
#: Simulations below which further processes take longer to begin than they save.
WORTH_SPREADING = 100
#: What is judged in every group, in the order of tables; U is the worst of its nodes.
GOALS = ("l95_ms", "violation_rate", "utilisation", "dominant", "sum_of_means")


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Runs of one scenario and policy, beside their prediction.

    Parameters
    ----------
    policy : str
        With its estimator where it may move: ``dtp+corrected``.
    runs : tuple of str
    minutes : float
        Measured time that counts.
    excluded : int
        Windows left out for a reason that the runs give.
    figures : mapping of str to Judged
        By metric: ``l95_ms``, ``window_l95_ms`` (mean over windows of what the controller saw),
        ``violation_rate``, ``u_NODE``, ``share_CANDIDATE``, ``migrations`` (of a run), and the
        conditions ``dominant`` and ``sum_of_means``, whose numbers are shares of windows, and
        L95 (ms).
    dominant : tuple of str
        The placement of most windows: measured, and predicted.
    allowed_rates : tuple of float
        V_D of the predicted latencies times 0.9, and times 1.1.
    factor : float
        By what the predicted latencies would have to be multiplied to give the measured V_D.
    """

    scenario: str
    policy: str
    runs: tuple[str, ...]
    minutes: float
    excluded: int
    measured: QosSample
    predicted: QosSample
    figures: Mapping[str, Judged]
    dominant: tuple[str, str]
    allowed_rates: tuple[float, float]
    factor: float

    @property
    def short(self) -> bool:
        """Whether less was measured than is asked for."""
        return self.minutes < LEAST_MINUTES

    def verdict(self, goal: str) -> Outcome:
        """Return the verdict on one of `GOALS`."""
        if goal == "utilisation":
            return worst([one.verdict for one in self.uses.values()])
        return self.figures[goal].verdict

    @property
    def uses(self) -> dict[str, Judged]:
        """Utilisation by node."""
        return {name[2:]: one for name, one in self.figures.items() if name.startswith("u_")}


@dataclass(frozen=True, slots=True, eq=False)
class Validation(Displayed):
    """Predictions beside measurements.

    Parameters
    ----------
    problem : Problem
        The calibrated cell.
    groups : tuple of Group
        By scenario in the cell's order, and then by policy.
    seeds : int
        Number of simulations of each run.
    table : DataFrame
        One row a group and figure: ``scenario``, ``policy``, ``metric``, and ``measured``,
        ``predicted`` and ``error`` with their ends (``_low``, ``_high``), ``allowed``,
        ``sum_of_means``, ``verdict``, ``note``. Rates and utilisations are shares, the error of
        L95 is relative, all others are differences.
    jobs : DataFrame
        One row a group, task and node, of the runs that kept their jobs: how many ``jobs``, their
        time from start to end (``measured_ms``, ``measured_p95_ms``, ``predicted_ms``,
        ``predicted_p95_ms``), the core time where the runs know it (``core_ms``,
        ``core_p95_ms``), and what the cell says it is (``cell_ms``, ``cell_p95_ms``).
    versions : mapping of str to str
        Versions of the software that simulated, by package.
    """

    problem: Problem
    groups: tuple[Group, ...]
    seeds: int
    table: pl.DataFrame
    jobs: pl.DataFrame
    versions: Mapping[str, str]

    def __repr__(self) -> str:
        runs = sum(len(group.runs) for group in self.groups)
        return (
            f"<Validation of {self.problem.name}: {len(self.groups)} groups, {runs} runs, each "
            f"simulated {self.seeds} times>"
        )

    def verdict(self, goal: str) -> Outcome:
        """Return the verdict on one of `GOALS` in all groups together: the worst."""
        return worst([group.verdict(goal) for group in self.groups])


def validate(
    runs: Mapping[str, Run] | Sequence[Run],
    problem: Problem,
    *,
    seeds: int = SEEDS,
    calibrated_from: Sequence[str] = (),
    usual: Usual | None = None,
    processes: int | None = 1,
    progress: Progress | None = None,
) -> Validation:
    """Set what a calibrated cell predicts beside what its runs measured.

    Parameters
    ----------
    runs : mapping of str to Run, or sequence of Run
        By name, at least one.
    problem : Problem
        The calibrated cell.
    seeds : int
        Simulations of every run.
    calibrated_from : sequence of str
        Names of the runs from which the cell was made, or their `Run.run_id`; none of them may
        be validated on.
    usual : Usual, optional
        How fast the CPUs were when the cell was calibrated: runs are predicted on CPUs as fast as
        theirs.
    processes : int, optional
        How many to use; where None one a CPU, if there is enough to do.
    progress : callable, optional
        Takes how many simulations are done, and of how many.

    Returns
    -------
    Validation

    Raises
    ------
    RunError
        If a run is of another cell, or of a scenario or policy that the cell does not have, was
        used for calibration, or has no window that counts; all faults at once.
    """
    named = dict(runs) if isinstance(runs, Mapping) else _numbered(runs)
    if not named:
        raise RunError("no runs: name at least one")
    if seeds < 2:
        raise RunError(f"seeds is {seeds}; at least 2 are needed, for intervals")
    measured = _read(named, problem, frozenset[str | None](calibrated_from), usual)
    groups = list(_grouped(measured, problem))
    found: dict[int, tuple[Group, pl.DataFrame]] = {}
    waiting: dict[int, dict[Unit, Simulated]] = {place: {} for place in range(len(groups))}
    simulator = Simulator(tuple(tuple(one.asked for one in mine) for mine in groups), seeds)
    units = simulator.units
    done = 0

    def take(unit: Unit, simulated: Simulated) -> None:
        # A group is judged as soon as it is complete: its simulations are not needed any longer.
        nonlocal done
        done += 1
        mine = waiting[unit.group]
        mine[unit] = simulated
        if len(mine) == seeds * len(groups[unit.group]):
            ordered = [mine[known] for known in sorted(mine)]
            found[unit.group] = _group(groups[unit.group], ordered)
            mine.clear()
        if progress is not None:
            progress(done, len(units))

    if processes is None:
        processes = available_processes() if len(units) >= WORTH_SPREADING else 1
    spread(simulator, units, processes=processes, take=take)
    import polars as pl

    judged = [found[place] for place in range(len(groups))]
    return Validation(
        problem=problem,
        groups=tuple(group for group, _ in judged),
        seeds=seeds,
        table=pl.DataFrame(list(_rows([group for group, _ in judged])), infer_schema_length=None),
        jobs=pl.concat([jobs for _, jobs in judged]),
        versions=versions(),
    )


def _numbered(runs: Sequence[Run]) -> dict[str, Run]:
    return {f"run {number}": run for number, run in enumerate(runs, 1)}


def _read(
    named: Mapping[str, Run],
    problem: Problem,
    used: frozenset[str | None],
    usual: Usual | None,
) -> list[MeasuredRun]:
    """Read every run; what is wrong with any of them is told at once."""
    found: list[MeasuredRun] = []
    faults: list[str] = []
    for name, run in named.items():
        if name in used or run.run_id in used:
            faults.append(f"{name}: the cell was calibrated from this run; validate on others")
            continue
        try:
            one = read_measured(name, run, problem, usual)
            piece_of(run, one.problem, one.excluded)
            found.append(one)
        except RunError as error:
            faults.append(str(error))
        except DwellError as error:
            faults.append(f"{name}: {error}")
    if faults:
        raise RunError("\n".join(faults))
    return found


def _grouped(measured: Sequence[MeasuredRun], problem: Problem) -> Iterator[list[MeasuredRun]]:
    """Yield the runs of each scenario and policy."""
    policies = list(dict.fromkeys(one.contender for one in measured))
    policies.sort(
        key=lambda name: (
            list(problem.candidates).index(name)
            if name in problem.candidates
            else len(problem.candidates)
        )
    )
    for scenario in problem.scenarios:
        for policy in policies:
            mine = [one for one in measured if (one.scenario, one.contender) == (scenario, policy)]
            if mine:
                yield mine


# -------------------------------------------------------------------------------------- a group


def _group(
    mine: Sequence[MeasuredRun], simulated: Sequence[Simulated]
) -> tuple[Group, pl.DataFrame]:
    """Judge a group."""
    own = [piece_of(one.run, one.problem, one.excluded) for one in mine]
    problem = mine[0].problem
    measured = QosSample.of(own, problem, by_window=True)
    predicted = QosSample.of([one.piece for one in simulated], problem, by_window=False)
    judged = _Judge(problem, measured, predicted, *_sums(mine, own, problem))
    figures = judged.figures()
    cycles = sum(piece.cycles.height for piece in own)
    group = Group(
        scenario=mine[0].scenario,
        policy=mine[0].contender,
        runs=tuple(one.name for one in mine),
        minutes=cycles * problem.pipeline.period_ms / 60e3,
        excluded=sum(len(one.excluded) for one in mine),
        measured=measured,
        predicted=predicted,
        figures=figures,
        dominant=judged.dominant,
        allowed_rates=judged.allowed_rates,
        factor=predicted.factor_for(figures["violation_rate"].measured.value),
    )
    jobs = job_times(
        group.scenario,
        group.policy,
        problem,
        [finished_jobs(one.run, problem.window_cycles) for one in mine if one.run.has_jobs],
        [one.jobs for one in simulated if one.jobs is not None],
    )
    return group, jobs


def _sums(
    mine: Sequence[MeasuredRun], own: Sequence[Piece], problem: Problem
) -> tuple[float, float]:
    """L95 and V_D of the sum-of-means predictor, which is told where the cycles ran."""
    sums: dict[str, list[float]] = {}
    cycles: dict[str, int] = {}
    for one, piece in zip(mine, own, strict=True):
        release_ns = piece.cycles["release_ns"].to_numpy()
        span = float(release_ns.min()) / 1e9, float(release_ns.max()) / 1e9 + 1e-9
        for name, count in piece.cycles["placement"].cast(str).value_counts().rows():
            placement = one.problem.candidates[name]
            sums.setdefault(name, []).append(
                sum_of_means(one.problem, placement, one.scenario, *span)
            )
            cycles[name] = cycles.get(name, 0) + count
    means = {name: float(np.mean(values)) for name, values in sums.items()}
    return sums_of_shares(means, cycles, problem.pipeline.deadline_ms)


class _Judge:
    """Judges the figures of a group, all from the same resamples."""

    def __init__(
        self,
        problem: Problem,
        measured: QosSample,
        predicted: QosSample,
        sum_ms: float,
        sum_rate: float,
    ) -> None:
        self.problem, self.measured, self.predicted = problem, measured, predicted
        self.sum_ms, self.sum_rate = sum_ms, sum_rate
        self._measured = resample_windows(measured.lengths)
        # Another seed: the two are resampled independently.
        self._predicted = resample_units(predicted.units, seed=2)
        self.allowed_rates = (
            predicted.rate_if(1 - L95_ALLOWED),
            predicted.rate_if(1 + L95_ALLOWED),
        )
        self.dominant = (self._dominant(measured), self._dominant(predicted))
        self._known: dict[str, tuple[Floats, Floats]] = {}

    def figures(self) -> dict[str, Judged]:
        """Return every figure of the group (see `Group`)."""
        l95 = self._l95()
        found = [
            l95,
            self._difference("window_l95_ms"),
            self._violations(l95.verdict),
            *(self._use(f"u_{node}") for node in self.problem.fabric.nodes),
            self._placed(),
            self._better(),
            *(self._difference(f"share_{name}") for name in self.problem.candidates),
            self._migrations(),
        ]
        return {one.metric: one for one in found}

    def _both(self, name: str) -> tuple[Floats, Floats]:
        """Return a figure in every resample: measured, and predicted."""
        if name not in self._known:
            self._known[name] = (
                self.measured.resampled(name, self._measured),
                self.predicted.resampled(name, self._predicted),
            )
        return self._known[name]

    def _values(self, name: str) -> tuple[float, float]:
        if name == "l95_ms":
            return self.measured.l95_ms, self.predicted.l95_ms
        return self.measured.figure(name), self.predicted.figure(name)

    def _l95(self) -> Judged:
        value, guess = self._values("l95_ms")
        seen, said = self._both("l95_ms")
        error = within(_relative(guess, value), relative(said, seen))
        judged = Judged(
            "l95_ms",
            within(value, seen),
            within(guess, said),
            error,
            L95_ALLOWED,
            judge(error, L95_ALLOWED),
            self.sum_ms,
        )
        if math.isinf(value) and math.isinf(guess):
            # More than 5 % are lost, as predicted: what is left to judge is what windows showed.
            value, guess = self._values("window_l95_ms")
            seen, said = self._both("window_l95_ms")
            error = within(_relative(guess, value), relative(said, seen))
            return replace(
                judged,
                error=error,
                verdict=judge(error, L95_ALLOWED),
                note="more than 5 % of the cycles are lost: judged by the mean of windows",
            )
        return judged

    def _difference(self, name: str) -> Judged:
        (value, guess), (seen, said) = self._values(name), self._both(name)
        error = within(guess - value, said - seen)
        return Judged(name, within(value, seen), within(guess, said), error)

    def _migrations(self) -> Judged:
        judged = self._difference("migrations")
        if len(self.measured.lengths) > 1:
            return judged
        # One run has one number of migrations: its windows say nothing of another run's.
        measured, error = judged.measured, judged.error
        return replace(
            judged,
            measured=Interval(measured.value, math.nan, math.nan),
            error=Interval(error.value, math.nan, math.nan),
        )

    def _use(self, name: str) -> Judged:
        judged = self._difference(name)
        return replace(judged, allowed=USE_ALLOWED, verdict=judge(judged.error, USE_ALLOWED))

    def _violations(self, l95: Outcome) -> Judged:
        judged = self._difference("violation_rate")
        measured, error = judged.measured, judged.error
        # What was not seen is not impossible.
        most = rule_of_three(self.measured.windows)
        if measured.value == 0:
            measured = measured._replace(high=most)
            error = error._replace(low=error.low - most)
        elif measured.value == 1:
            measured = measured._replace(low=1 - most)
            error = error._replace(high=error.high + most)
        verdict = judge(error, POINTS_ALLOWED)
        low, high = self.allowed_rates
        note = ""
        if verdict != "met" and low <= measured.low and measured.high <= high:
            if l95 in ("met", "open"):
                verdict = "explained" if l95 == "met" else "open"
                note = (
                    "latencies 10 % shorter or longer, as L95 may be off, give "
                    f"{100 * low:.1f} to {100 * high:.1f} %"
                )
        elif verdict == "missed" and measured.low <= high and low <= measured.high:
            verdict = verdict if l95 == "missed" else "open"
        return replace(
            judged,
            measured=measured,
            error=error,
            allowed=POINTS_ALLOWED,
            verdict=verdict,
            baseline=self.sum_rate,
            note=note,
        )

    @staticmethod
    def _dominant(sample: QosSample) -> str:
        shares = {
            name.removeprefix("share_"): sample.figure(name)
            for name in sample.sums
            if name.startswith("share_")
        }
        return max(shares, key=lambda name: shares[name])

    def _placed(self) -> Judged:
        """Judge whether the same placement has the most windows."""
        names = [f"share_{name}" for name in self.problem.candidates]
        seen, said = zip(*map(self._both, names), strict=True)
        same = np.argmax(seen, axis=0) == np.argmax(said, axis=0)
        verdict = chance(same)
        # What most resamples show is not against what the runs themselves show.
        agree = self.dominant[0] == self.dominant[1]
        if verdict == ("missed" if agree else "met"):
            verdict = "open"
        shares = [self._difference(f"share_{name}") for name in self.dominant]
        return Judged(
            "dominant",
            shares[0].measured,
            shares[1].predicted,
            _NONE,
            verdict=verdict,
            note=f"{self.dominant[0]} measured, {self.dominant[1]} predicted",
        )

    def _better(self) -> Judged:
        """Judge whether the prediction is nearer to what was measured than the sum of means."""
        value, guess = self._values("l95_ms")
        seen, said = self._both("l95_ms")
        sums = np.full_like(seen, self.sum_ms)
        ours, theirs = np.abs(relative(said, seen)), np.abs(relative(sums, seen))
        rates, rates_said = self._both("violation_rate")
        off, off_sum = np.abs(rates_said - rates), np.abs(self.sum_rate - rates)
        not_worse = (off <= off_sum) | (np.maximum(off, off_sum) <= POINTS_ALLOWED)
        error = _relative(self.sum_ms, value)
        return Judged(
            "sum_of_means",
            within(value, seen),
            within(guess, said),
            within(error, relative(sums, seen)),
            math.nan,
            chance((ours < theirs) & not_worse),
            self.sum_ms,
        )


_NONE = Interval(math.nan, math.nan, math.nan)


def _relative(guess: float, value: float) -> float:
    return float(relative(np.array([guess]), np.array([value]))[0])


def _rows(groups: Sequence[Group]) -> Iterator[dict[str, str | float]]:
    """Yield the rows of the table."""
    for group in groups:
        for one in group.figures.values():
            yield {
                "scenario": group.scenario,
                "policy": group.policy,
                "metric": one.metric,
                **_ended("measured", one.measured),
                **_ended("predicted", one.predicted),
                **_ended("error", one.error),
                "allowed": one.allowed,
                "sum_of_means": one.baseline,
                "verdict": one.verdict,
                "note": one.note,
            }


def _ended(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
