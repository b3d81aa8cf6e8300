"""Capacity: the number of robots that a fleet's shared nodes carry under a placement or a policy.

A size is the number of cells of the first entry; the other entries do not change. Each size is
simulated with several seeds; for each seed the cell with the largest V_D counts. Random phases are
sampled once per run, so a run is then one independent sample. If no cell moves, the sizes are
simulated in ascending order until one is certainly over the limit. If a policy moves cells,
bisection selects the sizes.
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
from dwell.study.metric import METRICS
from dwell.study.played_sizes import KeptSizes, PlayedSize, Sizes, study_of
from dwell.study.twins import with_twins
from dwell.study.workers import available_processes, spread

#: Default number of counted cycles of the slowest cell per run, and default seeds.
CYCLES = 2_000
SEEDS = tuple(range(1, 11))
#: Default seeds with random phases, and counted cycles per run if no cell moves. V_D varies more
#: with the phases than with the cycles, so many short runs are better than few long runs.
DRAWS = tuple(range(1, 101))
CYCLES_OF_A_DRAW = 200
MOST = 128
#: Counted cycles of a cell in one run above which `long_runs` warns.
MANY_CYCLES = 2_000_000
#: V_D of one cell alone from which a limit on the excess over it is useless.
USELESS = 0.5
ROUNDING = 1e-12
#: Half-width of a 95 % interval in standard errors.
NORMAL = 1.96
#: Fewest and most sizes simulated together if no cell moves: their cells are sampled once.
FEWEST_TOGETHER, MOST_TOGETHER = 8, 32
#: Number of seeds for the waiting times of missed cycles.
WAITING_SEEDS = 3


@dataclass(frozen=True, slots=True)
class CapacityPoint:
    """Results for a size of a fleet.

    Parameters
    ----------
    robots : int
        Cells of the first entry.
    violation_rate : Interval
        V_D of the worst cell, over seeds.
    excess : Interval
        V_D of the worst cell minus V_D of one cell alone, paired by seed.
    phases_error, cycles_error : float
        Half-widths of the 95 % interval from the sampled phases alone, and from the cycles alone.
    utilisation : mapping of str to float
        Mean utilisation of each shared resource.
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
    """Resource or link that limits a fleet: missed cycles waited longest for it.

    Parameters
    ----------
    kind : {"resource", "link"}
    name : str
        ``E``, ``E.gpu``, ``R1->E``.
    share : float
        Share of the total waiting time of the missed cycles.
    """

    kind: str
    name: str
    share: float


@dataclass(frozen=True, slots=True)
class Capacity:
    """Capacity of a fleet: the number of robots that it can have within a limit on V_D.

    Parameters
    ----------
    robots : int
        The largest simulated size such that no simulated size up to it is over the limit.
    robots_at_limit : int
        0 if one cell alone is over the limit, else `robots`.
    at_least : bool
        Whether `robots` is the largest size simulated: the capacity may be larger.
    interval : tuple of int
        Lower and upper number of robots, from the ends of the intervals of V_D or its excess.
    limit : float
    limit_on : {"violation_rate", "excess"}
        Whether the limit applies to V_D or to its excess over the V_D of one cell alone.
    phases : str or tuple of float
        Assumed phases of the cells.
    policy : str
        Policies or candidates of the entries, joined by commas.
    searched : {"every size", "bisection"}
        How the sizes were selected.
    curve : tuple of CapacityPoint
        All simulated sizes, the smallest first.
    limits : Limiting, optional
        Limit of the next size, or of the largest simulated; None if no missed cycle waited.
    reason : str
        Why the capacity is 0 if one cell alone misses too many deadlines; else empty.
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
        """Largest V_D within the limit."""
        return self.limit + (self.alone if self.limit_on == "excess" else 0.0)

    def point(self, robots: int) -> CapacityPoint:
        """Return the largest simulated size up to a number of robots, else the smallest."""
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
    """Task for worker processes: simulates sizes of a fleet.

    Parameters
    ----------
    fleet : Fleet
    duration_ns : int
        Length of a run.
    servers : mapping of str to int
        Number of twins of each shared node (see `dwell.study.twins`).
    """

    fleet: Fleet
    duration_ns: int
    servers: Mapping[str, int] = field(default_factory=dict)

    def of(self, robots: int) -> Fleet:
        """Return the fleet with a number of cells of the first entry."""
        fleet = self.fleet.with_count(robots)
        for node, count in self.servers.items():
            fleet = with_twins(fleet, node, count)
        return fleet

    def __call__(self, unit: Sizes) -> list[PlayedSize]:
        """Simulate every size of a unit."""
        fleets = [self.of(size) for size in range(unit.first, unit.last + 1)]
        if self.fleet.is_static:
            static = StaticFleet(seed=unit.seed, duration_ns=self.duration_ns)
            return [PlayedSize.of(*run) for run in static.play_sizes(fleets)]
        return [self._moving(fleet, unit.seed) for fleet in fleets]

    def _moving(self, fleet: Fleet, seed: int) -> PlayedSize:
        runs = simulate_fleet(fleet, seed=seed, seconds=self.duration_ns / 1e9).cells.values()
        missed: list[NDArray[np.bool_]] = []
        used: dict[str, float] = {}
        for run in runs:
            cycles, windows = run.arrays("cycles"), run.arrays("windows")
            counts = ~windows["warmup"]
            first = int(windows["first_cycle"][counts][0])
            is_due = ~cycles.names("outcome")[first:].equal("idle")
            missed.append(cycles["missed"][first:][~cycles["lead"][first:] & is_due])
            if not used:
                resources = run.problem.fabric.resources.values()
                used = {
                    one.name: float(np.nanmean(windows[f"u_{one.name}"][counts]))
                    for one in resources
                    if one.node in fleet.shared
                }
        return PlayedSize.of(missed, used)

    def limiting(self, robots: int, seeds: Sequence[int]) -> Limiting | None:
        """Return the resource or link with the most waiting of missed cycles; None without any."""
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
    """Find the largest number of cells of the first entry within a limit on V_D.

    Parameters
    ----------
    limit : float
        Largest V_D of the worst cell.
    policy : str, optional
        Policy or candidate of every cell (default: the fleet's). A candidate has no estimator.
    phases : {"sync", "even", "random"}, optional
        Phases of the cells (default: the fleet's).
    on_excess : bool
        Whether the limit applies to the excess over one cell alone even if that cell is within it.
    most : int
        Largest size to try.
    seeds : sequence of int, optional
        Default: `SEEDS`. With random phases the default is `DRAWS` if no cell moves; with a policy
        it is the first ten of these, and more at sizes whose interval includes the limit.
    cycles : int, optional
        Least number of counted cycles of the slowest cell per run. Default: `CYCLES`; with random
        phases and no moves `CYCLES_OF_A_DRAW`, after a warm-up of one window.
    twins : mapping of str to int, optional
        Number of additional servers like a shared node; cells use them in turn.
    processes : int, optional
        Default: one per CPU.
    kept : KeptSizes, optional
        Results of an interrupted study; new results are added.
    progress : callable, optional
        Called with the number of finished sizes, and `most`.

    Raises
    ------
    ProblemError
        If a name is unknown, the phases are a list, or no cell can use a shared node.
    """
    fleet = fleet.changed(policy=policy, phases=phases)
    _require_capacity(fleet)
    fleet.with_count(most)
    is_static = fleet.is_static
    draws = fleet.phases == "random"
    fleet, duration_ns = _length(fleet, cycles)
    player = FleetPlayer(fleet, duration_ns, twins or {})
    known = tuple(seeds or (DRAWS if draws else SEEDS))
    # With random phases a run is one independent sample, otherwise each of its windows is.
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
    """Results of the simulated sizes, by size and seed.

    Parameters
    ----------
    limit : float
    kinds : int
        Independent parts of a run: its windows, or 1 if its phases are random.
    on_excess : bool
        Whether the limit applies to the excess even if one cell alone is within it.
    """

    def __init__(self, limit: float, kinds: int, *, on_excess: bool) -> None:
        self.limit, self.kinds, self.asked = limit, kinds, on_excess
        self.played: dict[int, dict[int, PlayedSize]] = {}
        self._points: dict[tuple[int, int], CapacityPoint] = {}

    def take(self, unit: Sizes, played: Sequence[PlayedSize]) -> None:
        """Store the results of a unit."""
        for size, one in enumerate(played, unit.first):
            self.played.setdefault(size, {})[unit.seed] = one

    def seeds(self, size: int) -> int:
        """Return the number of seeds with which a size has been simulated."""
        return len(self.played.get(size, {}))

    def point(self, size: int) -> CapacityPoint:
        """Return the results for a size, over the seeds so far."""
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
        """Whether one cell alone misses too much for a limit on the excess."""
        return self.alone > self.limit + ROUNDING and self.alone >= USELESS

    @property
    def on_excess(self) -> bool:
        """Whether the limit applies to the excess over one cell alone."""
        return (self.asked or self.alone > self.limit + ROUNDING) and not self.useless

    def is_over(self, size: int, end: Callable[[Interval], float]) -> bool:
        """Whether a size is over the limit, by the value or an end of its interval."""
        if size == 1 and self.on_excess:
            return False
        point = self.point(size)
        rate = point.excess if self.on_excess else point.violation_rate
        # A single seed has no interval.
        return (end(rate) if rate.known else rate.value) > self.limit + ROUNDING

    def capacity(self, fleet: Fleet, searched: Literal["every size", "bisection"]) -> Capacity:
        """Return the capacity from the results so far, without `limits`."""
        names = dict.fromkeys(fleet.policy_of(entry) for entry in fleet.entries)
        robots, largest = self._largest(_value), max(self.played)
        alone = (
            f"one cell alone misses {METRICS['violation_rate'].text(self.alone)} of its deadlines"
        )
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
        """Return the largest simulated size before any that is over the limit, else 0."""
        found = 0
        for size in sorted(self.played):
            if self.is_over(size, end):
                break
            found = size
        return found

    def _below(self, end: Callable[[Interval], float]) -> int:
        """Return the first simulated size over the limit, minus 1; else the largest simulated."""
        over = (size - 1 for size in sorted(self.played) if self.is_over(size, end))
        return next(over, max(self.played))


def _value(rate: Interval) -> float:
    return rate.value


def _low(rate: Interval) -> float:
    return rate.low


def _high(rate: Interval) -> float:
    return rate.high


class _Search:
    """Search for the capacity: selects the sizes to simulate, up to `most`."""

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
        """Simulate sizes in ascending order until one is certainly over the limit."""
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

        units = [Sizes(*ends, seed) for ends in _together(self.most) for seed in seeds]
        self._spread(units, take)
        for size in [one for one in sizes.played if one > done]:
            del sizes.played[size]

    def by_bisection(self, few: Sequence[int], all_of: Sequence[int]) -> None:
        """Bisect to the largest size within the limit, each size with few seeds first.

        The number of seeds doubles while the interval of a size includes the limit.
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
        """Take the saved results of units, then simulate the other units."""
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


def _together(most: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of sizes up to `most`; each at most doubles the largest size."""
    first = 1
    while first <= most:
        count = min(max(first - 1, FEWEST_TOGETHER), MOST_TOGETHER, most + 1 - first)
        yield first, first + count - 1
        first += count


def _with_short_warmup(fleet: Fleet) -> Fleet:
    """Return a fleet with one window of warm-up, which is enough if no cell moves."""
    entries = (replace(one, cell=replace(one.cell, warmup_windows=1)) for one in fleet.entries)
    return replace(fleet, entries=tuple(entries))


def _length(fleet: Fleet, cycles: int | None) -> tuple[Fleet, int]:
    """Return the fleet to simulate and the length of a run.

    The run has `cycles` of each cell in which a sink is due, in complete windows.
    """
    if cycles is None and fleet.phases == "random" and fleet.is_static:
        fleet, cycles = _with_short_warmup(fleet), CYCLES_OF_A_DRAW
    needed = CYCLES if cycles is None else cycles
    cells = [entry.cell for entry in fleet.entries]
    counted_ns = max(-(-needed // cell.due_cycles) * cell.window_ns for cell in cells)
    return fleet, fleet.warmup_ns + counted_ns


def long_runs(fleet: Fleet, cycles: int | None = None) -> Iterator[Fault]:
    """Yield a warning for each cell with more than `MANY_CYCLES` counted cycles per run.

    The slowest cell sets the length of the run for all cells (see `capacity_of`).
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
    """Refuse a fleet without a bound on its cells, and phases listed for one size."""
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
    elif all(one.nodes.isdisjoint(fleet.shared) for one in used):
        nodes = ", ".join(fleet.shared)
        message = f"{fleet.policy_of(first)} never uses a shared node ({nodes})"
        any_number = f"so that there may be any number of {first.cell.name}"
        faults.append(Fault("policy", f"{message}, {any_number}; name another one"))
    if faults:
        raise ProblemError(faults)
