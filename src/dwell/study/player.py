"""Player: does an item of a study, wherever it is sent to.

A contender may weigh in its own way: its controller then minimises one J, and is judged by
another. What a window showed is the same for both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.estimators.prices import Price, Question, known_prices, take_over
from dwell.model import Problem
from dwell.model.bounds import counted
from dwell.study.hindsight import Hindsight
from dwell.study.judged_cost import judged_cost
from dwell.study.reference import References, kept, play_alone, references, regret
from dwell.study.software import software
from dwell.study.study import Contender, Item, Study
from dwell.study.summary import Summary, summarise

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run
    from dwell.sim import Realisation

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Example:
    """One run kept whole, for pictures: its windows and decisions."""

    windows: pl.DataFrame
    decisions: pl.DataFrame

    def __repr__(self) -> str:
        windows, decisions = self.windows.height, self.decisions.height
        return f"<Example: {counted(windows, 'window')}, {counted(decisions, 'decision')}>"


@dataclass(frozen=True, slots=True)
class PlayedItem:
    """Result of an item.

    Parameters
    ----------
    summaries : tuple of (int, Summary)
        The summary of every run, with the index of its point.
    examples : mapping of (int, str) to Example
        The runs that are kept whole, by point and policy.
    """

    summaries: tuple[tuple[int, Summary], ...]
    examples: Mapping[tuple[int, str], Example]


@dataclass(frozen=True, slots=True)
class Player:
    """Draws the realisation of an item and lets every contender play it.

    Parameters
    ----------
    software : mapping of str to str
        That of the process that asks; a process with other software refuses to play.
    kept : tuple of int
        Seeds whose runs are kept whole.
    prices : dict
        What candidates come to, as the process that asks has played them (see `rehearse`).
    """

    study: Study
    software: Mapping[str, str] = field(default_factory=software)
    kept: tuple[int, ...] = ()
    prices: dict[Question, Mapping[str, Price]] = field(
        default_factory=dict, repr=False, compare=False
    )
    # Problems as contenders see them, by point and contender: a study asks for each many times.
    _seen: dict[tuple[int, str], Problem] = field(default_factory=dict, repr=False, compare=False)

    def __call__(self, item: Item) -> PlayedItem:
        """Do an item.

        Raises
        ------
        SimulationError
            If this process runs other software than the one that asks.
        """
        from dwell.sim import draw

        mine = software()
        differing = [name for name in mine if mine[name] != self.software.get(name)]
        if differing:
            has = ", ".join(f"{name} {mine[name]}" for name in differing)
            needs = ", ".join(f"{name} {self.software.get(name)}" for name in differing)
            raise SimulationError(
                f"a worker has other software than the process that asks it: {has}, not {needs}"
            )
        take_over(self.prices)
        if self.study.points[item.points[0]].fleet is not None:
            return PlayedItem(tuple(self._play_fleets(item)), {})
        realisation = draw(
            self.study.points[item.points[0]].problem,
            scenario=item.scenario,
            seed=item.seed,
            windows=self.study.windows,
        )
        summaries: list[tuple[int, Summary]] = []
        examples: dict[tuple[int, str], Example] = {}
        for point in item.points:
            for name, run, summary in self._play(point, item, realisation):
                summaries.append((point, summary))
                if item.seed in self.kept:
                    examples[point, name] = Example(run.windows, run.decisions)
        return PlayedItem(tuple(summaries), examples)

    def rehearse(self) -> None:
        """Play one window of everything at the first point of each estimator.

        Wrong names are found before the work begins.
        """
        from dwell.sim import draw
        from dwell.sim.fleet import simulate_fleet

        points = self.study.points
        # The last assignment of a key stays, so the first point of each estimator.
        firsts = {points[i].problem.controller.estimator: i for i in reversed(range(len(points)))}
        for index, scenario in product(firsts.values(), self.study.scenarios):
            first = points[index]
            if first.fleet is not None:
                fleet = replace(first.fleet, coordination="none")
                for contender in self.study.contenders:
                    simulate_fleet(contender.fleet(fleet, scenario), seed=0, windows=1)
                continue
            realisation = draw(first.problem, scenario=scenario, seed=0, windows=1)
            alone = play_alone(first.problem, realisation) if self._in_hindsight else None
            for contender in self.study.contenders:
                self._simulate(contender, index, realisation, alone)
        self.prices.update(known_prices())

    def _play_fleets(self, item: Item) -> Iterator[tuple[int, Summary]]:
        """Yield what the fleet of every point comes to under every contender."""
        from dwell.sim.fleet import simulate_fleet
        from dwell.study.fleet_summary import summarise_fleet

        for point in item.points:
            fleet = self.study.points[point].fleet
            if fleet is None:
                continue
            for contender in self.study.contenders:
                played = contender.fleet(fleet, item.scenario)
                run = simulate_fleet(played, seed=item.seed, windows=self.study.windows)
                yield point, summarise_fleet(run, fleet, _labels(item, contender.name))

    def _play(
        self, point: int, item: Item, realisation: Realisation
    ) -> Iterator[tuple[str, Run, Summary]]:
        """Yield every run at a point, and what it comes to."""
        problem = self.study.points[point].problem
        known = references(problem, realisation) if self.study.references else None
        alone = known.statics if known is not None else None
        if alone is None and self._in_hindsight:
            alone = play_alone(problem, realisation)
        for contender in self.study.contenders:
            run = _known_run(contender, problem, known)
            if run is None:
                run = self._simulate(contender, point, realisation, alone)
            summary = summarise(run, problem, _labels(item, contender.name))
            if self._problem(contender, point).objective != problem.objective:
                summary = replace(summary, row={**summary.row, "cost": judged_cost(run, problem)})
            yield contender.name, run, _compared(summary, run, problem, known)
        if known is not None:
            for name, run in known.runs.items():
                summary = summarise(run, problem, _labels(item, name))
                yield name, run, _compared(summary, run, problem, known)

    def _simulate(
        self,
        contender: Contender,
        point: int,
        realisation: Realisation,
        alone: Mapping[str, Run] | None,
    ) -> Run:
        """Let a contender play; `alone` are the candidates' own runs, for who knows them."""
        from dwell.sim import simulate_realisation

        estimator = contender.estimator
        if isinstance(estimator, Hindsight) and alone is not None:
            estimator = estimator.of(alone)
        return simulate_realisation(
            self._problem(contender, point),
            realisation,
            policy=contender.policy,
            estimator=estimator,
        )

    @property
    def _in_hindsight(self) -> bool:
        """Whether some contender is told what every candidate alone shows."""
        return any(isinstance(one.estimator, Hindsight) for one in self.study.contenders)

    def _problem(self, contender: Contender, point: int) -> Problem:
        """Return the problem of a point as a contender sees it."""
        key = (point, contender.name)
        if key not in self._seen:
            self._seen[key] = contender.problem(self.study.points[point].problem)
        return self._seen[key]


def _known_run(contender: Contender, problem: Problem, known: References | None) -> Run | None:
    """Return the run of a bare candidate that the references have played already.

    They are played with the estimator ``profile``; shadow jobs of another one would be load.
    """
    if known is None or not contender.is_candidate(problem):
        return None
    return (
        known.statics[str(contender.policy)] if problem.controller.estimator == "profile" else None
    )


def _labels(item: Item, policy: str) -> dict[str, str | int]:
    return {"scenario": item.scenario, "policy": policy, "seed": item.seed}


def _compared(summary: Summary, run: Run, problem: Problem, known: References | None) -> Summary:
    """Add what a run costs beside the references, where there are any."""
    if known is None:
        return summary
    row = {
        **summary.row,
        "reference_cost": known.cost,
        "best_static": known.best_static,
        "regret": regret(float(summary.row["cost"]), known),
        "share_kept": kept(run, known, problem),
    }
    return replace(summary, row=row)
