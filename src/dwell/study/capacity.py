"""Capacity: how many robots the shared nodes of a fleet carry under a placement or a policy.

A size is how many cells of the first entry there are; the others stay. Of every size so many seeds
are played, and of every seed the cell with the largest V_D counts. Sizes are played from the
smallest on until the limit is passed for certain; seeds, and further sizes, side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from dwell.errors import Fault, ProblemError
from dwell.model import evolve
from dwell.model.fleet import PHASES, Fleet, FleetEntry, Phases
from dwell.model.progress import Progress
from dwell.sim.fleet import simulate_fleet, waiting_in_fleet
from dwell.sim.static_fleet import StaticFleet
from dwell.sim.waiting import Waiting
from dwell.study.intervals import Interval, mean_interval
from dwell.study.workers import available_processes, spread

#: Cycles that count, of a cell and seed, at least.
CYCLES = 2_000
SEEDS = tuple(range(1, 11))
MOST = 128
#: Share of cycles that one cell alone may miss where an excess over it is of any use.
USELESS = 0.5
ROUNDING = 1e-12
#: Sizes that are played together where no cell moves: they have draws in common.
TOGETHER = 4
#: Names of what a point of the curve says, in JSON.
CURVE = ("robots", "violation_rate", "low", "high")
#: Seeds that say where cycles wait.
WAITING_SEEDS = 3


@dataclass(frozen=True, slots=True)
class CapacityPoint:
    """A size of a fleet.

    Parameters
    ----------
    robots : int
        Cells of the first entry.
    violation_rate : Interval
        V_D of the worst cell, over seeds.
    """

    robots: int
    violation_rate: Interval


@dataclass(frozen=True, slots=True)
class Limiting:
    """What limits a fleet: where the cycles that missed have waited most.

    Parameters
    ----------
    kind : {"node", "link"}
    name : str
    share : float
        Of all that they waited.
    """

    kind: str
    name: str
    share: float


@dataclass(frozen=True, slots=True)
class Capacity:
    """How many robots there may be.

    Parameters
    ----------
    robots : int
        The largest size such that none up to it is over the limit.
    at_least : bool
        Whether larger ones were not asked for.
    interval : tuple of int
        The same by the upper and the lower ends of the intervals.
    limit : float
    limit_on : {"violation_rate", "excess"}
        What the limit is on: V_D, or V_D beyond that of one cell, where one alone is over it.
    phases : str or tuple of float
        What was assumed of when cells begin.
    policy : str
        What was played, where all cells have the same.
    curve : tuple of CapacityPoint
        Of every size that was played.
    limits : Limiting, optional
        Of the size after, or of the largest that was asked for; None where nothing waited.
    reason : str
        Why there is none, or nothing.
    """

    robots: int
    at_least: bool
    interval: tuple[int, int]
    limit: float
    limit_on: Literal["violation_rate", "excess"]
    phases: Phases
    policy: str
    curve: tuple[CapacityPoint, ...] = field(repr=False)
    limits: Limiting | None = None
    reason: str = ""

    @property
    def bound(self) -> float:
        """V_D that is not to be passed."""
        alone = self.curve[0].violation_rate.value if self.limit_on == "excess" else 0.0
        return self.limit + alone

    def as_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        limits = self.limits
        names = ("robots", "at_least", "interval", "limit", "limit_on", "phases", "policy")
        return {
            **{name: getattr(self, name) for name in names},
            "interval": list(self.interval),
            "reason": self.reason or None,
            "limits": None if limits is None else {limits.kind: limits.name, "share": limits.share},
            "curve": [
                dict(zip(CURVE, (point.robots, *point.violation_rate), strict=True))
                for point in self.curve
            ],
        }


@dataclass(frozen=True, slots=True)
class WhatIf:
    """A change of a fleet, and how many robots there may be then.

    Parameters
    ----------
    change : str
        In words: ``a core more on E``.
    """

    change: str
    capacity: Capacity

    def as_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        known = self.capacity.as_json()
        names = ("robots", "at_least", "interval", "limit_on", "phases", "policy", "reason")
        return {"change": self.change, **{name: known[name] for name in names}}


class Sizes(NamedTuple):
    """Sizes that are played together, under one seed."""

    first: int
    last: int
    seed: int


@dataclass(frozen=True, slots=True)
class FleetPlayer:
    """Plays a fleet in some sizes, wherever it is sent to.

    Parameters
    ----------
    duration_ns : int
        Length of a run.
    placements : mapping of str to str
        Candidate of every cell by the name of its file; empty where some may move.
    """

    fleet: Fleet
    duration_ns: int
    placements: Mapping[str, str]

    def __call__(self, unit: Sizes) -> list[float]:
        """Return V_D of the worst cell of every size."""
        fleets = [self.fleet.with_count(size) for size in range(unit.first, unit.last + 1)]
        if self.placements:
            static = StaticFleet(self.placements, seed=unit.seed, duration_ns=self.duration_ns)
            return [float(static.violation_rates(fleet).max()) for fleet in fleets]
        worst = []
        for fleet in fleets:
            seconds = self.duration_ns / 1e9
            runs = simulate_fleet(fleet, seed=unit.seed, seconds=seconds).cells.values()
            tables = [run.arrays("windows") for run in runs]
            rates = [float(one["violation_rate"][~one["warmup"]].mean()) for one in tables]
            worst.append(max(rates))
        return worst

    def limiting(self, robots: int, seeds: Sequence[int]) -> Limiting | None:
        """Return what the cycles that missed have waited for most; None where for nothing."""
        waited = Waiting()
        fleet = self.fleet.with_count(robots)
        for seed in seeds[:WAITING_SEEDS]:
            if self.placements:
                static = StaticFleet(self.placements, seed=seed, duration_ns=self.duration_ns)
                waited += static.waiting(fleet)
            else:
                waited += waiting_in_fleet(fleet, seed=seed, duration_ns=self.duration_ns)
        if not waited:
            return None
        (kind, name), most = max(waited.items(), key=lambda item: item[1])
        return Limiting(kind, name, most / waited.total())


def capacity_of(
    fleet: Fleet,
    *,
    limit: float = 0.05,
    policy: str | None = None,
    phases: str | None = None,
    on_excess: bool = False,
    most: int = MOST,
    seeds: Sequence[int] = SEEDS,
    cycles: int = CYCLES,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Capacity:
    """Find how many cells of the first entry a fleet may have.

    Parameters
    ----------
    limit : float
        Largest V_D that the worst cell may have.
    policy : str, optional
        Policy or candidate of every cell; what the file says where None. A candidate is played
        without any estimator.
    phases : {"sync", "even", "random"}, optional
        What the file says where None.
    on_excess : bool
        Whether the limit is on the excess over one cell, also where one alone is not over it.
    most : int
        Sizes beyond are not played.
    cycles : int
        Cycles after the warm-up, of a cell and seed, at least.
    processes : int, optional
        One a CPU where None.
    progress : callable, optional
        Called with the number of sizes that are done, and `most`.

    Raises
    ------
    ProblemError
        If something named is unknown, the phases are a list, or no cell can use a shared node.
    """
    fleet = fleet.changed(policy=policy, phases=phases)
    _require_capacity(fleet)
    fleet.with_count(most)
    player = FleetPlayer(fleet, _duration_ns(fleet, cycles), _placements(fleet))
    together = TOGETHER if player.placements else 1
    units = [
        Sizes(first, min(first + together - 1, most), seed)
        for first in range(1, most + 1, together)
        for seed in seeds
    ]
    curve = _Curve(limit, len(seeds), on_excess=on_excess)

    def take(unit: Sizes, rates: list[float]) -> bool:
        enough = curve.take(unit, rates)
        if progress is not None:
            progress(len(curve.points), most)
        return enough

    workers = available_processes() if processes is None else processes
    spread(player, units, processes=workers, take=take)
    found = curve.capacity(fleet)
    beyond = min(found.robots + 1, len(found.curve))
    return replace(found, limits=player.limiting(beyond, seeds))


class _Curve:
    """V_D by size, in order, as seeds of sizes come in."""

    def __init__(self, limit: float, seeds: int, *, on_excess: bool) -> None:
        self.limit, self.seeds, self.asked = limit, seeds, on_excess
        self.points: list[CapacityPoint] = []
        self._rates: dict[int, dict[int, float]] = {}
        self._enough = False

    def take(self, unit: Sizes, rates: Sequence[float]) -> bool:
        """Take the rates of a unit; whether no larger size can change the answer."""
        for size, rate in enumerate(rates, unit.first):
            self._rates.setdefault(size, {})[unit.seed] = rate
        while (
            not self._enough and len(of := self._rates.get(len(self.points) + 1, {})) == self.seeds
        ):
            rates = [of[seed] for seed in sorted(of)]
            self.points.append(CapacityPoint(len(self.points) + 1, mean_interval(rates)))
            is_over = self._is_over(self.points[-1], lambda rate: rate.low)
            self._enough = is_over or self._useless
        return self._enough

    @property
    def _alone(self) -> float:
        return self.points[0].violation_rate.value

    @property
    def _useless(self) -> bool:
        return self._alone > self.limit + ROUNDING and self._alone >= USELESS

    @property
    def bound(self) -> float:
        """V_D that is not to be passed, and what sums of floats are off by."""
        return self.limit + (self._alone if self._on_excess else 0.0) + ROUNDING

    @property
    def _on_excess(self) -> bool:
        return (self.asked or self._alone > self.limit + ROUNDING) and not self._useless

    def capacity(self, fleet: Fleet) -> Capacity:
        """Return what it comes to."""
        robots = self._largest(lambda rate: rate.value)
        names = dict.fromkeys(policy_of(fleet, entry) for entry in fleet.entries)
        alone = f"one cell alone misses {self._alone:.0%} of its deadlines"
        return Capacity(
            robots=robots,
            at_least=robots == len(self.points),
            interval=(self._largest(lambda rate: rate.high), self._largest(lambda rate: rate.low)),
            limit=self.limit,
            limit_on="excess" if self._on_excess else "violation_rate",
            phases=fleet.phases,
            policy=", ".join(names),
            curve=tuple(self.points),
            reason=alone if self._useless else "",
        )

    def _largest(self, end: Callable[[Interval], float]) -> int:
        """Return the largest size such that none up to it is over the bound."""
        over = (i for i, point in enumerate(self.points) if self._is_over(point, end))
        return next(over, len(self.points))

    def _is_over(self, point: CapacityPoint, end: Callable[[Interval], float]) -> bool:
        rate = point.violation_rate
        # One seed gives no interval.
        return (end(rate) if rate.known else rate.value) > self.bound


def _duration_ns(fleet: Fleet, cycles: int) -> int:
    """Return how long a fleet is played so that each cell counts so many cycles, in windows."""
    cells = [entry.cell for entry in fleet.entries]
    return fleet.warmup_ns + max(-(-cycles // c.window_cycles) * c.window_ns for c in cells)


def policy_of(fleet: Fleet, entry: FleetEntry) -> str:
    """Return the policy of the cells of an entry."""
    return entry.policy or fleet.policy or entry.cell.controller.policy


def _placements(fleet: Fleet) -> dict[str, str]:
    """Return the candidate of every cell by the name of its file; nothing where some may move."""
    known: dict[str, str] = {}
    for entry in fleet.entries:
        placed = _placed(fleet, entry)
        if placed is None or known.setdefault(entry.cell.name, placed) != placed:
            return {}
    return known


def _placed(fleet: Fleet, entry: FleetEntry) -> str | None:
    """Return the candidate at which the cells of an entry stay, whatever estimator is named."""
    name, _ = entry.cell.policy_and_estimator(policy_of(fleet, entry))
    return name if name in entry.cell.candidates else None


def _require_capacity(fleet: Fleet) -> None:
    """Refuse a fleet of which there may be any number of cells, or whose phases are of one size."""
    faults = []
    if not isinstance(fleet.phases, str):
        faults.append(Fault("phases", f"a list is of one size; give one of {', '.join(PHASES)}"))
    first = fleet.entries[0]
    placed, candidates = _placed(fleet, first), first.cell.candidates
    used = candidates.values() if placed is None else [candidates[placed]]
    if not fleet.shared:
        faults.append(
            Fault("shared", "no node is shared, so that there may be any number of cells")
        )
    elif not any(node in fleet.shared for one in used for node in one.values()):
        nodes = ", ".join(fleet.shared)
        message = f"{policy_of(fleet, first)} never uses a shared node ({nodes})"
        any_number = f"so that there may be any number of {first.cell.name}"
        faults.append(Fault("policy", f"{message}, {any_number}; name another one"))
    if faults:
        raise ProblemError(faults)


def what_ifs(fleet: Fleet) -> Iterator[tuple[str, Fleet]]:
    """Yield changes that may take more robots, in words, and the fleet with each.

    A core more on every shared node, phases that are evenly spread, and every other candidate of
    the first entry that uses a shared node.
    """
    for node in fleet.shared:
        cores = fleet.entries[0].cell.fabric.nodes[node].cores + 1
        entries = [
            replace(one, cell=evolve(one.cell, {f"nodes.{node}.cores": cores}))
            for one in fleet.entries
        ]
        yield f"a core more on {node}", replace(fleet, entries=tuple(entries))
    if fleet.phases != "even":
        yield "phases evenly spread", fleet.changed(phases="even")
    first, policy = fleet.entries[0], policy_of(fleet, fleet.entries[0])
    for name, placement in first.cell.candidates.items():
        is_everywhere = all(name in one.cell.candidates for one in fleet.entries)
        if is_everywhere and name != policy and {*placement.values()} & {*fleet.shared}:
            yield f"{name} instead of {policy}", fleet.changed(policy=name)
