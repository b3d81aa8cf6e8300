"""Search for the placements with the least J among all placements of a cell.

Branch and bound: tasks are placed in topological order, and a partial placement is given up if a
lower bound of J (`dwell.estimators.cost_bounds`) exceeds the worst placement that would be
returned. The kernel simulates all others, on the same samples, so the result is exact.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, islice, pairwise
from typing import NamedTuple

import numpy as np

from dwell.cost import cost, price
from dwell.errors import PlacementError, SimulationError
from dwell.estimators.any_placement import AnyPlacement, Measured
from dwell.estimators.cost_bounds import CostBounds, Partial
from dwell.estimators.prices import DISTURBED, MOST_CYCLES
from dwell.estimators.slow_processes import mean_and_error
from dwell.model.bounds import require
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.process import Constant
from dwell.model.qos import QoS

#: Cycles of the first search, which are doubled until the best placements differ.
FIRST_CYCLES = 1_000
#: Most partial placements that a search looks at.
MOST_NODES = 1_000_000
#: Relative rounding of a lower bound of J.
ROUNDING = 1e-9
#: Standard errors by which the two best placements must differ to be told apart.
APART = 2.0


class Ranked(NamedTuple):
    """A placement with its mean QoS and its J; of several scenarios, those with the largest J."""

    placement: Placement
    qos: QoS
    cost: float


@dataclass(frozen=True)
class Ranking:
    """The best placements of a search.

    Parameters
    ----------
    best : tuple of Ranked
        In ascending order of J; with equal J in the file's order of nodes, task by task.
    cycles : int
        Simulated cycles per placement and scenario.
    is_exact : bool
        Whether no other placement has a smaller J on these samples.
    gap : float
        Largest share of the best J by which another placement may be cheaper; 0 if exact.
    placements : int
        Number of placements of the cell, feasible or not.
    looked : int
        Partial and complete placements whose bound was computed.
    simulated : int
        Placements that the kernel simulated.
    pruned : mapping of str to int
        Number of placements that were not simulated, by reason.
    difference : tuple of float
        J of the second placement minus J of the first, and the standard error of this difference;
        NaN if fewer than two were found, an infinite error for a single window.
    """

    best: tuple[Ranked, ...]
    cycles: int
    is_exact: bool
    gap: float
    placements: int
    looked: int
    simulated: int
    pruned: Mapping[str, int]
    difference: tuple[float, float]

    @property
    def is_tie(self) -> bool:
        """Whether the samples do not show which of the two best placements is better."""
        gain, error = self.difference
        return bool(gain < APART * error) or gain == 0.0


def search(
    problem: Problem,
    cycles: int = 1000,
    seed: int = 0,
    top: int = 8,
    scenario: str = "baseline",
) -> list[tuple[Placement, QoS, float]]:
    """Return the feasible placements with the least J, without the switching term, best first.

    Parameters
    ----------
    problem : Problem
        Its candidates do not matter.
    cycles : int
        Simulated cycles of each placement, the same for all, at least 1, and enough for a run of
        each sink. A scenario with disturbances is simulated for 300 windows instead.
    seed : int
        Of the samples, at least 0.
    top : int
        Number of placements to return, at least 1.
    scenario : str
        Name of a scenario.

    Returns
    -------
    list of (Placement, QoS, float)
        The placement of all tasks, its mean metrics over the windows, and its J. Equal J are in the
        file's order of nodes, task by task.

    Raises
    ------
    ProblemError
        If the scenario does not exist, the objective has ages or a cap on misses, or a sink does
        not run in `cycles`.
    PlacementError
        If no placement is feasible; with the reasons.
    SimulationError
        If `cycles`, `seed` or `top` is out of range.
    """
    ranking = rank(problem, (scenario,), cycles=cycles, seed=seed, top=top)
    return [(one.placement, one.qos, one.cost) for one in ranking.best]


def rank(
    problem: Problem,
    scenarios: Sequence[str] = ("baseline",),
    *,
    cycles: int = 1000,
    seed: int = 0,
    top: int = 8,
    most: int = MOST_NODES,
) -> Ranking:
    """Search as `search` does; J is the largest of the scenarios.

    `most` is the largest number of partial placements to look at.
    """
    problem.objective.require_searchable()
    for name, value, least in (("cycles", cycles, 1), ("seed", seed, 0), ("top", top, 1)):
        if isinstance(value, bool) or value < least:
            raise SimulationError(
                f"{name} is {value!r}; it must be a whole number of at least {least}"
            )
    require_runs(problem, cycles)
    # A realisation needs at least one candidate; replicas are not searched.
    named = problem.plain_candidates or {"first": _first_linked(problem)}
    controller = replace(problem.controller, initial=None, fallbacks=(), policy="dtp")
    problem = replace(problem, candidates=named, every_placement=None, controller=controller)
    samples = [_sample(problem, scenario, cycles, seed) for scenario in scenarios]
    found = _Search(problem, samples, scenarios, top, most)
    found.run()
    return found.ranking()


def require_runs(problem: Problem, cycles: int, path: str = "cycles") -> None:
    """Refuse too few cycles for a run of each sink.

    Raises
    ------
    ProblemError
        If there are fewer; the fault is at `path`.
    """
    interval = problem.pipeline.sink_cycles
    bound = f"at least {interval}, the cycles from one run to the next of the slowest sink"
    require(cycles >= interval, path, cycles, bound)


def rank_until_apart(
    problem: Problem, scenarios: Sequence[str] = ("baseline",), *, seed: int = 0, top: int = 8
) -> Ranking:
    """Search with twice the cycles until the two best placements differ, or `MOST_CYCLES`.

    Scenarios with disturbances have a fixed length, and are searched once.
    """
    cycles = max(FIRST_CYCLES, problem.pipeline.sink_cycles)
    while True:
        ranking = rank(problem, scenarios, cycles=cycles, seed=seed, top=max(top, 2))
        is_fixed = any(problem.scenario(name) for name in scenarios)
        if not ranking.is_tie or is_fixed or len(ranking.best) < 2 or cycles >= MOST_CYCLES:
            return replace(ranking, best=ranking.best[:top])
        cycles = min(2 * cycles, MOST_CYCLES)


def _sample(problem: Problem, scenario: str, cycles: int, seed: int) -> AnyPlacement:
    """Sample a scenario; its windows are as long as the cell's if `cycles` allows."""
    if problem.scenario(scenario):
        return AnyPlacement(problem, scenario, seed=seed, windows=DISTURBED)
    windows = max(cycles // problem.window_cycles, 1)
    windows = next(number for number in range(windows, 0, -1) if cycles % number == 0)
    width = cycles // windows
    if width != problem.window_cycles:
        controller = replace(problem.controller, decide_cycles=width, min_dwell_cycles=0)
        problem = replace(problem, window_cycles=width, controller=controller)
    return AnyPlacement(problem, scenario, seed=seed, windows=windows)


class _Open(NamedTuple):
    """A partial placement on every sample, and the lower bound of its J."""

    bound: float
    partials: tuple[Partial, ...]


class _Search:
    """The state of a search."""

    def __init__(
        self,
        problem: Problem,
        samples: Sequence[AnyPlacement],
        scenarios: Sequence[str],
        top: int,
        most: int,
    ) -> None:
        self._problem, self._samples, self._top, self._most = problem, samples, top, most
        self._bounds = [CostBounds(sample) for sample in samples]
        self._order = self._bounds[0].order
        self._on = {name: tuple(problem.pipeline.tasks[name].on) for name in self._order}
        constant = not any(problem.scenario(name) for name in scenarios)
        self._twins = tuple(twins(problem)) if constant else ()
        self._before = {node: before for group in self._twins for before, node in pairwise(group)}
        self._measured: dict[Placement, tuple[Ranked, Measured]] = {}
        #: J of the best placements so far, at most as many as are returned, ascending.
        self._lowest: list[float] = []
        self._pruned: Counter[str] = Counter()
        #: Number of simulated candidates by the nodes of their first tasks.
        self._begun: Counter[tuple[str, ...]] = Counter()
        self._looked = 0
        self._left = math.inf

    def run(self) -> None:
        """Look at all placements, or at the most that are allowed."""
        for placement in (one.first for one in self._problem.plain_candidates.values()):
            if not self._is_overloaded(placement):
                self._measure(placement)
        for measured in self._measured:
            canonical = self._canonical(measured.first, self._order).first
            self._begun.update(accumulate((canonical[name],) for name in self._order))
        stack = [_Open(0.0, tuple(bounds.root for bounds in self._bounds))]
        while stack:
            if self._looked >= self._most:
                self._left = min(one.bound for one in stack)
                return
            one = stack.pop()
            if self._exceeds(one.bound):
                nodes = one.partials[0].nodes
                self._prune("with a higher bound", nodes, self._begun[tuple(nodes.values())])
            elif len(one.partials[0].nodes) == len(self._order):
                self._measure(one.partials[0].nodes)
            else:
                stack += sorted(self._children(one), key=lambda child: -child.bound)

    def ranking(self) -> Ranking:
        """Return the best placements, and how they were found."""
        best = self._best
        if not best:
            raise _infeasible(self._problem, self._pruned)
        gap = max(1.0 - self._left / best[0].cost, 0.0) if best[0].cost else 0.0
        return Ranking(
            best=best,
            cycles=max(sample.realisation.cycles for sample in self._samples),
            is_exact=self._exceeds(self._left),
            gap=gap if not self._exceeds(self._left) else 0.0,
            placements=math.prod(map(len, self._on.values())),
            looked=self._looked,
            simulated=len(self._measured),
            pruned=dict(self._pruned),
            difference=self._difference(best),
        )

    @property
    def _best(self) -> tuple[Ranked, ...]:
        found = [one for one, _ in self._measured.values()]
        return tuple(islice(sorted(found, key=self._rank), self._top))

    def _is_overloaded(self, nodes: Mapping[str, str]) -> bool:
        bounds = self._bounds[0]
        partial = bounds.root
        for name in self._order:
            partial = bounds.placed(partial, nodes[name])
        return bounds.overloaded(partial) is not None

    def _measure(self, nodes: Mapping[str, str]) -> None:
        """Simulate a placement on every sample."""
        placement = self._canonical(nodes, self._problem.pipeline.tasks)
        if placement in self._measured:
            return
        objective, found = self._problem.objective, []
        for sample in self._samples:
            measured = sample.measure(placement.first)
            qos = measured.qos
            found.append(
                (Ranked(placement, qos, cost(qos, placement, placement, objective)), measured)
            )
        self._measured[placement] = largest = max(found, key=lambda one: one[0].cost)
        insort(self._lowest, largest[0].cost)
        del self._lowest[self._top :]

    def _canonical(self, nodes: Mapping[str, str], tasks: Iterable[str]) -> Placement:
        """Return the first placement in an order of tasks that differs from this by twins only."""
        names = {node: node for node in self._problem.fabric.nodes}
        for group in self._twins:
            used = [node for node in dict.fromkeys(nodes[task] for task in tasks) if node in group]
            names |= zip(used, group, strict=False)
        return Placement({task: names[nodes[task]] for task in self._problem.pipeline.tasks})

    def _difference(self, best: Sequence[Ranked]) -> tuple[float, float]:
        """Return J of the second placement minus J of the first, and its standard error."""
        if len(best) < 2:
            return math.nan, math.nan
        objective = self._problem.objective
        (_, one), (_, other) = (self._measured[ranked.placement] for ranked in best[:2])
        if len(one.l95_ms) != len(other.l95_ms):
            return best[1].cost - best[0].cost, math.inf
        # The utilisation of a placement is a mean over all windows, and has no error.
        none = np.zeros_like(one.l95_ms)
        first, second = (
            price(of.l95_ms, of.violation_rate, none, none, none, none, objective)
            for of in (one, other)
        )
        return best[1].cost - best[0].cost, mean_and_error(second - first)[1]

    def _rank(self, one: Ranked) -> tuple[float, list[int]]:
        nodes = list(self._problem.fabric.nodes)
        return one.cost, [
            nodes.index(one.placement.first[task]) for task in self._problem.pipeline.tasks
        ]

    def _exceeds(self, bound: float) -> bool:
        """Whether a bound is above J of the last placement to return."""
        if len(self._lowest) < self._top:
            return bound == math.inf
        return bound > self._lowest[-1] * (1.0 + ROUNDING) + ROUNDING

    def _children(self, one: _Open) -> Iterator[_Open]:
        """Yield the partial placements with one more task."""
        nodes = one.partials[0].nodes
        name = self._order[len(nodes)]
        for node in self._on[name]:
            if not is_linked(self._problem, nodes, name, node):
                self._pruned["without a link"] += self._completions(len(nodes) + 1)
                continue
            used = set(nodes.values())
            if node in self._before and self._before[node] not in used:
                self._pruned["twins of others"] += self._completions(len(nodes) + 1)
                continue
            partials = tuple(
                bounds.placed(partial, node)
                for bounds, partial in zip(self._bounds, one.partials, strict=True)
            )
            full = self._bounds[0].overloaded(partials[0])
            if full is not None:
                self._prune(f"over the capacity of {full}", partials[0].nodes)
                continue
            self._looked += 1
            bound = max(
                bounds.cost(partial) for bounds, partial in zip(self._bounds, partials, strict=True)
            )
            yield _Open(bound, partials)

    def _prune(self, reason: str, nodes: Mapping[str, str], simulated: int = 0) -> None:
        """Count the placements with these nodes, except the simulated ones."""
        self._pruned[reason] += self._completions(len(nodes)) - simulated

    def _completions(self, placed: int) -> int:
        """Return how many placements have the same nodes of the first tasks."""
        return math.prod(len(self._on[name]) for name in self._order[placed:])


def is_linked(problem: Problem, nodes: Mapping[str, str], name: str, node: str) -> bool:
    """Return whether a task on a node is linked to its sources, whose nodes are known."""
    links = problem.fabric.links
    return all(
        nodes[flow.source] == node or f"{nodes[flow.source]}->{node}" in links
        for flow in problem.pipeline.inputs(name)
    )


def _first_linked(problem: Problem) -> Placement:
    """Return a placement whose flows all have links; raise PlacementError without one."""
    tasks, order = problem.pipeline.tasks, problem.pipeline.topological()
    pruned: Counter[str] = Counter()
    stack: list[dict[str, str]] = [{}]
    for _ in range(MOST_NODES):
        if not stack:
            break
        nodes = stack.pop()
        if len(nodes) == len(order):
            return Placement({name: nodes[name] for name in tasks})
        name = order[len(nodes)]
        on = [node for node in tasks[name].on if is_linked(problem, nodes, name, node)]
        rest = math.prod(len(tasks[other].on) for other in order[len(nodes) + 1 :])
        pruned["without a link"] += (len(tasks[name].on) - len(on)) * rest
        stack += [{**nodes, name: node} for node in reversed(on)]
    raise _infeasible(problem, pruned)


def _infeasible(problem: Problem, pruned: Mapping[str, int]) -> PlacementError:
    reasons = ", ".join(f"{number} {reason}" for reason, number in pruned.items())
    return PlacementError(f"no placement of {problem.name!r} is feasible: {reasons}")


def twins(problem: Problem) -> Iterator[tuple[str, ...]]:
    """Yield groups of nodes that can be exchanged without any effect, in the file's order.

    Samples differ by the names of nodes, so everything on such nodes is constant.
    """
    left = list(problem.fabric.nodes)
    while left:
        first = left.pop(0)
        group = [first, *(node for node in left if _are_twins(problem, first, node))]
        left = [node for node in left if node not in group]
        if len(group) > 1:
            yield tuple(group)


def _are_twins(problem: Problem, one: str, other: str) -> bool:
    nodes, objective = problem.fabric.nodes, problem.objective
    if replace(nodes[one], name=other) != nodes[other] or not _is_constant(problem, one):
        return False
    if objective.tiers.get(one) != objective.tiers.get(other):
        return False
    kinds = nodes[one].accelerators
    if any(
        objective.accelerators.get(f"{one}.{kind}") != objective.accelerators.get(f"{other}.{kind}")
        for kind in kinds
    ):
        return False
    if any(task.on.get(one) != task.on.get(other) for task in problem.pipeline.tasks.values()):
        return False
    swap = {one: other, other: one}
    links = problem.fabric.links
    for link in links.values():
        source, target = (swap.get(node, node) for node in (link.source, link.target))
        if links.get(f"{source}->{target}") != replace(link, source=source, target=target):
            return False
    return True


def _is_constant(problem: Problem, node: str) -> bool:
    """Whether jobs on a node and messages on its links are never random."""
    of, links = problem.fabric.nodes[node], problem.fabric.links.values()
    executions = [task.on[node] for task in problem.pipeline.tasks.values() if node in task.on]
    return (
        of.bursts is None
        and (of.quota is None or of.quota.tick_ms == 0)
        and all(isinstance(one.exec_ms, Constant) for one in executions)
        and all(
            isinstance(link.delay_ms, Constant) and link.loss == 0 and link.bursts is None
            for link in links
            if node in (link.source, link.target)
        )
    )
