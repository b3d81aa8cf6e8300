"""Rules of coordination compared: `python -m benchmarks.coordination [--cells N] [--seeds K]`.

Makes the tables in reproduction/evidence/fleets.md: N canonical cells on one edge server, all
robots stressed from window 20 on, under every rule and estimator, and all fixed splits. J is the
mean over cells of windows 30 to 59. `--table` compares the table of loads with long runs, `--away`
takes the edge away for 8 s, with guards, while all robots are stressed, `--objectives` compares the
objectives of the ledger, and the plans by them.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
import polars as pl

import dwell
from benchmarks.canonical import CELL
from dwell.control.coordination import Coordination, Verdict, Wish
from dwell.control.ledger import FleetLedger, Seat
from dwell.cost import cost_error, price
from dwell.estimators.load_table import load_table
from dwell.model import AIM, NodeDisturbance, Problem
from dwell.model.fleet import Fleet, FleetEntry, FleetObjective
from dwell.model.progress import Progress
from dwell.record.fleet_run import FleetRun
from dwell.sim import fleet as fleets
from dwell.sim.fleet import phased, simulate_fleet, tabled_cells
from dwell.study.fleet_plan import best_placements, plan_fleet
from dwell.study.intervals import mean_interval
from reproduction.evidence.measured_on import measured_on

ESTIMATORS = "corrected", "scaling", "shadow"
RULES = "ledger", "random", "most-gain-first", "none"
SPLITS = "SO", "HYB"
CHANGE, FIRST, LAST, WINDOWS = 20, 30, 59, 60
#: Instant at which the edge goes, for how long, and the end of a run, seconds.
GONE_S, AWAY_S, END_S = 60, 8, 120
#: Limit of V_D with and without tenants, whose bursts alone make a cell miss 5.3 %.
LIMITS = {"no": AIM, "yes": 2 * AIM}
#: Cells for which the edge server of the canonical cell has its cores.
CELLS_A_SERVER = 12


class MostGainFirst(Coordination):
    """Lets the cell move that gained most at the last closes of all; one a window.

    As do best-response rules of computation offloading (arXiv 2501.04231).
    """

    def __init__(self, wishes: dict[int, dict[int, float]], index: int) -> None:
        self._wishes, self._index, self._window = wishes, index, 0

    def consider(self, wish: Wish) -> Verdict:
        """Let the move pass if nobody has gained more at the window before."""
        decision, incumbent = wish.decision, wish.incumbent
        window, self._window = self._window, self._window + 1
        if not decision.migrated:
            return Verdict(incumbent)
        gain = decision.costs[incumbent] - decision.costs[decision.name]
        self._wishes.setdefault(window, {})[self._index] = gain
        before = self._wishes.get(window - 1, {})
        if before and max(before, key=before.__getitem__) == self._index:
            return Verdict(decision.name)
        return Verdict(incumbent, "another one gains more")


class Outcome(NamedTuple):
    """A run under a rule."""

    cost: float
    violation_rate: float
    moves: int
    crossings: int
    most_crossings: int
    away_from_best: float


def fleet_of(cells: int, scenario: Sequence[NodeDisturbance]) -> Fleet:
    """Canonical cells on one server, with as many cores a cell as twelve have on one of eight."""
    cell = dwell.load(CELL)
    nodes = dict(cell.fabric.nodes)
    nodes["E"] = replace(nodes["E"], cores=round(nodes["E"].cores * cells / CELLS_A_SERVER))
    fabric = replace(cell.fabric, nodes=nodes)
    cell = replace(cell, fabric=fabric, scenarios={"change": tuple(scenario)})
    return Fleet("hall", (FleetEntry(cell, cells, "change"),), ("E",), "random")


def common_change(cells: int) -> Fleet:
    """Robots of all cells are stressed from window 20 on."""
    cell = dwell.load(CELL)
    at_s = CHANGE * cell.window_cycles * cell.pipeline.period_ms / 1e3
    return fleet_of(cells, [NodeDisturbance(node="R1", at_s=at_s, stress_threads=4)])


def cost_of(run: FleetRun) -> tuple[float, float]:
    """Mean J and V_D of the windows that count."""
    windows = run.windows.filter(pl.col("window").is_between(FIRST, LAST))
    mean = windows.select(pl.col("cost").mean(), pl.col("violation_rate").mean())
    return mean.row(0)


def play_split(cells: int, name: str, on_edge: int, seed: int) -> float:
    """Mean J with so many cells on a candidate, the others on LOC."""
    fleet = common_change(cells)
    (entry,) = fleet.entries
    parts = tuple(
        replace(entry, count=count, policy=policy)
        for count, policy in ((on_edge, name), (cells - on_edge, "LOC"))
        if count
    )
    fleet = replace(fleet, entries=parts, coordination="none")
    return cost_of(simulate_fleet(fleet, seed=seed, windows=WINDOWS, estimator="profile"))[0]


def play_rule(cells: int, rule: str, estimator: str, seed: int) -> Outcome:
    """Play a fleet under a rule."""
    ledgers: list[FleetLedger] = []
    wishes: dict[int, dict[int, float]] = {}
    made = fleets.coordinations

    def coordinations(
        fleet: Fleet, problems: Mapping[str, Problem], seed: int, progress: Progress | None = None
    ) -> Iterator[Coordination | None]:
        for i, one in enumerate(made(fleet, problems, seed, progress)):
            if isinstance(one, Seat) and not ledgers:
                ledgers.append(one.ledger)
            yield MostGainFirst(wishes, i) if rule == "most-gain-first" else one

    fleets.coordinations = coordinations
    try:
        run = simulate_fleet(
            common_change(cells),
            seed=seed,
            windows=WINDOWS,
            estimator=estimator,
            coordination="none" if rule == "most-gain-first" else rule,
        )
    finally:
        fleets.coordinations = made
    moves = run.decisions.filter("migrated")
    crossing = moves.filter((pl.col("incumbent") == "LOC") != (pl.col("placement") == "LOC"))
    most = crossing.group_by("cell").len()["len"].max() or 0
    away = above_best(ledgers[0]) if ledgers else float("nan")
    return Outcome(*cost_of(run), len(moves), len(crossing), int(str(most)), away)


def above_best(ledger: FleetLedger) -> float:
    """How much Φ a cell, as played, is above that of the table's optimum."""
    best = best_placements(ledger.loads, ledger.alone)
    here, there = (ledger.prices.price(tuple(one)) for one in (ledger.placements, best))
    return (here.phi - there.phi) / len(ledger.cells)


def rules(cells: int, seeds: Sequence[int], pool: ProcessPoolExecutor) -> Iterator[str]:
    """Yield the table of rules."""
    step = max(cells // 12, 1)
    sizes = range(0, cells + 1, step)
    best = ("", float("inf"))
    for name in SPLITS:
        for size in sizes:
            costs = list(pool.map(partial(play_split, cells, name, size), seeds))
            if (mean := float(np.mean(costs))) < best[1]:
                best = f"{size} on {name}", mean
    yield f"Best of the fixed splits: {best[0]}, J = {best[1]:.3f}.\n"
    yield "| rule | estimator | J | over the best split | V_D, % | moves | onto or off E | "
    yield "most of a cell | Φ/n above the optimum's |\n|---|---|---|---|---|---|---|---|---|\n"
    for rule in RULES:
        for estimator in ESTIMATORS:
            found = list(pool.map(partial(play_rule, cells, rule, estimator), seeds))
            cost, most = mean_interval([one.cost for one in found]), max(one[4] for one in found)
            means = Outcome(*np.mean(found, axis=0))
            away = f"{means.away_from_best:+.3f}" if rule == "ledger" else "–"
            yield (
                f"| {rule} | {estimator} | {cost.value:.3f} ({cost.low:.3f}, {cost.high:.3f}) | "
                f"{cost.value / best[1]:.3f} | {100 * means.violation_rate:.1f} | "
                f"{means.moves:.0f} | {means.crossings:.0f} | {most} | {away} |\n"
            )


def compare_table(cells: int, seeds: Sequence[int], pool: ProcessPoolExecutor) -> Iterator[str]:
    """Yield how far the table of loads is from long runs of those placements."""
    table = load_table(tabled_cells(fleet_of(cells, []), 1), ["E"])
    yield "| candidate | cells | J: table, run | V_D, %: table, run |\n|---|---|---|---|\n"
    objective = table.cells[0].problem.objective
    for name in SPLITS:
        column = table.columns[0, name]
        for row, level in enumerate(column.level.tolist()):
            size = round(level / column.level[0])
            rate, l95_ms = column.violation_rate[row], column.l95_ms[row]
            seen = list(pool.map(partial(long_run, cells, name, size), seeds))
            run_l95_ms, run_rate = np.mean(seen, axis=0)
            j, run_j = (
                price(one, of, 0.0, 0.0, 0.0, 0.0, objective)
                for one, of in ((l95_ms, rate), (run_l95_ms, run_rate))
            )
            error_ms, error = column.l95_error_ms[row], column.violation_error[row]
            j_error = cost_error((error_ms, error), objective)
            yield (
                f"| {name} | {size} | {j:.3f} ± {j_error:.3f}, {run_j:.3f} "
                f"({100 * (j / run_j - 1):+.1f} %) | {100 * rate:.2f} ± {100 * error:.2f}, "
                f"{100 * run_rate:.2f} ({100 * (rate - run_rate):+.2f}) |\n"
            )


def long_run(cells: int, name: str, size: int, seed: int) -> tuple[float, float]:
    """L95 and V_D of the first cells on a candidate, the others away."""
    fleet = fleet_of(cells, [])
    first = next(iter(phased(fleet, 1)))
    # The phases of the table's cells, other draws.
    tabled = tabled_cells(fleet, 1)[:size]
    phases = [cell.problem.pipeline.first_release_ms for cell in tabled]
    (entry,) = fleet.entries
    fleet = replace(
        fleet,
        entries=(replace(entry, count=size, policy=name),),
        phases=tuple(phases),
        coordination="none",
    )
    run = simulate_fleet(fleet, seed=100 + seed, windows=100, estimator="profile")
    windows = run.windows.filter(pl.col("window") >= first.warmup_windows)
    return windows.select(pl.col("seen_l95_ms").mean(), pl.col("violation_rate").mean()).row(0)


def objectives(cells: int, seeds: Sequence[int], pool: ProcessPoolExecutor) -> Iterator[str]:
    """Yield what each objective comes to under the same change: means over seeds."""
    yield "| tenants | objective | by | served cells | V_D of the worst cell, % | Σ J |\n"
    yield "|---|---|---|---|---|---|\n"
    for tenants, objective, by in itertools.product(
        LIMITS, get_args(FleetObjective), ("ledger", "plan")
    ):
        found = pool.map(partial(play_objective, cells, objective, by, tenants), seeds)
        columns = zip(*found, strict=True)
        shown = (f"{np.mean(one):.1f} ({min(one):.1f} to {max(one):.1f})" for one in columns)
        yield f"| {tenants} | {objective} | {by} | {' | '.join(shown)} |\n"


def play_objective(
    cells: int, objective: FleetObjective, by: str, tenants: str, seed: int
) -> tuple[float, float, float]:
    """Return the cells under the limit, V_D of the worst cell (%), and the sum of J."""
    fleet = common_change(cells)
    (entry,) = fleet.entries
    if tenants == "no":
        entry = replace(entry, cell=without_tenants(entry.cell))
    limit = LIMITS[tenants]
    fleet = replace(fleet, entries=(entry,), objective=objective, limit=limit)
    if by == "plan":
        stress = NodeDisturbance(node="R1", stress_threads=4)
        stressed = replace(entry, cell=replace(entry.cell, scenarios={"change": (stress,)}))
        found = plan_fleet(replace(fleet, entries=(stressed,)), seed=seed).placements.values()
        placed = tuple(replace(entry, count=1, policy=name) for name in found)
        fleet = replace(fleet, entries=placed, coordination="none")
    run = simulate_fleet(fleet, seed=seed, windows=WINDOWS, estimator="corrected")
    windows = run.windows.filter(pl.col("window").is_between(FIRST, LAST))
    by_cell = windows.group_by("cell").agg(pl.col("violation_rate", "cost").mean())
    rates = by_cell["violation_rate"].to_numpy()
    return float((rates <= limit).sum()), 100 * float(rates.max()), float(by_cell["cost"].sum())


def without_tenants(cell: Problem) -> Problem:
    """Return a cell whose edge server has no other tenants."""
    nodes = {**cell.fabric.nodes, "E": replace(cell.fabric.nodes["E"], bursts=None)}
    return replace(cell, fabric=replace(cell.fabric, nodes=nodes))


def away(cells: int, seeds: Sequence[int], pool: ProcessPoolExecutor) -> Iterator[str]:
    """Yield what happens when the edge goes and comes back: means over seeds."""
    back_s = GONE_S + AWAY_S
    spans = [(GONE_S - 10, GONE_S), (GONE_S, back_s)]
    spans += [(at, at + 10) for at in range(back_s, END_S - 9, 10)]
    yield "| cell | figure | " + " | ".join(f"{a} to {b} s" for a, b in spans) + " |\n"
    yield "|---" * (2 + len(spans)) + "|\n"
    for what in ("canonical", "no tenants, fallback LOC"):
        found = list(pool.map(partial(_gone, cells, spans, what != "canonical"), seeds))
        for figure, of_seeds in zip(
            ("V_D, %", "cells on E", "guard moves"), zip(*found, strict=True), strict=True
        ):
            means = " | ".join(f"{mean:.1f}" for mean in np.mean(of_seeds, axis=0))
            yield f"| {what} | {figure} | {means} |\n"


def _gone(
    cells: int, spans: Sequence[tuple[int, int]], alone: bool, seed: int
) -> tuple[list[float], list[float], list[float]]:
    """V_D (%), cells on E and moves of guards by spans of time."""
    stress = NodeDisturbance(node="R1", stress_threads=4)
    fleet = fleet_of(
        cells, [stress, NodeDisturbance(node="E", at_s=GONE_S, for_s=AWAY_S, down=True)]
    )
    (entry,) = fleet.entries
    cell = entry.cell
    if alone:
        controller = replace(cell.controller, fallbacks=("LOC",))
        cell = replace(without_tenants(cell), controller=controller)
    fleet = replace(fleet, entries=(replace(entry, cell=cell),), coordination="ledger")
    window_s = cell.window_cycles * cell.pipeline.period_ms / 1e3
    run = simulate_fleet(
        fleet, seed=seed, windows=round(END_S / window_s), estimator="corrected", guard=True
    )
    cycles = pl.concat([one.cycles[: one.last_window_end] for one in run.cells.values()])
    cycles = cycles.with_columns(pl.col("release_ns") / 1e9)
    moved = run.decisions.filter((pl.col("reason") == "guard") & pl.col("migrated"))
    late, there, guards = [], [], []
    for begin, end in spans:
        mine = cycles.filter(pl.col("release_ns").is_between(begin, end, closed="left"))
        late.append(100 * float(mine["missed"].to_numpy().mean()))
        there.append(cells * float((mine["placement"] != "LOC").to_numpy().mean()))
        at_s = (moved["window"] + 1) * window_s
        guards.append(float(at_s.is_between(begin, end, closed="left").sum()))
    return late, there, guards


def main(arguments: Iterable[str] | None = None) -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{Path(__file__).stem}")
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--table", dest="what", action="store_const", const=compare_table)
    parser.add_argument("--away", dest="what", action="store_const", const=away)
    parser.add_argument("--objectives", dest="what", action="store_const", const=objectives)
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args(arguments if arguments is None else list(arguments))
    seeds = range(1, asked.seeds + 1)
    print(measured_on(), end="\n\n", flush=True)
    with ProcessPoolExecutor(asked.processes) as pool:
        for text in (asked.what or rules)(asked.cells, seeds, pool):
            print(text, end="", flush=True)


if __name__ == "__main__":
    main()
