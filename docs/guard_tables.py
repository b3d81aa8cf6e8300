"""The tables of reproduction/evidence/guard.md: `python -m docs.guard_tables`, some minutes.

The canonical cell under three policies, four seeds of 300 windows each, with and without its guard.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import polars as pl

import dwell
from dwell.model import LinkDisturbance, NodeDisturbance, Problem
from dwell.model.scenario import Disturbance
from reproduction.evidence.measured_on import measured_on

CELL = Path(__file__).parents[1] / "examples" / "canonical.yaml"
POLICIES = "dtp", "latency-first", "work-function"
SEEDS = range(1, 5)
WINDOWS = 300
FAULT_S, EVERY_S = 8.0, 60.0
FAULTS: Mapping[str, NodeDisturbance | LinkDisturbance] = {
    "E down": NodeDisturbance("E", for_s=FAULT_S, down=True),
    "R1 to E down": LinkDisturbance("R1", "E", for_s=FAULT_S, down=True),
    "R2 down": NodeDisturbance("R2", for_s=FAULT_S, down=True),
}
SCENARIOS = (
    "baseline",
    "robot-cpu-stress",
    "edge-cpu-stress",
    "network-impairment",
    "network-impairment-mild",
)


def with_faults(problem: Problem) -> Problem:
    """Return the cell with a scenario for each fault, which comes again and again."""
    windows_s = WINDOWS * problem.window_cycles * problem.pipeline.period_ms / 1e3
    begins_s = [EVERY_S * (i + 0.5) for i in range(int(windows_s / EVERY_S))]

    def repeated(fault: NodeDisturbance | LinkDisturbance) -> tuple[Disturbance, ...]:
        return tuple(replace(fault, at_s=at_s) for at_s in begins_s)

    faults = {name: repeated(fault) for name, fault in FAULTS.items()}
    return replace(problem, scenarios={**problem.scenarios, **faults})


def longest_loss(run: dwell.Run) -> int:
    """Most cycles in a row that were lost."""
    rows = groupby(run.cycles["outcome"][: run.last_window_end].to_list())
    return max((len(list(group)) for outcome, group in rows if outcome != "done"), default=0)


def lost_share(run: dwell.Run) -> float:
    outcomes = run.cycles["outcome"][: run.last_window_end]
    return float(np.mean((outcomes != "done").to_numpy()))


def moves(run: dwell.Run, *, guard: bool) -> int:
    by_guard = pl.col("reason") == "guard"
    return len(run.decisions.filter(pl.col("migrated") & (by_guard if guard else ~by_guard)))


def played(
    problem: Problem, scenario: str, *, guard: bool, policies: Sequence[str] = POLICIES
) -> Iterator[dwell.Run]:
    for policy in policies:
        for seed in SEEDS:
            yield dwell.simulate(
                problem, scenario=scenario, policy=policy, seed=seed, windows=WINDOWS, guard=guard
            )


def of_range(values: list[float], digits: int = 0, scale: float = 1.0) -> str:
    """Write the least and the most, once where they are the same."""
    low, high = (f"{scale * value:.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def fault_row(problem: Problem, name: str) -> str:
    runs = {guard: list(played(problem, name, guard=guard)) for guard in (False, True)}
    longest = (of_range([longest_loss(run) for run in runs[guard]]) for guard in (False, True))
    shares = (
        of_range([lost_share(run) for run in runs[guard]], digits=1, scale=100) + " %"
        for guard in (False, True)
    )
    return f"| {name} | {' | '.join((*longest, *shares))} |"


def scenario_row(problem: Problem, name: str) -> str:
    """Write what the guard does under DTP where nothing is down."""
    without, with_guard = (
        list(played(problem, name, guard=guard, policies=["dtp"])) for guard in (False, True)
    )
    own = sum(moves(run, guard=True) for run in with_guard)
    orders = (sum(moves(run, guard=False) for run in runs) for runs in (without, with_guard))
    rates = (
        100 * float(np.mean([run.windows["violation_rate"].to_numpy().mean() for run in runs]))
        for runs in (without, with_guard)
    )
    columns = own, ", ".join(map(str, orders)), ", ".join(f"{rate:.1f} %" for rate in rates)
    return f"| {name} | {' | '.join(map(str, columns))} |"


if __name__ == "__main__":
    print(measured_on(), flush=True)
    cell = with_faults(dwell.load(CELL))
    for fault in FAULTS:
        print(fault_row(cell, fault), flush=True)
    for scenario in SCENARIOS:
        print(scenario_row(cell, scenario), flush=True)
