"""Write reproduction/evidence/dynamic-scenarios.md: `python -m docs.dynamic_tables`, half a minute.

Static placements over 20 seeds: J and V_D of the windows inside one phase, with the 95 % interval
of J over seeds. The lowest J is bold if it differs from the next, seed by seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

import dwell
from dwell.model import NodeDisturbance, Problem
from dwell.study import load_study, mean_interval
from dwell.study.drawn_disturbances import drawn_disturbances
from reproduction.evidence.measured_on import measured_on

ROOT = Path(__file__).parents[1]
STUDY = ROOT / "examples" / "studies" / "dynamic.yaml"
PAGE = ROOT / "reproduction" / "evidence" / "dynamic-scenarios.md"
CANDIDATES = ("LOC", "SO", "HYB")
SEEDS = range(1, 21)

Floats: TypeAlias = NDArray[np.float64]
Truths: TypeAlias = NDArray[np.bool_]

#: Bounds of the phases, seconds; 17 s are the warm-up.
PHASES: Mapping[str, tuple[tuple[float, float], ...]] = {
    "step": tuple(
        zip(
            (17, 95, 195, 295, 395, 495, 595, 695, 795, 895),
            (95, 195, 295, 395, 495, 595, 695, 795, 895, 995),
            strict=True,
        )
    ),
    "drift": (
        (17, 115), (115, 220), (220, 270), (270, 320), (320, 400), (400, 490), (490, 580),
        (600, 650), (650, 700), (700, 740), (740, 840), (840, 880), (880, 930), (930, 980),
    ),
}  # fmt: skip


class Windows(NamedTuple):
    """Windows of one run after the warm-up, one value a window."""

    begin_s: Floats
    end_s: Floats
    cost: Floats
    missed: Floats


def played(problem: Problem, scenario: str, seed: int) -> dict[str, Windows]:
    """Play every candidate alone."""
    found = {}
    for name in CANDIDATES:
        run = dwell.simulate(problem, scenario=scenario, policy=name, seed=seed, windows=300)
        windows = run.windows.filter(~run.windows["warmup"])
        begin_s = windows["first_cycle"].to_numpy() * problem.pipeline.period_ms / 1e3
        end_s = begin_s + problem.window_cycles * problem.pipeline.period_ms / 1e3
        costs, rates = windows["cost"].to_numpy(), windows["violation_rate"].to_numpy()
        found[name] = Windows(begin_s, end_s, costs, rates)
    return found


def row(seeds: list[dict[str, tuple[float, float]]]) -> str:
    """Write J and V_D of every candidate, of seeds that have any such window."""
    costs = {name: np.array([one[name][0] for one in seeds]) for name in CANDIDATES}
    rates = {name: np.mean([one[name][1] for one in seeds]) for name in CANDIDATES}
    best, following = sorted(CANDIDATES, key=lambda name: float(costs[name].mean()))[:2]
    clear = mean_interval(costs[following] - costs[best]).low > 0
    cells = []
    for name in CANDIDATES:
        mean, low, high = mean_interval(costs[name])
        cell = f"{mean:.2f} ± {max(mean - low, high - mean):.2f}, {100 * rates[name]:.0f} %"
        cells.append(f"**{cell}**" if clear and name == best else cell)
    return " | ".join(cells)


def means(runs: dict[str, Windows], chosen: Truths) -> dict[str, tuple[float, float]]:
    """Return mean J and V_D of some of the windows."""
    return {
        name: (float(one.cost[chosen].mean()), float(one.missed[chosen].mean()))
        for name, one in runs.items()
    }


def faults(
    problem: Problem, scenario: str, seed: int, windows: Windows
) -> Iterator[frozenset[str]]:
    """Yield what is on throughout each window; ``some`` where anything is for a part of it."""
    items = drawn_disturbances(problem, scenario, seed, 300)
    spans: dict[str, list[tuple[float, float]]] = {}
    for item in items:
        where = item.node if isinstance(item, NodeDisturbance) else item.link
        spans.setdefault(where, []).append((item.at_s, item.at_s + item.for_s))
    for begin, end in zip(windows.begin_s, windows.end_s, strict=True):
        on = set()
        for where, known in spans.items():
            meet = [(max(a, begin), min(b, end)) for a, b in known if a < end and b > begin]
            if meet:
                whole = any(a <= begin and b >= end for a, b in meet)
                on.add(where if whole else "some")
        yield frozenset(on)


HEAD = """# Static placements in the dynamic scenarios

{measured} `python -m docs.dynamic_tables` wrote
this page: J and V_D of each placement if it never moves, 20 seeds of 300 windows, the warm-up left
out; ± is the 95 % interval over seeds. The lowest J is bold if its interval to the next, seed by
seed, leaves out 0. [Changing scenarios](changing-scenarios.md) describes the
phases and faults.
"""


def phases(scenario: str, runs: Mapping[int, dict[str, Windows]]) -> Iterator[str]:
    """Yield a row for each phase, over the windows inside it."""
    yield "| s | LOC | SO | HYB |"
    yield "|---|---|---|---|"
    for begin, end in PHASES[scenario]:
        within = {
            seed: (one["LOC"].begin_s >= begin) & (one["LOC"].end_s <= end)
            for seed, one in runs.items()
        }
        yield f"| {begin} to {end} | {row([means(runs[seed], within[seed]) for seed in SEEDS])} |"


def combinations(
    problem: Problem, scenario: str, runs: Mapping[int, dict[str, Windows]]
) -> Iterator[str]:
    """Yield a row for each of the 14 most frequent sets of faults that last a window."""
    yield "| fault throughout the window | of the windows | LOC | SO | HYB |"
    yield "|---|---|---|---|---|"
    on = {seed: list(faults(problem, scenario, seed, runs[seed]["LOC"])) for seed in SEEDS}
    kinds = [kind for known in on.values() for kind in known]
    for kind in sorted(set(kinds), key=kinds.count, reverse=True)[:14]:
        chosen = {seed: np.array([one == kind for one in on[seed]]) for seed in SEEDS}
        some = [means(runs[seed], chosen[seed]) for seed in SEEDS if chosen[seed].any()]
        share = 100 * kinds.count(kind) / len(kinds)
        yield f"| {', '.join(sorted(kind)) or 'nothing'} | {share:.0f} % | {row(some)} |"


def tables() -> Iterator[str]:
    """Yield the lines of all tables."""
    problem = load_study(STUDY).points[0].problem
    gains = []
    for scenario in ("step", "drift", "bursts", "flapping", "mixture"):
        runs = {seed: played(problem, scenario, seed) for seed in SEEDS}
        everything = [means(one, np.ones(len(one["LOC"].cost), bool)) for one in runs.values()]
        yield f"\n## `{scenario}`\n"
        if scenario in PHASES:
            yield from phases(scenario, runs)
            yield f"| all | {row(everything)} |"
        else:
            yield from combinations(problem, scenario, runs)
            yield f"| all | | {row(everything)} |"
        table = np.stack([[one[name].cost for name in CANDIDATES] for one in runs.values()])
        lowest = table.argmin(axis=1)
        average = table.mean(axis=(0, 2))
        shares = ", ".join(f"{100 * (lowest == i).mean():.0f}" for i in range(3))
        best = f"{average.min():.2f} ({CANDIDATES[average.argmin()]})"
        gains.append(f"| `{scenario}` | {best} | {table.min(axis=1).mean():.2f} | {shares} % |")
    yield "\n## Lowest J of each window\n"
    yield "| scenario | best static placement | lowest in each window | windows won: LOC, SO, HYB |"
    yield "|---|---|---|---|"
    yield from gains


def main() -> None:
    """Write the page."""
    head = HEAD.format(measured=measured_on())
    PAGE.write_text(head + "\n".join(tables()) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
