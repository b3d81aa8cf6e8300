"""Expected cost of every candidate for a planner that knows all disturbances in advance.

The planner knows when each disturbance is on, including sampled episodes. It does not know the
bursts of nodes and links, execution times, delays and losses.

The disturbances that are on in a cycle are its *set*. The kernel prices every candidate under each
set, as if the set were always on (`dwell.estimators.prices`), from `PRICED_CYCLES` cycles. J of a
stretch of cycles is the mean of the prices of its cycles.

Along a ramp the strength is rounded to `RAMP_PRICES` equal steps. The `MOST_SETS` most frequent
sets are priced. Every other set has the prices of the most similar priced set, by the sum of
differences in strength.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dwell.cost import cost
from dwell.estimators.prices import prices_of
from dwell.model import (
    AR1,
    Constant,
    Disturbance,
    Exponential,
    FrozenDict,
    Gamma,
    LogNormal,
    NodeDisturbance,
    Normal,
    Problem,
    Process,
    Scenario,
    Trace,
    Uniform,
)
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints

if TYPE_CHECKING:
    from dwell.sim import Realisation


#: Cycles of each candidate that count in the price of a set.
PRICED_CYCLES = 10_000
#: Steps of a ramp that are priced, the full strength included.
RAMP_PRICES = 8
#: Largest number of sets that are priced for one realisation.
MOST_SETS = 256


def expected_costs(problem: Problem, realisation: Realisation, decide_cycles: int) -> Floats:
    """Return the expected J of every candidate in every stretch between decisions.

    Parameters
    ----------
    realisation : Realisation
        Drawn for this problem; only its releases and its disturbances count.
    decide_cycles : int
        Cycles of a stretch; the last one may be shorter.

    Returns
    -------
    float64 array, shape (stretches, candidates)
        J of a window times the length of the stretch in windows, without switching terms.
    """
    sets, set_of_cycle = sets_of(problem, realisation)
    prices = np.array([_set_prices(problem, scenario) for scenario in sets])
    stretch = np.arange(realisation.cycles) // decide_cycles
    shape = (int(stretch[-1]) + 1, len(sets))
    cycles = np.bincount(stretch * len(sets) + set_of_cycle, minlength=math.prod(shape))
    costs: Floats = cycles.reshape(shape) @ prices / problem.window_cycles
    return costs


def sets_of(problem: Problem, realisation: Realisation) -> tuple[list[Scenario], Ints]:
    """Return the sets to price, and for every cycle the index of its set.

    A set is a scenario whose disturbances are always on.
    """
    from dwell.sim import Drawing

    drawn = Drawing.again(problem, realisation).episodes()
    kinds = list(dict.fromkeys(map(_always, drawn)))
    # Two equal disturbances may overlap, so a kind may be on twice.
    levels = np.zeros((realisation.cycles, len(kinds)), np.int64)
    release_ns = realisation.release_ns[:-1]
    for item in drawn:
        begin_ns, end_ns = (round(min(s * 1e9, NEVER_NS)) for s in (item.at_s, item.end_s))
        on = slice(*np.searchsorted(release_ns, (begin_ns, end_ns)).tolist())
        levels[on, kinds.index(_always(item))] += _levels(item, release_ns[on] / 1e9)
    rows, which, counts = np.unique(levels, axis=0, return_inverse=True, return_counts=True)
    priced = rows[np.sort(np.argsort(-counts, kind="stable")[:MOST_SETS])]
    nearest = np.array([np.abs(priced - row).sum(axis=1).argmin() for row in rows])
    return [_set(problem, kinds, row) for row in priced.tolist()], nearest[which.ravel()]


def _always(item: Disturbance) -> Disturbance:
    """Return a disturbance that is on from the first cycle to the last, at full strength."""
    return replace(item, at_s=0.0, for_s=math.inf, episodes=None, ramp_s=0.0)


def _levels(item: Disturbance, release_s: Floats) -> Ints:
    """Return the strength of a disturbance at releases while it is on, in steps of a ramp."""
    if not item.ramp_s:
        return np.full(len(release_s), RAMP_PRICES)
    inside_s = np.minimum(release_s - item.at_s, item.end_s - release_s)
    return np.rint(RAMP_PRICES * np.clip(inside_s / item.ramp_s, 0.0, 1.0)).astype(np.int64)


def _set(problem: Problem, kinds: list[Disturbance], levels: list[int]) -> Scenario:
    """Return the set in which each kind of disturbance has a level."""
    items: list[Disturbance] = []
    for kind, level in zip(kinds, levels, strict=True):
        whole, rest = divmod(level, RAMP_PRICES)
        items += [kind] * whole
        if rest:
            items.append(_weaker(problem, kind, rest / RAMP_PRICES))
    return tuple(items)


def _weaker(problem: Problem, item: Disturbance, share: float) -> Disturbance:
    """Return a disturbance at a share of its strength, as on a ramp."""
    if isinstance(item, NodeDisturbance):
        return replace(item, stress_threads=round(item.stress_threads * share))
    own_mbps, rate_mbps = problem.fabric.links[item.link].rate_mbps, item.rate_mbps
    if math.isfinite(rate_mbps):
        rate_mbps = 1 / ((1 - share) / own_mbps + share / rate_mbps)
    delay = None if item.add_delay_ms is None else _scaled(item.add_delay_ms, share)
    return replace(item, loss=item.loss * share, rate_mbps=rate_mbps, add_delay_ms=delay)


def _scaled(process: Process, share: float) -> Process:
    """Return the process whose values are a share of another's values."""
    if isinstance(process, LogNormal | Gamma | Exponential | AR1):
        return replace(process, mean=process.mean * share)
    if isinstance(process, Normal):
        return Normal(process.mean * share, process.std * share, process.min * share)
    if isinstance(process, Uniform):
        return Uniform(process.low * share, process.high * share)
    if isinstance(process, Trace):
        values = {process.column: process.values * share}
        return Trace(replace(process.table, columns=values), process.column)
    return Constant(process.expectation * share)


def _set_prices(problem: Problem, scenario: Scenario) -> list[float]:
    """Return J of a window of every candidate while a set is always on."""
    always = replace(problem, scenarios=FrozenDict(always=scenario))
    prices = prices_of(always, "always", cycles=PRICED_CYCLES)
    placements = problem.candidates.items()
    return [cost(prices[name].qos, one, one, problem.objective) for name, one in placements]
