"""Simulation of any placement of a cell, named or not, on common samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.slow_processes import mean_and_error
from dwell.kernels.advance import play
from dwell.kernels.arrays import ordered_flows
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats
from dwell.model.problem import Problem
from dwell.model.qos import QoS


@dataclass(frozen=True, slots=True)
class Measured:
    """Metrics of a placement, by window, and its mean use of each resource."""

    l95_ms: Floats
    violation_rate: Floats
    utilisation: Mapping[str, float]
    price_per_hour: float

    @property
    def qos(self) -> QoS:
        """Means over the windows; their standard errors if there is more than one window."""
        (l95_ms, l95_error), (rate, rate_error) = map(
            mean_and_error, (self.l95_ms, self.violation_rate)
        )
        error = (l95_error, rate_error) if len(self.l95_ms) > 1 else None
        known = l95_ms, rate, self.utilisation
        return QoS(*known, error=error, price_per_hour=self.price_per_hour)


class AnyPlacement:
    """One sample of a scenario on which every placement can be simulated.

    Attributes
    ----------
    problem : Problem
        The cell with the window of the sample.
    realisation : Realisation
        With every hop that any placement can use.
    """

    def __init__(self, problem: Problem, scenario: str, *, seed: int, windows: int) -> None:
        self.problem = problem
        drawing = Drawing(problem, scenario, seed=seed, windows=windows, wraps=True, every_hop=True)
        self.realisation: Realisation = drawing.take(windows)
        self._player = CandidatePlayer([(problem, self.realisation)])
        # The placement replaces the first candidate, which all cycles use.
        self._arrays = self._player.tables({0: next(iter(problem.candidates))})
        self._sites = {site: row for row, site in enumerate(self.realisation.sites)}
        self._hops = {hop: row for row, hop in enumerate(self.realisation.hops)}
        self._flows = ordered_flows(problem.pipeline)
        tables = self._arrays.tables
        self._site_of, self._route = tables.site_of[:1].copy(), tables.route[:1].copy()
        self._arrays.replace(site_of=self._site_of, route=self._route)

    def measure(self, placement: Mapping[str, str]) -> Measured:
        """Simulate a placement of all tasks, whose flows have links."""
        arrays = self._arrays
        arrays.restart(self._player.first)
        self._site_of[0] = [
            self._sites[task, placement[task]] for task in self.problem.pipeline.tasks
        ]
        for column, flow in enumerate(self._flows):
            link = f"{placement[flow.source]}->{placement[flow.target]}"
            self._route[0, column] = self._hops.get((flow.source, flow.target, link), -1)
        play(arrays)
        windows, resources = self._player.windows(arrays), self.problem.fabric.resources
        used = windows.shares[:, 0].mean(axis=0)
        return Measured(
            l95_ms=windows.l95_ms.copy(),
            violation_rate=windows.violation_rate,
            utilisation=FrozenDict(zip(resources, used.round(12).tolist(), strict=True)),
            price_per_hour=float(windows.price_per_hour.mean().round(12)),
        )
