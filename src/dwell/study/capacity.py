"""Capacity: how many robots the shared nodes of a fleet carry under a placement or a policy.

A size is how many cells of the first entry there are; the others stay. Of every size so many seeds
are played, and of every seed the cell with the largest V_D counts. Sizes are played one after
another until the mean over seeds is over the limit, so that no smaller one is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.model.fleet import Fleet, Phases
from dwell.sim.fleet import drawn, phased, simulate_fleet
from dwell.study.intervals import Interval, mean_interval

#: Cycles that count, of a cell and seed, at least.
CYCLES = 2_000
SEEDS = tuple(range(1, 11))
MOST = 128
#: Share of cycles that one cell alone may miss where an excess over it is of any use.
USELESS = 0.5


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
    curve : tuple of CapacityPoint
        Of every size that was played.
    reason : str
        Why there is none, or nothing.
    """

    robots: int
    at_least: bool
    interval: tuple[int, int]
    limit: float
    limit_on: Literal["violation_rate", "excess"]
    phases: Phases
    curve: tuple[CapacityPoint, ...]
    reason: str = ""

    def as_json(self) -> dict[str, object]:
        """Return it as plain values."""
        return {
            "robots": self.robots,
            "at_least": self.at_least,
            "interval": list(self.interval),
            "limit": self.limit,
            "limit_on": self.limit_on,
            "phases": self.phases,
            "reason": self.reason or None,
            "curve": [
                {"robots": point.robots, **point.violation_rate.columns("violation_rate")}
                for point in self.curve
            ],
        }


def capacity_of(
    fleet: Fleet,
    *,
    limit: float = 0.05,
    policy: str | None = None,
    most: int = MOST,
    seeds: Sequence[int] = SEEDS,
    cycles: int = CYCLES,
    progress: Callable[[CapacityPoint], None] = lambda point: None,
) -> Capacity:
    """Find how many cells of the first entry a fleet may have.

    Parameters
    ----------
    limit : float
        Largest V_D that the worst cell may have.
    policy : str, optional
        Policy or candidate of every cell; what the file says where None.
    most : int
        Sizes beyond are not played.
    cycles : int
        Cycles after the warm-up, of a cell and seed, at least.
    progress : callable
        Told every size when it has been played.
    """
    curve: list[CapacityPoint] = []
    offset = 0.0
    limit_on: Literal["violation_rate", "excess"] = "violation_rate"
    worst = _worst_of(fleet, policy, cycles)
    for robots in range(1, most + 1):
        rates = [worst(fleet.with_count(robots), seed) for seed in seeds]
        point = CapacityPoint(robots, mean_interval(rates))
        curve.append(point)
        progress(point)
        rate = point.violation_rate.value
        if robots == 1 and rate > limit:
            if rate >= USELESS:
                reason = f"one cell alone misses {rate:.0%} of its deadlines"
                return _found(curve, limit, limit, "violation_rate", fleet, reason)
            offset, limit_on = rate, "excess"
        # The lower end of an interval may be under the limit for some sizes more.
        if min(rate, point.violation_rate.low) > limit + offset:
            break
    return _found(curve, limit, limit + offset, limit_on, fleet, "")


def _found(
    curve: Sequence[CapacityPoint],
    limit: float,
    bound: float,
    limit_on: Literal["violation_rate", "excess"],
    fleet: Fleet,
    reason: str,
) -> Capacity:
    def largest(end: Callable[[Interval], float]) -> int:
        within = [end(point.violation_rate) <= bound for point in curve]
        return within.index(False) if False in within else len(within)

    robots = largest(lambda rate: rate.value)
    ends = largest(lambda rate: rate.high), largest(lambda rate: rate.low)
    at_least = robots == len(curve)
    return Capacity(robots, at_least, ends, limit, limit_on, fleet.phases, tuple(curve), reason)


def _worst_of(fleet: Fleet, policy: str | None, cycles: int) -> Callable[[Fleet, int], float]:
    """Return what plays a fleet of a size under a seed, and returns V_D of its worst cell."""
    problem = fleet.entries[0].cell
    size = problem.window_cycles
    windows = problem.warmup_windows + -(-cycles // size)
    static = {entry.cell.name: policy or entry.policy or fleet.policy for entry in fleet.entries}
    if all(static[entry.cell.name] in entry.cell.candidates for entry in fleet.entries):
        return partial(_worst_static, windows=windows, static=static)

    def worst(sized: Fleet, seed: int) -> float:
        played = simulate_fleet(sized, seed=seed, windows=windows, policy=policy)
        return max(
            float(run.windows.filter(~run.windows["warmup"])["violation_rate"].mean())
            for run in played.cells.values()
        )

    return worst


def _worst_static(
    fleet: Fleet, seed: int, *, windows: int, static: Mapping[str, str | None]
) -> float:
    """V_D of the worst cell where none moves: one call of the kernel."""
    cells = fleet.cells
    names = [cell.name for cell in cells]
    problems = dict(zip(names, phased(fleet, seed), strict=True))
    reals = drawn(fleet, problems, seed, windows)
    arrays = lay_out([(problems[name], reals[name]) for name in names], shared=fleet.shared)
    tables = arrays.tables
    for row, cell in enumerate(cells):
        names = list(cell.problem.candidates)
        tables.stamps[row] = names.index(static[cell.problem.name] or "")
    play(arrays)
    rates = []
    for row, cell in enumerate(cells):
        problem = cell.problem
        seen = arrays.tables.seen[row, problem.warmup_windows : windows]
        rates.append(float(seen["missed"].mean()) / problem.window_cycles)
    return max(rates)
