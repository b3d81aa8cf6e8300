"""Compare policies: every scenario, policy and seed, and intervals over the seeds.

Realisations are drawn once for each scenario and seed, and every policy plays the same one. What
one policy gains over another is therefore a difference of pairs, free of what luck gave to both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.display import Displayed
from dwell.errors import PolicyError, SimulationError
from dwell.model import Problem
from dwell.model.semantics import nearest
from dwell.study.intervals import Interval
from dwell.study.over_seeds import difference_of, interval_of, metric_values, over_seeds
from dwell.study.player import Example, Player
from dwell.study.runner import Progress, StudyResult, play_in_memory
from dwell.study.software import versions
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

    from dwell.policies import MinimalPolicy

__all__ = ["AIM", "Comparison", "Example", "compare"]

Floats: TypeAlias = NDArray[np.float64]
Contenders: TypeAlias = "Mapping[str, MinimalPolicy | str]"

#: Share of missed deadlines that a cell should stay under (the paper's 5 %).
AIM = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Comparison(Displayed):
    """Runs of policies on the same realisations, and the statistics over their seeds.

    Parameters
    ----------
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
        The runs of the first seed; empty where they were not kept.
    versions : mapping of str to str
        Versions of the software that made the runs, by package.
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

    def __repr__(self) -> str:
        return (
            f"<Comparison on {self.problem.name}: {len(self.scenarios)} scenarios, "
            f"{len(self.policies)} policies, {len(self.seeds)} seeds, {self.windows} windows>"
        )

    @classmethod
    def of_study(cls, result: StudyResult) -> Comparison:
        """Return the runs of a study with one point.

        Raises
        ------
        SimulationError
            If the study has several points.
        """
        study = result.study
        if len(study.points) != 1:
            raise SimulationError(
                f"study {study.name} has {len(study.points)} points; a comparison is of one"
            )
        return cls(
            problem=study.points[0].problem,
            scenarios=study.scenarios,
            policies=study.policies,
            seeds=study.seeds,
            windows=study.windows,
            runs=result.runs,
            costs=result.costs,
            latencies=result.latencies,
            examples={},
            versions=result.versions,
        )

    @property
    def statics(self) -> tuple[str, ...]:
        """Policies that are a candidate's placement and never move."""
        return tuple(name for name in self.policies if name in self.problem.candidates)

    def values(self, scenario: str, policy: str, column: str) -> Floats:
        """Return one number a seed, in the order of the seeds.

        Raises
        ------
        SimulationError, PolicyError, MetricError
            If there is no such scenario, policy or column of `runs`.
        """
        import polars as pl

        for kind, what, name, known in (
            (SimulationError, "scenario", scenario, self.scenarios),
            (PolicyError, "policy", policy, self.policies),
        ):
            if name not in known:
                raise kind(f"unknown {what} {name!r}; {nearest(name, known)}")
        mine = self.runs.filter((pl.col("scenario") == scenario) & (pl.col("policy") == policy))
        return metric_values(mine, column)

    def interval(self, scenario: str, policy: str, column: str) -> Interval:
        """Return a column over seeds: its mean, or its median where it may be infinite."""
        return interval_of(column)(self.values(scenario, policy, column))

    def difference(self, scenario: str, policies: tuple[str, str], column: str) -> Interval:
        """Return the mean over seeds of what the first policy shows less what the second does.

        Its interval is that of pairs of runs, and for shares (the violation rate, say) no narrower
        than what either policy's own leaves open (see `share_difference_interval`).
        """
        first, second = (self.values(scenario, policy, column) for policy in policies)
        return difference_of(column)(first, second)

    def table(self) -> pl.DataFrame:
        """Return one row a scenario and policy: every column over seeds with its 95 % interval.

        Returns
        -------
        DataFrame
            For each column x of `runs`: ``x``, ``x_low`` and ``x_high`` (see `interval`; null
            ends where one seed gives none), and for the violation rate also its one-sided limits
            ``violation_rate_at_least`` and ``violation_rate_at_most``.
        """
        return over_seeds(self.runs, ("scenario", "policy"))


def compare(
    problem: Problem,
    *,
    scenarios: Sequence[str] | None = None,
    policies: Sequence[str | Contender] | Contenders,
    seeds: Sequence[int],
    windows: int,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run every scenario, policy and seed.

    Parameters
    ----------
    scenarios : sequence of str, optional
        All of the problem's where None.
    policies : sequence of str or Contender, or mapping of str to policy or str
        Names (`dtp`, a candidate's, ...), policies with an estimator of their own, or policies of
        your own by the name they shall have in the tables. A policy that is an object must pickle
        where there are several processes.
    seeds : sequence of int
        All different; the result is the same for the same seeds, whatever `processes` is.
    windows : int
        Length of every run; more than the problem's warm-up.
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
    if isinstance(policies, Mapping):
        contenders = [_contender(problem, name, policy) for name, policy in policies.items()]
    else:
        contenders = [
            one if isinstance(one, Contender) else _contender(problem, one, one) for one in policies
        ]
    study = Study(
        name=problem.name,
        points=(Point({}, problem),),
        scenarios=scenarios,
        contenders=tuple(contenders),
        seeds=tuple(seeds),
        windows=windows,
    )
    player = Player(study, kept=study.seeds[:1])
    tables, kept = play_in_memory(player, processes=processes, progress=progress)
    return Comparison(
        problem=problem,
        scenarios=study.scenarios,
        policies=study.policies,
        seeds=study.seeds,
        windows=windows,
        runs=tables.runs,
        costs=tables.costs,
        latencies=tables.latencies,
        examples={(item.scenario, policy): one for (item, _, policy), one in kept.items()},
        versions=versions(),
    )


def _contender(problem: Problem, name: str, policy: MinimalPolicy | str) -> Contender:
    """Return a policy of a comparison; ``cusum+corrected`` names its estimator."""
    if isinstance(policy, str):
        return Contender(name, *problem.policy_and_estimator(policy))
    return Contender(name, policy)
