"""Compare policies: every scenario, policy and seed, and intervals over the seeds.

Realisations are drawn once for each scenario and seed, and every policy plays the same one. What
one policy gains over another is therefore a difference of pairs, free of what luck gave to both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.model import Problem
from dwell.study.intervals import (
    Interval,
    mean_interval,
    median_interval,
    share_interval,
    share_limits,
)
from dwell.study.summary import Row, Summary, latency_grid_ms, summarise
from dwell.study.workers import available_processes, spread

if TYPE_CHECKING:
    import polars as pl

    from dwell.policies import MinimalPolicy

__all__ = ["AIM", "Comparison", "Example", "compare"]

Floats: TypeAlias = NDArray[np.float64]
Contenders: TypeAlias = "Mapping[str, MinimalPolicy | str]"
Progress: TypeAlias = Callable[[int, int], None]

#: Share of missed deadlines that a cell should stay under (the paper's 5 %).
AIM = 0.05


@dataclass(frozen=True, slots=True)
class Example:
    """One run kept whole, for pictures: its windows and decisions."""

    windows: pl.DataFrame
    decisions: pl.DataFrame


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Runs of policies on the same realisations, and the statistics over their seeds.

    Parameters
    ----------
    problem : Problem
    scenarios, policies : tuple of str
        In the order of tables and figures; a policy that has a candidate's name never moves.
    seeds : tuple of int
    windows : int
        Length of every run, the warm-up included.
    runs : DataFrame
        One row a run: ``scenario``, ``policy``, ``seed`` and what `dwell.study.summary` makes of
        it.
    costs : DataFrame
        One row a run and candidate: mean J ``estimated`` while it was not active (against the
        incumbent, switching term included), mean J ``measured`` while it was.
    latencies : DataFrame
        Distribution of final latencies over all seeds: ``share`` of the cycles that finished
        within ``latency_ms``, by scenario and policy. It stays below 1 where cycles were lost.
    examples : mapping of (scenario, policy) to Example
        The runs of the first seed.
    versions : mapping of str to str
        Of the software that made the runs.
    """

    problem: Problem
    scenarios: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    windows: int
    runs: pl.DataFrame
    costs: pl.DataFrame
    latencies: pl.DataFrame
    examples: Mapping[tuple[str, str], Example]
    versions: Mapping[str, str]

    @property
    def statics(self) -> tuple[str, ...]:
        """Policies that are a candidate's placement and never move."""
        return tuple(name for name in self.policies if name in self.problem.candidates)

    def values(self, scenario: str, policy: str, column: str) -> Floats:
        """One number a seed, in the order of the seeds."""
        import polars as pl

        mine = self.runs.filter((pl.col("scenario") == scenario) & (pl.col("policy") == policy))
        return mine[column].cast(pl.Float64).to_numpy()

    def interval(self, scenario: str, policy: str, column: str) -> Interval:
        """Return a column over seeds: its mean, or its median where it may be infinite."""
        return _kind(column)(self.values(scenario, policy, column))

    def difference(self, scenario: str, policies: tuple[str, str], column: str) -> Interval:
        """Return the mean over seeds of what the first policy shows less what the second does."""
        first, second = (self.values(scenario, policy, column) for policy in policies)
        return mean_interval(first - second)

    def table(self) -> pl.DataFrame:
        """Return one row a scenario and policy: every column over seeds with its 95 % interval.

        Returns
        -------
        DataFrame
            For each column x of `runs`: ``x``, ``x_low`` and ``x_high`` (see `interval`; null
            ends where one seed gives none), and for the violation rate also its one-sided limits
            ``violation_rate_at_least`` and ``violation_rate_at_most``.
        """
        import polars as pl

        columns = [name for name in self.runs.columns if name not in ("scenario", "policy", "seed")]
        rows: list[Row] = []
        for scenario in self.scenarios:
            for policy in self.policies:
                row: Row = {"scenario": scenario, "policy": policy, "seeds": len(self.seeds)}
                for column in columns:
                    over = self.interval(scenario, policy, column)
                    row |= {column: over.value, f"{column}_low": over.low}
                    row[f"{column}_high"] = over.high
                rate = self.values(scenario, policy, "violation_rate")
                at_least, at_most = share_limits(rate)
                row["violation_rate_at_least"] = at_least
                row["violation_rate_at_most"] = at_most
                rows.append(row)
        return pl.DataFrame(rows, infer_schema_length=None).fill_nan(None)


def compare(
    problem: Problem,
    *,
    scenarios: Sequence[str] | None = None,
    policies: Sequence[str] | Contenders,
    seeds: Sequence[int],
    windows: int,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run every scenario, policy and seed.

    Parameters
    ----------
    problem : Problem
    scenarios : sequence of str, optional
        All of the problem's where None.
    policies : sequence of str, or mapping of str to policy or str
        Names (`dtp`, a candidate's, ...), or policies of your own by the name they shall have in
        the tables. A policy that is an object must pickle where there are several processes.
    seeds : sequence of int
        All different; the result is the same for the same seeds, whatever `processes` is.
    windows : int
        Of every run; more than the problem's warm-up.
    processes : int, optional
        Over which the runs are spread; one a CPU where None (see `dwell.study.workers`).
    progress : callable, optional
        Called with the number of runs done and of all runs, after every few.

    Returns
    -------
    Comparison

    Raises
    ------
    ProblemError, PolicyError, TraceError
        If something named is unknown, or a trace is too short.
    SimulationError
        If a number is out of its range, or a worker process ended early.
    """
    scenarios = tuple(problem.scenarios if scenarios is None else scenarios)
    contenders = policies if isinstance(policies, Mapping) else {name: name for name in policies}
    plan = _Plan(problem, dict(contenders), windows, tuple(seeds)[:1])
    _check(plan, scenarios, tuple(policies), tuple(seeds))
    units = [(scenario, seed) for scenario in scenarios for seed in seeds]
    versions = plan.rehearse(scenarios)
    count = 0

    def done() -> None:
        nonlocal count
        count += len(contenders)
        if progress is not None:
            progress(count, len(units) * len(contenders))

    workers = available_processes() if processes is None else processes
    played = spread(plan, units, processes=workers, done=done)
    return _gather(plan, scenarios, tuple(seeds), dict(zip(units, played, strict=True)), versions)


@dataclass(frozen=True, slots=True)
class _Played:
    """What the policies made of one realisation."""

    summaries: Mapping[str, Summary]
    examples: Mapping[str, Example]


@dataclass(frozen=True, slots=True)
class _Plan:
    """All that is the same for every scenario and seed; it is sent to every process."""

    problem: Problem
    policies: Mapping[str, MinimalPolicy | str]
    windows: int
    kept: tuple[int, ...]

    def __call__(self, unit: tuple[str, int]) -> _Played:
        """Draw the realisation of a scenario and seed and let every policy play it."""
        from dwell.sim import draw, simulate_realisation

        scenario, seed = unit
        realisation = draw(self.problem, scenario=scenario, seed=seed, windows=self.windows)
        summaries, examples = {}, {}
        for name, policy in self.policies.items():
            run = simulate_realisation(self.problem, realisation, policy=policy)
            labels: dict[str, str | int] = {"scenario": scenario, "policy": name, "seed": seed}
            summaries[name] = summarise(run, self.problem, labels)
            if seed in self.kept:
                examples[name] = Example(run.windows, run.decisions)
        return _Played(summaries, examples)

    def rehearse(self, scenarios: Sequence[str]) -> dict[str, str]:
        """Play one window of everything; return the versions that were at work.

        What is named wrongly is found before the work begins, and the kernels are compiled (or
        loaded) once and not by every process at the same time.
        """
        from dwell.sim import draw, simulate_realisation

        versions: dict[str, str] = {}
        for scenario in scenarios:
            realisation = draw(self.problem, scenario=scenario, seed=0, windows=1)
            for policy in self.policies.values():
                run = simulate_realisation(self.problem, realisation, policy=policy)
                versions = run.meta["versions"]
        return versions


def _check(
    plan: _Plan, scenarios: tuple[str, ...], policies: tuple[str, ...], seeds: tuple[int, ...]
) -> None:
    """Refuse what no comparison can be made of."""
    for what, given in (("scenarios", scenarios), ("policies", policies), ("seeds", seeds)):
        if not given:
            raise SimulationError(f"{what} is empty; name at least one")
        if len(set(given)) < len(given):
            twice = next(item for item in given if given.count(item) > 1)
            raise SimulationError(f"{what} holds {twice!r} twice; name each once")
    warmup = plan.problem.warmup_windows
    if plan.windows <= warmup:
        raise SimulationError(
            f"windows is {plan.windows}; it must be more than the {warmup} windows of warm-up"
        )


def _gather(
    plan: _Plan,
    scenarios: tuple[str, ...],
    seeds: tuple[int, ...],
    played: Mapping[tuple[str, int], _Played],
    versions: Mapping[str, str],
) -> Comparison:
    """Put what the processes sent back into tables."""
    import polars as pl

    policies = tuple(plan.policies)
    grid = latency_grid_ms(plan.problem.pipeline.deadline_ms)
    rows: list[Row] = []
    costs: list[Row] = []
    latencies = []
    for scenario in scenarios:
        for policy in policies:
            mine = [played[scenario, seed].summaries[policy] for seed in seeds]
            rows += [summary.row for summary in mine]
            costs += [row for summary in mine for row in summary.costs]
            within = np.sum([summary.within for summary in mine], axis=0)
            cycles = sum(int(summary.row["cycles"]) for summary in mine)
            latencies.append(
                pl.DataFrame({"latency_ms": grid, "share": within / cycles}).select(
                    pl.lit(scenario).alias("scenario"), pl.lit(policy).alias("policy"), pl.all()
                )
            )
    return Comparison(
        problem=plan.problem,
        scenarios=scenarios,
        policies=policies,
        seeds=seeds,
        windows=plan.windows,
        runs=pl.DataFrame(rows, infer_schema_length=None),
        costs=pl.DataFrame(costs, infer_schema_length=None).fill_nan(None),
        latencies=pl.concat(latencies),
        examples={
            (scenario, policy): played[scenario, seed].examples[policy]
            for scenario in scenarios
            for policy in policies
            for seed in plan.kept
        },
        versions=versions,
    )


def _kind(column: str) -> Callable[[Floats], Interval]:
    """Which interval a column of `Comparison.runs` takes."""
    if column in ("p95_ms", "p50_ms", "spread_ms"):
        return median_interval
    if column == "violation_rate" or column.startswith("share_"):
        return share_interval
    return mean_interval
