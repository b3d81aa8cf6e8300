"""Validation: predictions of the simulator for a cell, and measurements of its runs.

Runs of one scenario and policy are a group. For each run of a group the calibrated cell is
simulated with the same number of windows, the same warm-up, the recorded times of disturbances, and
many seeds. Windows that the run leaves out are left out of its simulations, too.

The goals were set before the first measurement:

* L95 within 10 %;
* V_D within 2 percentage points, or explained by the allowed error of L95: L95 is met, and the
  measured V_D is between the V_D of the predicted latencies times 0.9 and times 1.1. That happens
  if many latencies are close to the deadline;
* U of every node within 5 percentage points;
* the same dominant placement;
* a smaller error of L95 than the sum-of-means predictor's, and no larger error of V_D (errors
  within 2 points count as equal).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dwell.display import Displayed
from dwell.errors import DwellError, RunError
from dwell.model import Problem
from dwell.model.bounds import counted
from dwell.model.progress import Progress
from dwell.study.predicted_moves import predicted_moves
from dwell.study.software import versions
from dwell.study.workers import available_processes, spread
from dwell_lab.validation.job_times import finished_jobs, job_times
from dwell_lab.validation.judged_prediction import GroupJudge, Judged, Outcome, worst
from dwell_lab.validation.measured_run import MeasuredRun, Simulated, Simulator, Unit, read_measured
from dwell_lab.validation.qos_sample import Piece, QosSample, piece_of
from dwell_lab.validation.sum_of_means import sum_of_means, sums_of_shares

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run
    from dwell_lab.testbed.speeds import Usual

#: Least measured time of a group for reliable verdicts, minutes.
LEAST_MINUTES = 5.0
#: Number of simulations of each run.
SEEDS = 20
#: Number of simulations from which further processes save more than their start costs.
WORTH_SPREADING = 100
#: Goals of every group, in the order of tables; U is the worst node's.
GOALS = ("l95_ms", "violation_rate", "utilisation", "dominant", "sum_of_means")


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Runs of one scenario and policy, with their prediction.

    Parameters
    ----------
    policy : str
        With its estimator if it can move: ``dtp+corrected``.
    minutes : float
        Measured time that counts.
    excluded : int
        Windows left out, with the runs' reasons.
    figures : mapping of str to Judged
        By metric: ``l95_ms``, ``window_l95_ms`` (mean of the L95 that the controller saw),
        ``violation_rate``, ``u_NODE``, ``share_CANDIDATE``, ``migrations`` (per run), and the
        conditions ``dominant`` (shares of windows) and ``sum_of_means`` (L95, ms).
    dominant : tuple of str
        The placement of most windows: measured, and predicted.
    allowed_rates : tuple of float
        V_D of the predicted latencies times 0.9, and times 1.1.
    factor : float
        Factor on the predicted latencies that gives the measured V_D.
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
        """Whether the measured time is too short."""
        return self.minutes < LEAST_MINUTES

    def verdict(self, goal: str) -> Outcome:
        """Return the verdict on one of `GOALS`."""
        if goal == "utilisation":
            return worst([one.verdict for one in self.uses.values()])
        return self.figures[goal].verdict

    @property
    def uses(self) -> dict[str, Judged]:
        """Utilisation by resource."""
        return {name[2:]: one for name, one in self.figures.items() if name.startswith("u_")}


@dataclass(frozen=True, slots=True, eq=False)
class Validation(Displayed):
    """Predictions and measurements.

    Parameters
    ----------
    problem : Problem
        The calibrated cell.
    groups : tuple of Group
        By scenario in the cell's order, and then by policy.
    seeds : int
        Simulations of each run.
    table : DataFrame
        One row per group and figure: ``scenario``, ``policy``, ``metric``, and ``measured``,
        ``predicted`` and ``error`` with their ends (``_low``, ``_high``), ``allowed``,
        ``sum_of_means``, ``verdict``, ``note``. Rates and utilisations are shares, the error of
        L95 is relative, all others are differences.
    jobs : DataFrame
        One row per group, task and node of the runs that kept their jobs: number of ``jobs``,
        their times from start to end (``measured_ms``, ``measured_p95_ms``, ``predicted_ms``,
        ``predicted_p95_ms``), the core time if it was measured (``core_ms``, ``core_p95_ms``) and
        the core time in the cell file (``cell_ms``, ``cell_p95_ms``).
    moves : DataFrame
        One row per move of the measured runs: ``scenario``, ``policy``, ``run``, and the estimated
        and observed values of `predicted_moves`.
    versions : mapping of str to str
        Versions of the software that simulated, by package.
    """

    problem: Problem
    groups: tuple[Group, ...]
    seeds: int
    table: pl.DataFrame
    jobs: pl.DataFrame
    moves: pl.DataFrame
    versions: Mapping[str, str]

    def __repr__(self) -> str:
        runs = sum(len(group.runs) for group in self.groups)
        return (
            f"<Validation of {self.problem.name}: {counted(len(self.groups), 'group')}, "
            f"{counted(runs, 'run')}, each simulated {counted(self.seeds, 'time')}>"
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
    """Compare the predictions of a calibrated cell with the measurements of its runs.

    Parameters
    ----------
    runs : mapping of str to Run, or sequence of Run
        By name, at least one.
    problem : Problem
        The calibrated cell.
    seeds : int
        Simulations of every run.
    calibrated_from : sequence of str
        Names or `Run.run_id` of the runs from which the cell was calibrated; they may not be
        validated on.
    usual : Usual, optional
        Speeds of the CPUs at the calibration; each run is predicted for CPUs of its own speed.
    processes : int, optional
        Number of processes; None: one per CPU for enough simulations.
    progress : callable, optional
        Takes the number of finished simulations and their total.

    Returns
    -------
    Validation

    Raises
    ------
    RunError
        If a run is of another cell, or of a scenario or policy that the cell does not have, was
        used for calibration, or has no window that counts; all faults at once.
    """
    import polars as pl

    named = (
        dict(runs)
        if isinstance(runs, Mapping)
        else {f"run {number}": run for number, run in enumerate(runs, 1)}
    )
    if not named:
        raise RunError("no runs: name at least one")
    if seeds < 2:
        raise RunError(f"seeds is {seeds}; at least 2 are needed, for intervals")
    measured = _read(named, problem, frozenset[str | None](calibrated_from), usual)
    groups = list(_grouped(measured, problem))
    complete: dict[int, tuple[Group, pl.DataFrame]] = {}
    waiting: dict[int, dict[Unit, Simulated]] = {place: {} for place in range(len(groups))}
    simulator = Simulator(tuple(map(tuple, groups)), seeds)
    units = simulator.units
    done = 0

    def take(unit: Unit, simulated: Simulated) -> None:
        # A group is judged as soon as it is complete: its simulations are not needed any longer.
        nonlocal done
        done += 1
        of_group = waiting[unit.group]
        of_group[unit] = simulated
        if len(of_group) == seeds * len(groups[unit.group]):
            ordered = [of_group[known] for known in sorted(of_group)]
            complete[unit.group] = _group(groups[unit.group], named, ordered)
            of_group.clear()
        if progress is not None:
            progress(done, len(units))

    if processes is None:
        processes = available_processes() if len(units) >= WORTH_SPREADING else 1
    spread(simulator, units, processes=processes, take=take)
    judged, jobs = zip(*(complete[place] for place in range(len(groups))), strict=True)
    return Validation(
        problem=problem,
        groups=judged,
        seeds=seeds,
        table=pl.DataFrame(list(_rows(judged)), infer_schema_length=None),
        jobs=pl.concat(jobs),
        moves=pl.concat([_moves(one, named[one.name]) for group in groups for one in group]),
        versions=versions(),
    )


def _read(
    named: Mapping[str, Run],
    problem: Problem,
    used: frozenset[str | None],
    usual: Usual | None,
) -> list[MeasuredRun]:
    """Read every run; raise one error with all faults."""
    measured: list[MeasuredRun] = []
    faults: list[str] = []
    for name, run in named.items():
        if name in used or run.run_id in used:
            faults.append(f"{name}: the cell was calibrated from this run; validate on others")
            continue
        try:
            one = read_measured(name, run, problem, usual)
            piece_of(run, one.problem, one.excluded)
            measured.append(one)
        except RunError as error:
            faults.append(str(error))
        except DwellError as error:
            faults.append(f"{name}: {error}")
    if faults:
        raise RunError("\n".join(faults))
    return measured


def _grouped(measured: Sequence[MeasuredRun], problem: Problem) -> Iterator[list[MeasuredRun]]:
    """Yield the runs of each scenario and policy; placements first, in the order of the cell."""
    places = {name: place for place, name in enumerate(problem.candidates)}
    policies = list(dict.fromkeys(one.contender for one in measured))
    policies.sort(key=lambda name: places.get(name, len(places)))
    for scenario in problem.scenarios:
        for policy in policies:
            runs = [one for one in measured if (one.scenario, one.contender) == (scenario, policy)]
            if runs:
                yield runs


def _group(
    mine: Sequence[MeasuredRun], runs: Mapping[str, Run], simulated: Sequence[Simulated]
) -> tuple[Group, pl.DataFrame]:
    """Judge a group."""
    own = [piece_of(runs[one.name], one.problem, one.excluded) for one in mine]
    problem = mine[0].problem
    measured = QosSample.of(own, problem, by_window=True)
    predicted = QosSample.of([one.piece for one in simulated], problem, by_window=False)
    judge = GroupJudge(problem, measured, predicted, *_sums(mine, own, problem))
    figures = judge.figures()
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
        dominant=judge.dominant,
        allowed_rates=judge.allowed_rates,
        factor=predicted.factor_for(figures["violation_rate"].measured.value),
    )
    jobs = job_times(
        group.scenario,
        group.policy,
        problem,
        [finished_jobs(runs[one.name], problem.window_cycles) for one in mine if one.jobs],
        [one.jobs for one in simulated if one.jobs is not None],
    )
    return group, jobs


def _moves(one: MeasuredRun, run: Run) -> pl.DataFrame:
    """Return the predicted moves of a run, after its labels."""
    import polars as pl

    labels = {"scenario": one.scenario, "policy": one.contender, "run": one.name}
    moves = predicted_moves(run, one.excluded)
    return moves.select(*(pl.lit(text).alias(name) for name, text in labels.items()), pl.all())


def _sums(
    mine: Sequence[MeasuredRun], own: Sequence[Piece], problem: Problem
) -> tuple[float, float]:
    """Return L95 and V_D of the sum-of-means predictor for the measured placements."""
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


def _rows(groups: Sequence[Group]) -> Iterator[dict[str, str | float]]:
    """Yield the rows of the table."""
    for group in groups:
        for one in group.figures.values():
            yield {
                "scenario": group.scenario,
                "policy": group.policy,
                "metric": one.metric,
                **one.measured.columns("measured"),
                **one.predicted.columns("predicted"),
                **one.error.columns("error"),
                "allowed": one.allowed,
                "sum_of_means": one.baseline,
                "verdict": one.verdict,
                "note": one.note,
            }
