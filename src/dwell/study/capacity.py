"""Capacity: how many robots the shared nodes of a fleet carry under a placement or a policy.

A size is the number of cells of the first entry; the other entries stay. Each size is played under
several seeds, and the cell with the largest V_D of each seed counts. With random phases the unit is
the draw of phases: a run keeps its phases from begin to end. Where no cell moves, every size is
played until the limit is passed for certain; the sizes of a policy are found by bisection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dwell.errors import Fault, ProblemError
from dwell.model.fleet import PHASES, Fleet, Phases
from dwell.model.progress import Progress
from dwell.sim.fleet import simulate_fleet, waiting_in_fleet
from dwell.sim.static_fleet import StaticFleet
from dwell.sim.waiting import Waiting
from dwell.study.intervals import Interval, share_difference_interval, share_interval
from dwell.study.played_sizes import KeptSizes, PlayedSize, Sizes, study_of
from dwell.study.twins import with_twins
from dwell.study.workers import available_processes, spread

#: Cycles that count of the slowest cell in a run, and seeds, where phases are not drawn.
CYCLES = 2_000
SEEDS = tuple(range(1, 11))
#: Draws of phases, and cycles that count in each where no cell moves. Phases spread more than
#: cycles do, so that many short runs say more than few long ones.
DRAWS = tuple(range(1, 101))
CYCLES_OF_A_DRAW = 200
MOST = 128
#: Counted cycles of a cell in one run above which there is a warning.
MANY_CYCLES = 2_000_000
#: Share of cycles that one cell alone may miss where an excess over it is of any use.
USELESS = 0.5
ROUNDING = 1e-12
#: Standard errors on either side of a 95 % interval.
NORMAL = 1.96
#: Sizes that are played together where no cell moves: their cells are drawn once.
TOGETHER = 8
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
    excess : Interval
        The same less that of one cell alone, seed by seed.
    phases_error, cycles_error : float
        Half-widths of the 95 % interval by the draws of phases alone, and by the cycles alone.
    utilisation : mapping of str to float
        Of the shared resources.
    """

    robots: int
    violation_rate: Interval
    excess: Interval
    phases_error: float
    cycles_error: float
    utilisation: Mapping[str, float] = field(hash=False)

    def as_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        rate = self.violation_rate
        return {
            "robots": self.robots,
            "violation_rate": rate.value,
            "low": rate.low,
            "high": rate.high,
            "phases_error": self.phases_error,
            "cycles_error": self.cycles_error,
            "utilisation": dict(self.utilisation),
        }


@dataclass(frozen=True, slots=True)
class Limiting:
    """What limits a fleet: where the cycles that missed have waited most.

    Parameters
    ----------
    kind : {"resource", "link"}
    name : str
        ``E``, ``E.gpu``, ``R1->E``.
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
        The largest size such that no played size up to it is over the limit.
    robots_at_limit : int
        The same by V_D itself, whatever one cell alone misses.
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
    searched : {"every size", "bisection"}
        Which sizes were played.
    curve : tuple of CapacityPoint
        Of every size that was played.
    limits : Limiting, optional
        Of the size after, or of the largest that was asked for; None where nothing waited.
    reason : str
        Why there is none, or nothing.
    """

    robots: int
    robots_at_limit: int
    at_least: bool
    interval: tuple[int, int]
    limit: float
    limit_on: Literal["violation_rate", "excess"]
    phases: Phases
    policy: str
    searched: Literal["every size", "bisection"]
    curve: tuple[CapacityPoint, ...] = field(repr=False)
    limits: Limiting | None = None
    reason: str = ""

    @property
    def alone(self) -> float:
        """V_D of one cell alone."""
        return self.curve[0].violation_rate.value

    @property
    def bound(self) -> float:
        """V_D that is not to be passed."""
        return self.limit + (self.alone if self.limit_on == "excess" else 0.0)

    def point(self, robots: int) -> CapacityPoint:
        """Return the largest played size up to a number of robots, or the smallest."""
        return next((one for one in reversed(self.curve) if one.robots <= robots), self.curve[0])

    def as_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        limits = self.limits
        return {
            **{name: getattr(self, name) for name in PLAIN},
            "interval": list(self.interval),
            "reason": self.reason or None,
            "limits": None if limits is None else {limits.kind: limits.name, "share": limits.share},
            "curve": [point.as_json() for point in self.curve],
        }


#: Attributes of a capacity that are plain values.
PLAIN = (
    *("robots", "robots_at_limit", "at_least", "interval", "limit", "limit_on"),
    *("phases", "policy", "searched"),
)


@dataclass(frozen=True, slots=True)
class FleetPlayer:
    """Plays a fleet in some sizes, in whichever process.

    Parameters
    ----------
    fleet : Fleet
    duration_ns : int
        Length of a run.
    servers : mapping of str to int
        How many twins each shared node has (see `dwell.study.twins`).
    """

    fleet: Fleet
    duration_ns: int
    servers: Mapping[str, int] = field(default_factory=dict)

    def of(self, robots: int) -> Fleet:
        """Return the fleet with so many cells of the first entry."""
        fleet = self.fleet.with_count(robots)
        for node, count in self.servers.items():
            fleet = with_twins(fleet, node, count)
        return fleet

    def __call__(self, unit: Sizes) -> list[PlayedSize]:
        """Play every size."""
        fleets = [self.of(size) for size in range(unit.first, unit.last + 1)]
        if self.fleet.is_static:
            static = StaticFleet(seed=unit.seed, duration_ns=self.duration_ns)
            return [PlayedSize.of(*static.play(fleet)) for fleet in fleets]
        return [self._moving(fleet, unit.seed) for fleet in fleets]

    def _moving(self, fleet: Fleet, seed: int) -> PlayedSize:
        runs = simulate_fleet(fleet, seed=seed, seconds=self.duration_ns / 1e9).cells.values()
        missed: list[NDArray[np.bool_]] = []
        used: dict[str, float] = {}
        for run in runs:
            cycles, windows = run.arrays("cycles"), run.arrays("windows")
            counts = ~windows["warmup"]
            first = int(windows["first_cycle"][counts][0])
            missed.append(cycles["missed"][first:][~cycles["lead"][first:]])
            if not used:
                resources = run.problem.fabric.resources.values()
                used = {
                    one.name: float(np.nanmean(windows[f"u_{one.name}"][counts]))
                    for one in resources
                    if one.node in fleet.shared
                }
        return PlayedSize.of(missed, used)

    def limiting(self, robots: int, seeds: Sequence[int]) -> Limiting | None:
        """Return what the cycles that missed have waited for most; None where for nothing."""
        waited = Waiting()
        fleet, duration_ns = self.of(robots), self.duration_ns
        for seed in seeds[:WAITING_SEEDS]:
            if self.fleet.is_static:
                waited += StaticFleet(seed=seed, duration_ns=duration_ns).waiting(fleet)
            else:
                waited += waiting_in_fleet(fleet, seed=seed, duration_ns=duration_ns)
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
    seeds: Sequence[int] | None = None,
    cycles: int | None = None,
    twins: Mapping[str, int] | None = None,
    processes: int | None = None,
    kept: KeptSizes | None = None,
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
    seeds : sequence of int, optional
        `SEEDS` where None. With random phases: `DRAWS` where no cell moves; for a policy the first
        ten of these, and further ones at sizes whose interval holds the limit.
    cycles : int, optional
        Cycles of the slowest cell that count in a run, at least. `CYCLES` where None; with random
        phases and no cell that moves `CYCLES_OF_A_DRAW`, after a warm-up of one window.
    twins : mapping of str to int, optional
        How many more servers there are like a shared node; cells take them in turn.
    processes : int, optional
        One a CPU where None.
    kept : KeptSizes, optional
        Sizes that an interrupted study has played; those that are played now are added.
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
    is_static = fleet.is_static
    draws = fleet.phases == "random"
    fleet, duration_ns = _length(fleet, cycles)
    player = FleetPlayer(fleet, duration_ns, twins or {})
    known = tuple(seeds or (DRAWS if draws else SEEDS))
    # A run has one draw of phases, and windows that differ.
    kinds = 1 if draws else max(duration_ns - fleet.warmup_ns, 1) // fleet.duration_ns(1)
    sizes = _Sizes(limit, kinds, on_excess=on_excess)
    workers = available_processes() if processes is None else processes
    search = _Search(player, sizes, most, workers, kept, progress)
    if is_static:
        search.every_size(known)
    else:
        search.by_bisection(known[: len(SEEDS)] if draws and seeds is None else known, known)
    found = sizes.capacity(fleet, "every size" if is_static else "bisection")
    beyond = min(found.robots + 1, found.curve[-1].robots)
    return replace(found, limits=player.limiting(beyond, known))


class _Sizes:
    """What has been played of each size.

    Parameters
    ----------
    limit : float
    kinds : int
        Independent parts of a run: windows, or one where its phases are a draw.
    on_excess : bool
        Whether the limit is on the excess in any case.
    """

    def __init__(self, limit: float, kinds: int, *, on_excess: bool) -> None:
        self.limit, self.kinds, self.asked = limit, kinds, on_excess
        self.played: dict[int, dict[int, PlayedSize]] = {}
        self._points: dict[tuple[int, int], CapacityPoint] = {}

    def take(self, unit: Sizes, played: Sequence[PlayedSize]) -> None:
        """Keep what a unit has come to."""
        for size, one in enumerate(played, unit.first):
            self.played.setdefault(size, {})[unit.seed] = one

    def seeds(self, size: int) -> int:
        """Return under how many seeds a size has been played."""
        return len(self.played.get(size, {}))

    def point(self, size: int) -> CapacityPoint:
        """Return what is known of a size."""
        key = size, self.seeds(size)
        if key not in self._points:
            self._points[key] = self._point(size)
        return self._points[key]

    def _point(self, size: int) -> CapacityPoint:
        of, alone = self.played[size], self.played.get(1, {})
        seeds = sorted(of)
        rates = [of[seed].rate for seed in seeds]
        both = [seed for seed in seeds if seed in alone]
        pairs = [of[seed].rate for seed in both], [alone[seed].rate for seed in both]
        count, windows = len(seeds), len(seeds) * self.kinds
        whole = float(np.var(rates, ddof=1)) / count if count > 1 else math.nan
        by_cycles = fmean(one.half**2 for one in of.values()) / count
        excess = Interval(math.nan, math.nan, math.nan)
        if both:
            excess = share_difference_interval(*pairs, windows=len(both) * self.kinds)
        return CapacityPoint(
            robots=size,
            violation_rate=share_interval(rates, windows=windows),
            excess=excess,
            phases_error=NORMAL * math.sqrt(max(whole - by_cycles, 0.0)),
            cycles_error=NORMAL * math.sqrt(by_cycles),
            utilisation={
                name: fmean(one.used[name] for one in of.values()) for name in of[seeds[0]].used
            },
        )

    @property
    def alone(self) -> float:
        """V_D of one cell alone."""
        return self.point(1).violation_rate.value

    @property
    def useless(self) -> bool:
        """Whether one cell alone misses so much that no excess is of any use."""
        return self.alone > self.limit + ROUNDING and self.alone >= USELESS

    @property
    def on_excess(self) -> bool:
        """Whether the limit is on the excess over one cell."""
        return (self.asked or self.alone > self.limit + ROUNDING) and not self.useless

    def is_over(self, size: int, end: Callable[[Interval], float]) -> bool:
        """Whether a size is over the limit, by the value or an end of its interval."""
        if size == 1 and self.on_excess:
            return False
        point = self.point(size)
        rate = point.excess if self.on_excess else point.violation_rate
        # One seed gives no interval.
        return (end(rate) if rate.known else rate.value) > self.limit + ROUNDING

    def capacity(self, fleet: Fleet, searched: Literal["every size", "bisection"]) -> Capacity:
        """Return what it comes to."""
        names = dict.fromkeys(fleet.policy_of(entry) for entry in fleet.entries)
        robots, largest = self._largest(_value), max(self.played)
        alone = f"one cell alone misses {self.alone:.0%} of its deadlines"
        return Capacity(
            robots=robots,
            robots_at_limit=0 if self.alone > self.limit + ROUNDING else robots,
            at_least=robots == largest,
            interval=(self._largest(_high), self._below(_low)),
            limit=self.limit,
            limit_on="excess" if self.on_excess else "violation_rate",
            phases=fleet.phases,
            policy=", ".join(names),
            searched=searched,
            curve=tuple(self.point(size) for size in sorted(self.played)),
            reason=alone if self.useless else "",
        )

    def _largest(self, end: Callable[[Interval], float]) -> int:
        """Return the largest played size such that none up to it is over the limit."""
        found = 0
        for size in sorted(self.played):
            if self.is_over(size, end):
                break
            found = size
        return found

    def _below(self, end: Callable[[Interval], float]) -> int:
        """Return the size before the first played one that is over the limit."""
        over = (size - 1 for size in sorted(self.played) if self.is_over(size, end))
        return next(over, max(self.played))


def _value(rate: Interval) -> float:
    return rate.value


def _low(rate: Interval) -> float:
    return rate.low


def _high(rate: Interval) -> float:
    return rate.high


class _Search:
    """Plays the sizes that decide.

    Parameters
    ----------
    most : int
        Largest size.
    """

    def __init__(
        self,
        player: FleetPlayer,
        sizes: _Sizes,
        most: int,
        processes: int,
        kept: KeptSizes | None,
        progress: Progress | None,
    ) -> None:
        self.player, self.sizes, self.most = player, sizes, most
        self.processes, self.kept, self.progress = processes, kept, progress

    def every_size(self, seeds: Sequence[int]) -> None:
        """Play sizes from the smallest on until one is over the limit for certain."""
        sizes, done = self.sizes, 0

        def take(unit: Sizes, played: list[PlayedSize]) -> bool:
            nonlocal done
            sizes.take(unit, played)
            while sizes.seeds(done + 1) == len(seeds):
                done += 1
                if sizes.useless or sizes.is_over(done, _low):
                    break
            else:
                self._tell(done)
                return False
            self._tell(done)
            return True

        steps = range(1, self.most + 1, TOGETHER)
        units = [
            Sizes(first, min(first + TOGETHER - 1, self.most), seed)
            for first in steps
            for seed in seeds
        ]
        self._spread(units, take)
        for size in [one for one in sizes.played if one > done]:
            del sizes.played[size]

    def by_bisection(self, few: Sequence[int], all_of: Sequence[int]) -> None:
        """Play the sizes between which the limit is passed, each under few seeds first.

        A size whose interval holds the limit is played under more, until it does not.
        """
        low, high, size = 0, self.most + 1, 1
        while low + 1 < high:
            if self._is_over(size, few, all_of):
                high = size
            else:
                low = size
            if self.sizes.useless:
                return
            size = min(2 * low, self.most) if high > self.most else (low + high) // 2

    def _is_over(self, size: int, few: Sequence[int], all_of: Sequence[int]) -> bool:
        sizes, seeds = self.sizes, len(few)
        while True:
            for one in dict.fromkeys((1, size) if size > 1 else (1,)):
                self._play(one, all_of[sizes.seeds(one) : seeds])
            if (
                seeds == len(all_of)
                or sizes.useless
                or sizes.is_over(size, _low) == sizes.is_over(size, _high)
            ):
                return sizes.is_over(size, _value)
            seeds = min(2 * seeds, len(all_of))

    def _play(self, size: int, seeds: Sequence[int]) -> None:
        units = [Sizes(size, size, seed) for seed in seeds]

        self._spread(units, self.sizes.take)
        self._tell(size)

    def _spread(
        self, units: Sequence[Sizes], take: Callable[[Sizes, list[PlayedSize]], bool | None]
    ) -> None:
        """Take what is known of some units, and play the others."""
        kept, player = self.kept, self.player
        if kept is None:
            spread(player, units, processes=self.processes, take=take)
            return
        study = study_of(player.fleet, player.duration_ns, player.servers)
        known = {unit: kept.known(study, unit) for unit in units}

        def keep(unit: Sizes, played: list[PlayedSize]) -> bool | None:
            kept.keep(study, unit, played)
            return take(unit, played)

        if not any(take(unit, played) for unit, played in known.items() if played is not None):
            new = [unit for unit, played in known.items() if played is None]
            spread(player, new, processes=self.processes, take=keep)

    def _tell(self, done: int) -> None:
        if self.progress is not None:
            self.progress(done, self.most)


def _with_short_warmup(fleet: Fleet) -> Fleet:
    """Return a fleet with one window of warm-up: enough where no cell moves."""
    entries = (replace(one, cell=replace(one.cell, warmup_windows=1)) for one in fleet.entries)
    return replace(fleet, entries=tuple(entries))


def _length(fleet: Fleet, cycles: int | None) -> tuple[Fleet, int]:
    """Return a fleet as it is played, and how long: each cell counts so many cycles, in windows."""
    if cycles is None and fleet.phases == "random" and fleet.is_static:
        fleet, cycles = _with_short_warmup(fleet), CYCLES_OF_A_DRAW
    needed = CYCLES if cycles is None else cycles
    cells = [entry.cell for entry in fleet.entries]
    counted_ns = max(-(-needed // cell.window_cycles) * cell.window_ns for cell in cells)
    return fleet, fleet.warmup_ns + counted_ns


def long_runs(fleet: Fleet, cycles: int | None = None) -> Iterator[Fault]:
    """Yield a warning for each cell of which a run counts more than `MANY_CYCLES` cycles.

    All cells are played as long as the slowest one needs (see `capacity_of`).
    """
    played, duration_ns = _length(fleet, cycles)
    counted_ns = duration_ns - played.warmup_ns
    slowest = max((entry.cell for entry in played.entries), key=lambda cell: cell.window_ns)
    for i, entry in enumerate(played.entries):
        count = counted_ns // entry.cell.pipeline.period_ns
        if count > MANY_CYCLES:
            yield Fault(
                f"cells[{i}].cell",
                f"a run counts {count:,} cycles of {entry.cell.name}, above {MANY_CYCLES:,}, since "
                f"{slowest.name} needs {counted_ns / 1e9:g} s; if that takes too long, ask for "
                "these cells alone",
            )


def _require_capacity(fleet: Fleet) -> None:
    """Refuse a fleet of which there may be any number of cells, or whose phases are of one size."""
    faults = []
    if not isinstance(fleet.phases, str):
        faults.append(Fault("phases", f"a list is of one size; give one of {', '.join(PHASES)}"))
    first = fleet.entries[0]
    placed, candidates = fleet.candidate_of(first), first.cell.candidates
    used = candidates.values() if placed is None else [candidates[placed]]
    if not fleet.shared:
        faults.append(
            Fault("shared", "no node is shared, so that there may be any number of cells")
        )
    elif not any(node in fleet.shared for one in used for node in one.values()):
        nodes = ", ".join(fleet.shared)
        message = f"{fleet.policy_of(first)} never uses a shared node ({nodes})"
        any_number = f"so that there may be any number of {first.cell.name}"
        faults.append(Fault("policy", f"{message}, {any_number}; name another one"))
    if faults:
        raise ProblemError(faults)
