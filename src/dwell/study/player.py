"""Player: simulates a batch of a study's items, in any process.

A contender may have its own objective: its controller minimises that J, and the J of the point
judges its runs. Both use the same measurements of a window.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING

from dwell.errors import SimulationError
from dwell.estimators.prices import KNOWN_PRICES, Price, Question
from dwell.model import Problem
from dwell.model.bounds import counted
from dwell.study.hindsight import Hindsight
from dwell.study.independence import unit_of
from dwell.study.judged_cost import judged_cost
from dwell.study.over_seeds import UNIT
from dwell.study.own_metrics import own_metric
from dwell.study.reference import CLAIRVOYANT, few_misses, play_alone, references
from dwell.study.software import software
from dwell.study.study import TAKEN, Contender, Item, Study
from dwell.study.summary import Summary, summarise

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run
    from dwell.sim import Realisation

#: Target time of a batch, seconds: a process loses at most this work and one item.
BATCH_S = 1.0
#: Columns by which tables compare runs with the references.
COMPARED = frozenset(
    {
        "kept",
        "asked",
        "reference_cost",
        "best_static",
        "regret",
        "oracle_regret",
        "share_kept",
        "point",
        "costs",
        "within",
    }
)


@dataclass(frozen=True, slots=True)
class Example:
    """Windows and decisions of one run, for figures."""

    windows: pl.DataFrame
    decisions: pl.DataFrame

    def __repr__(self) -> str:
        windows, decisions = self.windows.height, self.decisions.height
        return f"<Example: {counted(windows, 'window')}, {counted(decisions, 'decision')}>"


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive items of a study, and the players to simulate.

    Parameters
    ----------
    first : int
        Index of the first item in the study.
    players : tuple of str
        A subset of `Study.players`.
    """

    first: int
    items: tuple[Item, ...]
    players: tuple[str, ...]

    @property
    def end(self) -> int:
        """Index after the last item."""
        return self.first + len(self.items)

    def split(self, count: int) -> tuple[Batch, Batch | None]:
        """Return the first items, and the rest; None for an empty rest."""
        begun, left = self.items[:count], self.items[count:]
        rest = replace(self, first=self.first + count, items=left) if left else None
        return replace(self, items=begun), rest


@dataclass(frozen=True, slots=True)
class PlayedBatch:
    """Results of the simulated items of a batch.

    Parameters
    ----------
    batch : Batch
        The simulated items.
    rest : Batch, optional
        The other items.
    summaries : mapping of str to list of (int, Summary)
        Index of the point and summary of each run, by player.
    examples : mapping of (Item, int, str) to Example
        Runs of the kept seeds, by item, point and policy.
    """

    batch: Batch
    rest: Batch | None
    summaries: Mapping[str, list[tuple[int, Summary]]]
    examples: Mapping[tuple[Item, int, str], Example]


@dataclass(frozen=True, slots=True)
class Player:
    """Samples the realisations of items and simulates contenders on them.

    Parameters
    ----------
    software : mapping of str to str
        Software of the main process; a worker with other software refuses a batch.
    kept : tuple of int
        Seeds whose runs are kept as examples.
    prices : dict
        Prices of candidates that the main process has simulated (see `rehearse`).
    """

    study: Study
    software: Mapping[str, str] = field(default_factory=software)
    kept: tuple[int, ...] = ()
    prices: dict[Question, Mapping[str, Price]] = field(
        default_factory=dict, repr=False, compare=False
    )
    # Cache of problems with the settings of contenders, by point and contender.
    _seen: dict[tuple[int, str], Problem] = field(default_factory=dict, repr=False, compare=False)

    def __call__(self, batch: Batch) -> PlayedBatch:
        """Simulate a batch for about `BATCH_S`, at least one item.

        Each item is sampled once for all its players.

        Raises
        ------
        SimulationError
            If this process and the sender of the batch differ in their software, or a metric fails.
        """
        mine = software()
        differing = [name for name in mine if mine[name] != self.software.get(name)]
        if differing:
            has = ", ".join(f"{name} {mine[name]}" for name in differing)
            needs = ", ".join(f"{name} {self.software.get(name)}" for name in differing)
            raise SimulationError(
                f"a worker has other software than the process that asks it: {has}, not {needs}"
            )
        KNOWN_PRICES.add(self.prices)
        summaries: dict[str, list[tuple[int, Summary]]] = {name: [] for name in batch.players}
        examples: dict[tuple[Item, int, str], Example] = {}
        until, done = time.monotonic() + BATCH_S, 0
        for item in batch.items:
            for player, point, run, summary in self._play(item, batch.players):
                summaries[player].append((point, summary))
                if run is not None and item.seed in self.kept:
                    key = (item, point, str(summary.row["policy"]))
                    examples[key] = Example(run.windows, run.decisions)
            done += 1
            if time.monotonic() > until:
                break
        return PlayedBatch(*batch.split(done), summaries, examples)

    def rehearse(self) -> None:
        """Simulate one window of each scenario and contender, at the first point per estimator.

        This finds wrong names before the work begins.
        """
        from dwell.sim import draw
        from dwell.sim.fleet import simulate_fleet

        points, contenders = self.study.points, self.study.contenders
        # In reverse order, so the first point of each estimator replaces the later points.
        firsts = {points[i].problem.controller.estimator: i for i in reversed(range(len(points)))}
        for index, scenario in product(firsts.values(), self.study.scenarios):
            first, problem = points[index], points[index].problem
            if first.fleet is not None:
                fleet = replace(first.fleet, coordination="none")
                for contender in contenders:
                    simulate_fleet(contender.fleet(fleet, scenario), seed=0, windows=1)
                continue
            realisation = draw(problem, scenario=scenario, seed=0, windows=1)
            alone = (
                play_alone(problem, realisation) if any(map(_in_hindsight, contenders)) else None
            )
            for contender in contenders:
                problem.objective.require_judgeable(self._problem(contender, index).objective)
                self._simulate(contender, index, realisation, alone)
        self.prices.update(KNOWN_PRICES.known)

    def _play(
        self, item: Item, players: Sequence[str]
    ) -> Iterator[tuple[str, int, Run | None, Summary]]:
        """Yield player, point, run and summary of every run of some players on an item."""
        from dwell.sim import draw

        contenders = [one for one in self.study.contenders if one.name in players]
        first = self.study.points[item.points[0]]
        if first.fleet is not None:
            yield from self._play_fleets(item, contenders)
            return
        realisation = draw(
            first.problem, scenario=item.scenario, seed=item.seed, windows=self.study.windows
        )
        for point in item.points:
            problem, known, alone = self.study.points[point].problem, None, None
            if self.study.references and CLAIRVOYANT in players:
                known = references(problem, realisation)
                alone = known.statics
            elif any(map(_in_hindsight, contenders)):
                alone = play_alone(problem, realisation)
            for contender in contenders:
                seen = self._problem(contender, point)
                # The static references have the estimator `profile`, without shadow jobs.
                own = seen.controller.estimator
                is_static = contender.is_candidate(seen) and own in (None, "profile")
                if known is not None and is_static:
                    run = known.statics[str(contender.policy)]
                else:
                    run = self._simulate(contender, point, realisation, alone)
                summary = self._summary(run, problem, _labels(item, contender.name))
                if seen.objective != problem.objective:
                    cost = judged_cost(run, problem)
                    summary = replace(summary, row={**summary.row, "cost": cost})
                yield contender.name, point, run, summary
            if known is None:
                continue
            found: dict[str, float | str | bytes] = {
                "reference_cost": known.cost,
                "best_static": known.best_static,
                "asked": few_misses(known.run, problem).tobytes(),
            }
            for name, run in known.runs.items():
                summary = self._summary(run, problem, _labels(item, name))
                compared = {**summary.compared, **found}
                yield CLAIRVOYANT, point, run, replace(summary, compared=compared)

    def _play_fleets(
        self, item: Item, contenders: Sequence[Contender]
    ) -> Iterator[tuple[str, int, None, Summary]]:
        """Yield the summary of the fleet's run at every point with every contender."""
        from dwell.sim.fleet import simulate_fleet
        from dwell.study.fleet_summary import summarise_fleet

        for point in item.points:
            fleet, windows = self.study.points[point].fleet, self.study.windows
            if fleet is None:
                continue
            for contender in contenders:
                played = contender.fleet(fleet, item.scenario)
                run = simulate_fleet(played, seed=item.seed, windows=windows)
                labels = _labels(item, contender.name)
                summary = summarise_fleet(run, fleet, labels)
                worst = run.cells[str(summary.row["worst_cell"])]
                unit = unit_of(((one.cell, one.scenario) for one in played.entries), windows)
                yield contender.name, point, None, self._completed(summary, worst, unit, labels)

    def _summary(self, run: Run, problem: Problem, labels: Mapping[str, str | int]) -> Summary:
        """Return the summary of a cell's run."""
        unit = unit_of([(problem, str(labels["scenario"]))], self.study.windows)
        summary = self._completed(summarise(run, problem, labels), run, unit, labels)
        if self.study.references:
            kept = few_misses(run, problem).tobytes()
            summary = replace(summary, compared={"kept": kept})
        return summary

    def _completed(
        self, summary: Summary, run: Run, unit: str, labels: Mapping[str, str | int]
    ) -> Summary:
        """Add the independent unit of a run, and the study's own metrics."""
        summary = replace(summary, row={**summary.row, UNIT: unit})
        taken = [name for name in self.study.metrics if name in summary.row or name in COMPARED]
        if taken:
            raise SimulationError(f"metrics.{taken[0]}: {TAKEN}")
        where = "policy {policy}, scenario {scenario}, seed {seed}".format_map(labels)
        own = {
            name: own_metric(path, self.study.folder, run, f"metrics.{name} ({path}): {where}")
            for name, path in self.study.metrics.items()
        }
        return replace(summary, row={**summary.row, **own})

    def _simulate(
        self,
        contender: Contender,
        point: int,
        realisation: Realisation,
        alone: Mapping[str, Run] | None,
    ) -> Run:
        """Simulate a contender; `alone` are the candidates' static runs, for `Hindsight`."""
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

    def _problem(self, contender: Contender, point: int) -> Problem:
        """Return the problem of a point with a contender's settings, cached."""
        key = (point, contender.name)
        if key not in self._seen:
            self._seen[key] = contender.problem(self.study.points[point].problem)
        return self._seen[key]


def _labels(item: Item, policy: str) -> dict[str, str | int]:
    return {"scenario": item.scenario, "policy": policy, "seed": item.seed}


def _in_hindsight(contender: Contender) -> bool:
    """Whether a contender needs the runs of every candidate alone."""
    return isinstance(contender.estimator, Hindsight)
