"""Figure and tables of "How often to decide": `python -m docs.decide_cycles`.

It plays the runs that docs/images/decide-cycles.csv lacks (all of them take an hour), and writes
that file and docs/images/decide-cycles.svg. Intervals are 95 % intervals over seeds, and
differences are taken seed by seed. `--seeds N` plays N seeds of each scenario.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import polars as pl

from benchmarks.sooner import INTERVALS, SCENARIOS, compared
from dwell.display import Measure
from dwell.report.charts import curves
from dwell.report.figure import Figure, Spec, printed_svg
from dwell.report.figure_files import BOTH_PT
from dwell.report.palette import Palette
from dwell.study import mean_interval
from reproduction.evidence.measured_on import measured_on

IMAGES = Path(__file__).parent / "images"
DATA, DRAWING = IMAGES / "decide-cycles.csv", IMAGES / "decide-cycles.svg"
WINDOWS = 300
#: Intervals in the order in which they are played, the default first.
PASSES = ((25,), (5, 10, 50, 100))
#: Panels of the figure, and what each of them shows.
PANELS = {
    "missed_less": "difference of V_D, points",
    "cost_less": "difference of J, %",
    "undone": "moves undone in 100 windows",
}
#: What the shortest interval may have, in the scenarios in which moves gain little.
CALM, MOST_UNDONE, MOST_COST = ("baseline", "flapping"), 2.0, 0.5


def rows(seeds: int) -> pl.DataFrame:
    """Return the figures of all runs, and play those that are missing."""
    known = pl.read_csv(DATA) if DATA.exists() else pl.DataFrame()
    for intervals, seed, scenario in itertools.product(PASSES, range(1, seeds + 1), SCENARIOS):
        if known.height and known.filter(scenario=scenario, seed=seed, every=intervals[0]).height:
            continue
        print(f"{scenario}, seed {seed} ...", file=sys.stderr, flush=True)
        new = pl.DataFrame([asdict(row) for row in compared(scenario, seed, WINDOWS, intervals)])
        known = pl.concat([known, new], how="diagonal_relaxed").sort("scenario", "every", "seed")
        known.write_csv(DATA, float_precision=6)
    return known.filter(pl.col("seed") <= seeds)


def summarised(runs: pl.DataFrame) -> pl.DataFrame:
    """Return mean and interval of every measure by scenario and interval between decisions."""
    found = []
    for panel, heading in PANELS.items():
        for scenario in SCENARIOS:
            for every in INTERVALS:
                of = runs.filter(scenario=scenario, every=every)
                mean, low, high = mean_interval(of[panel].to_numpy())
                found.append(
                    {
                        "scenario": heading,
                        "policy": scenario,
                        "at": str(every),
                        "mean": mean,
                        "low": low,
                        "high": high,
                    }
                )
    return pl.DataFrame(found)


def figure(summary: pl.DataFrame) -> Figure:
    """Draw every measure over the interval, a line per scenario."""
    styles = Palette.of((), SCENARIOS).policies
    drawn = curves(summary, Measure("mean", "mean over seeds"), styles, "cycles between decisions")

    def draw(width: float) -> Spec:
        return {**drawn(width), "resolve": {"scale": {"y": "independent"}}}

    return Figure("decide-cycles", "How often to decide", {"rows": summary}, draw)


def table(runs: pl.DataFrame, measure: str, decimals: int) -> Iterator[str]:
    """Yield the lines of a measure's table."""
    yield "| | " + " | ".join(f"every {every}" for every in INTERVALS) + " |"
    yield "|---" * (1 + len(INTERVALS)) + "|"
    for scenario in SCENARIOS:
        cells = []
        for every in INTERVALS:
            values = runs.filter(scenario=scenario, every=every)[measure].drop_nulls()
            if values.is_empty():
                cells.append("")
                continue
            mean, low, high = mean_interval(values.to_numpy())
            half = max(mean - low, high - mean)
            cells.append(f"{mean:.{decimals}f} ± {half:.{decimals}f}".replace("-", "−"))
        yield f"| `{scenario}` | " + " | ".join(cells) + " |"


def shortest(runs: pl.DataFrame) -> int | None:
    """Return the shortest interval whose moves and J are within bounds in calm scenarios."""
    for every in INTERVALS:
        means = [
            runs.filter(scenario=scenario, every=every).select("undone", "cost_less").mean().row(0)
            for scenario in CALM
        ]
        if all(undone <= MOST_UNDONE and cost <= MOST_COST for undone, cost in means):
            return every
    return None


def main() -> None:
    """Write the figure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    runs = rows(parser.parse_args().seeds)
    DRAWING.write_text(printed_svg(figure(summarised(runs)), BOTH_PT), encoding="utf-8")
    headings = {
        "missed": ("V_D, %", 1),
        "missed_less": ("V_D less, points", 1),
        "cost": ("J", 3),
        "cost_less": ("J less, %", 1),
        "undone": ("Moves undone in 100 windows", 1),
        "over_oracle": ("J above the oracle's, %", 1),
    }
    print(measured_on())
    for measure, (heading, decimals) in headings.items():
        print(f"\n{heading}\n")
        print("\n".join(table(runs, measure, decimals)))
    print(f"\nshortest with few moves undone in calm scenarios: {shortest(runs)}")


if __name__ == "__main__":
    main()
