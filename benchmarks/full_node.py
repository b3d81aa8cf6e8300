"""Fleets whose shared node others load: `python -m benchmarks.full_node [--seeds K] [--cells N]`.

Twelve canonical cells, with and without tenants on E, guards off and on. Each scenario of the
canonical cell, and 4 to 16 more foreign threads on E, begins at window 15 of 45. The ledger is
compared with cells that ask nobody, on the same draws: mean J under `sum`, J of the worst cell
under `worst`, and V_D, from window 20 on; the share of windows from 25 on whose cell was in Φ.

`--alarms` counts how often the watchdog stops trusting a model where nothing happens, per 300
windows of a cell: in the fleet, and in cells alone that replay recordings (`benchmarks.regimes`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import polars as pl

import dwell
from benchmarks import regimes
from benchmarks.canonical import CELL
from dwell.control.watchdog import NOT_AS_PLAYED, Expected, SeenWindow, Watchdog
from dwell.model import NodeDisturbance, Problem, Scenario
from dwell.model.fleet import Coordination, Fleet, FleetEntry, FleetObjective
from dwell.record.fleet_run import FleetRun
from dwell.study.intervals import mean_interval

BEGIN, FIRST, IN_PHI, WINDOWS = 15, 20, 25, 45
#: Foreign threads on E, of eight cores.
THREADS = 4, 6, 8, 16
OBJECTIVES: tuple[FleetObjective, ...] = ("sum", "worst")


class Outcome(NamedTuple):
    """A run: its mean J and that of its worst cell, V_D, and the share of windows in Φ."""

    cost: float
    worst: float
    violation_rate: float
    in_phi: float


def problem_of(name: str, *, tenants: bool) -> Problem:
    """Return the canonical cell with a scenario that begins at window `BEGIN`."""
    cell = dwell.load(CELL)
    at_s = BEGIN * cell.window_ms / 1e3
    items: Scenario = ()
    if name.startswith("E + "):
        items = (NodeDisturbance("E", at_s, stress_threads=int(name[4:])),)
    else:
        items = tuple(replace(item, at_s=at_s) for item in cell.scenarios[name])
    edge = cell.fabric.nodes["E"]
    nodes = {**cell.fabric.nodes, "E": edge if tenants else replace(edge, bursts=None)}
    fabric = replace(cell.fabric, nodes=nodes)
    return replace(cell, fabric=fabric, scenarios={"late": items} if items else {})


def fleet_of(
    problem: Problem, cells: int, rule: Coordination, objective: FleetObjective = "sum"
) -> Fleet:
    """Return so many cells on one server, at random phases."""
    scenario = "late" if "late" in problem.scenarios else "baseline"
    entry = FleetEntry(problem, cells, scenario)
    return Fleet("hall", (entry,), ("E",), "random", rule, objective)


def outcome(run: FleetRun) -> Outcome:
    """Return what counts of a run."""
    counted = run.windows.filter(pl.col("window") >= FIRST)
    by_cell = counted.group_by("cell").agg(pl.col("cost").mean())["cost"].to_numpy()
    rate = float(counted["violation_rate"].to_numpy().mean())
    return Outcome(float(by_cell.mean()), float(by_cell.max()), rate, share_in_phi(run))


def share_in_phi(run: FleetRun) -> float:
    """Return the share of decisions from window `IN_PHI` on at which the cell was in Φ."""
    if "refused" not in run.decisions.columns:
        return 1.0
    later = run.decisions.filter(pl.col("window") >= IN_PHI)
    away = later["refused"].fill_null("").str.ends_with(NOT_AS_PLAYED)
    return 1.0 - float(away.to_numpy().mean())


def play(
    name: str,
    rule: Coordination,
    objective: FleetObjective,
    cells: int,
    seed: int,
    *,
    tenants: bool,
    guard: bool,
) -> Outcome:
    """Play a scenario under a rule."""
    fleet = fleet_of(problem_of(name, tenants=tenants), cells, rule, objective)
    run = dwell.simulate_fleet(
        fleet, seed=seed, windows=WINDOWS, estimator="corrected", guard=guard
    )
    return outcome(run)


def table(cells: int, seeds: Sequence[int], pool: ProcessPoolExecutor) -> Iterator[str]:
    """Yield the table of scenarios."""
    yield "| scenario | tenants | guard | objective | J: none, ledger | difference | "
    yield "V_D, %: none, ledger | in Φ, % | holds |\n|---|---|---|---|---|---|---|---|---|\n"
    names = [*dwell.load(CELL).scenarios, *(f"E + {threads}" for threads in THREADS)]
    for name, tenants, guard in product(names, (True, False), (False, True)):
        how = {"tenants": tenants, "guard": guard}
        none = list(pool.map(partial(play, name, "none", "sum", cells, **how), seeds))
        for objective in OBJECTIVES:
            ledger = list(pool.map(partial(play, name, "ledger", objective, cells, **how), seeds))
            which = 0 if objective == "sum" else 1
            off = mean_interval([b[which] - a[which] for a, b in zip(none, ledger, strict=True)])
            costs = [sum(one[which] for one in some) / len(some) for some in (none, ledger)]
            rates = [
                100 * sum(one.violation_rate for one in some) / len(some) for some in (none, ledger)
            ]
            in_phi = 100 * sum(one.in_phi for one in ledger) / len(ledger)
            holds = off.low <= 0 and rates[1] <= rates[0] + 1 and in_phi >= 90
            yield (
                f"| {name} | {'yes' if tenants else 'no'} | {'on' if guard else 'off'} | "
                f"{objective} | {costs[0]:.3f}, {costs[1]:.3f} | {off.value:+.3f} "
                f"({off.low:+.3f}, {off.high:+.3f}) | {rates[0]:.1f}, {rates[1]:.1f} | "
                f"{in_phi:.0f} | {'yes' if holds else '**no**'} |\n"
            )


@contextmanager
def counted_alarms() -> Iterator[list[None]]:
    """Count how often any watchdog stops trusting a model."""
    found: list[None] = []
    compare = Watchdog.compare

    def counting(self: Watchdog, seen: SeenWindow, played: Expected) -> bool:
        changed = compare(self, seen, played)
        if changed and not self.trusts:
            found.append(None)
        return changed

    Watchdog.compare = counting  # type: ignore[method-assign]
    try:
        yield found
    finally:
        Watchdog.compare = compare  # type: ignore[method-assign]


def alarms(cells: int, windows: int, seed: int) -> float:
    """Return how often a cell of an undisturbed fleet leaves Φ, per 300 windows."""
    fleet = fleet_of(problem_of("baseline", tenants=True), cells, "ledger")
    with counted_alarms() as found:
        dwell.simulate_fleet(fleet, seed=seed, windows=windows, estimator="corrected")
    return 300 * len(found) / (cells * windows)


def alarms_alone(name: str, windows: int, seed: int) -> float:
    """Return how often a cell alone mistrusts an estimate, on any candidate, per 300 windows."""
    problem = dwell.load(CELL) if name == "canonical" else regimes.cells()[name]
    with counted_alarms() as found:
        for placed in problem.candidates:
            dwell.simulate(
                problem, policy=placed, estimator="corrected", seed=seed, windows=windows
            )
    return 300 * len(found) / (windows * len(problem.candidates))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--alarms", action="store_true")
    args = parser.parse_args()
    seeds = range(1, args.seeds + 1)
    with ProcessPoolExecutor(args.jobs) as pool:
        if args.alarms:
            found = list(pool.map(partial(alarms, args.cells, 300), seeds))
            print(f"{args.cells} canonical cells: {sum(found) / len(found):.2f}", flush=True)
            recorded = regimes.cells() if regimes.TRACES.is_dir() else {}
            for name in ("canonical", *recorded):
                found = list(pool.map(partial(alarms_alone, name, 300), seeds))
                print(f"{name}: {sum(found) / len(found):.2f}", flush=True)
            return
        for line in table(args.cells, seeds, pool):
            print(line, end="", flush=True)


if __name__ == "__main__":
    main()
