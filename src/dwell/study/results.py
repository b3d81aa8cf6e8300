"""Results of a study: a table with one row per run, and statistics over the seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dwell.display import Displayed
from dwell.errors import PolicyError, SimulationError
from dwell.model import FrozenDict, Problem
from dwell.model.bounds import counted
from dwell.model.number_arrays import Floats
from dwell.model.semantics import nearest
from dwell.study.family import played_alike
from dwell.study.intervals import Interval
from dwell.study.over_seeds import (
    difference_of,
    interval_of,
    metric_values,
    over_seeds,
    windows_behind,
)

if TYPE_CHECKING:
    import polars as pl


#: Prefix of the columns with values of parameters.
PARAMETER = "parameter."


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StudyRuns(Displayed):
    """All runs of a study in numbers.

    Parameters
    ----------
    problem : Problem
        Problem of the first point.
    scenarios, policies : tuple of str
        In the order of tables and figures. A policy with the name of a candidate never moves.
    windows : int
        Length of every run, including the warm-up.
    runs : DataFrame
        One row per point, scenario, policy and seed: the point's parameters in columns that begin
        with `PARAMETER`, ``scenario``, ``policy``, ``seed``, and the numbers of
        `dwell.study.summary`. ``cost`` is J by the objective of the point, for all contenders. With
        references, also ``reference_cost``, ``best_static``, ``regret``, ``oracle_regret``, and
        ``share_kept`` (see `dwell.study.reference`).
    costs : DataFrame
        One row per run and candidate: mean J ``estimated`` while the candidate was not active
        (against the incumbent, including the switching term), mean J ``measured`` while it was
        active, both by the contender's own objective, and ``shadow_fraction``, the share of cycles
        that each alternative received as shadows while the candidate was active.
    latencies : DataFrame
        Distribution of final latencies over all seeds: ``share`` of the cycles that finished
        within ``latency_ms``, by point, scenario and policy. Lost cycles keep it below 1.
    versions : mapping of str to str
        Versions of the software that made the runs, by package.
    labels : mapping of str to str
        Names of parameters in figures and tables, by their paths.
    metrics : tuple of str
        Columns of `runs` with the study's own metrics.
    """

    name: str
    problem: Problem
    scenarios: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    windows: int
    runs: pl.DataFrame
    costs: pl.DataFrame
    latencies: pl.DataFrame
    versions: Mapping[str, str]
    labels: Mapping[str, str] = field(default_factory=FrozenDict)
    metrics: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__} {self.name}: {counted(self.runs.height, 'run')}, "
            f"{counted(len(self.scenarios), 'scenario')}, "
            f"{counted(len(self.policies), 'policy')}, {counted(len(self.seeds), 'seed')}, "
            f"{counted(self.windows, 'window')}>"
        )

    @property
    def parameters(self) -> tuple[str, ...]:
        """Columns of `runs` with values of parameters."""
        return tuple(name for name in self.runs.columns if name.startswith(PARAMETER))

    @property
    def axes(self) -> tuple[tuple[str, ...], ...]:
        """Parameter columns by axis: the first column of an axis determines the other columns.

        A constant parameter belongs to the first axis.
        """
        values = self.runs.select(self.parameters).unique()
        varying = [name for name in self.parameters if values[name].n_unique() > 1]
        axes: dict[str, list[str]] = {}
        for column in [*varying, *(name for name in self.parameters if name not in varying)]:
            for first, others in axes.items():
                if values.select(first, column).n_unique() == values[first].n_unique():
                    others.append(column)
                    break
            else:
                axes[column] = []
        return tuple((first, *others) for first, others in axes.items())

    def shown_parameter(self, column: str) -> str:
        """Return the name of a parameter's column in figures and tables."""
        path = column.removeprefix(PARAMETER)
        return self.labels.get(path, path)

    @property
    def statics(self) -> tuple[str, ...]:
        """Policies that stay at a candidate's placement."""
        return tuple(name for name in self.policies if name in self.problem.candidates)

    def values(self, scenario: str, policy: str, column: str) -> Floats:
        """Return one number per seed, in the order of the seeds.

        Raises
        ------
        SimulationError, PolicyError, MetricError
            If the scenario, policy or column of `runs` is unknown, or the study has parameters.
        """
        if self.parameters:
            raise SimulationError(
                f"study {self.name} has parameters, and so no single number a seed; filter its runs"
            )
        for kind, what, name, known in (
            (SimulationError, "scenario", scenario, self.scenarios),
            (PolicyError, "policy", policy, self.policies),
        ):
            if name not in known:
                raise kind(f"unknown {what} {name!r}; {nearest(name, known)}")
        return metric_values(self.runs.filter(scenario=scenario, policy=policy), column)

    def interval(self, scenario: str, policy: str, column: str) -> Interval:
        """Return the mean of a column over seeds, or its median if values may be infinite."""
        windows = self.windows_behind(scenario, policy)
        return interval_of(column, windows)(self.values(scenario, policy, column))

    def windows_behind(self, scenario: str, *policies: str) -> int | None:
        """Return the number of windows of the policy with the fewest; None if unknown."""
        return windows_behind(
            *(self.runs.filter(scenario=scenario, policy=policy) for policy in policies)
        )

    def difference(self, scenario: str, policies: tuple[str, str], column: str) -> Interval:
        """Return the mean difference between two policies over seeds, first minus second.

        The interval is for pairs of runs. For shares, such as the violation rate, it includes the
        uncertainty of either policy (see `share_difference_interval`). For policies with identical
        cycles the difference is 0, without an interval.
        """
        first, second = (self.values(scenario, policy, column) for policy in policies)
        one, other = ({"scenario": scenario, "policy": policy} for policy in policies)
        if played_alike(self.runs, (one, other)) and np.array_equal(first, second):
            return Interval(0.0, math.nan, math.nan)
        windows = self.windows_behind(scenario, *policies)
        return difference_of(column, windows)(first, second)

    def table(self, columns: Sequence[str] | None = None) -> pl.DataFrame:
        """Return one row per point, scenario and policy: columns over seeds with their intervals.

        Parameters
        ----------
        columns : sequence of str, optional
            Columns of `runs`. Default: all columns of numbers.

        Returns
        -------
        DataFrame
            For each column x: ``x``, ``x_low`` and ``x_high`` (see `interval`; the ends are null
            for a single seed). The violation rate also has its one-sided limits,
            ``violation_rate_at_least`` and ``violation_rate_at_most``.
        """
        return over_seeds(self.runs, (*self.parameters, "scenario", "policy"), columns)
