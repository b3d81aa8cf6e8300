"""Is the default policy within a margin of the best static placement, in each steady scenario?

``python -m reproduction.evidence.default_policy`` simulates both and writes `default-policy.md`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import dwell
from dwell.study import Comparison, Interval, compare
from reproduction.evidence.measured_on import measured_on

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).with_name("default-policy.md")
SCENARIOS = (
    "baseline",
    "robot-cpu-stress",
    "edge-cpu-stress",
    "network-impairment",
    "network-impairment-mild",
)
PLACEMENTS = ("LOC", "SO", "HYB")
#: Half of a point of V_D, written down before these seeds were simulated.
MARGIN = 0.005
SEEDS, WINDOWS = range(2001, 2041), 60

TEXT = """# The default policy against the best static placement

{measured} `python -m reproduction.evidence.default_policy` wrote this page: {seeds} seeds of
{windows} windows, of which 5 are warm-up; examples/first.yaml.

The margin of {margin:g} points was written down before any of these seeds was simulated. The
default policy (`dtp` with `corrected` estimates, four decisions per window) is within it if, in
every scenario, the 95 % interval of its V_D less the V_D of the best static placement ends below
the margin.

| scenario | V_D of the default (%) | best static | difference of V_D (points) | within |
|---|---|---|---|---|
{rows}
"""


def main() -> None:
    """Simulate, and write the page."""
    found = compare(
        dwell.load(ROOT / "examples" / "first.yaml"),
        policies=[*PLACEMENTS, "dtp"],
        scenarios=SCENARIOS,
        seeds=SEEDS,
        windows=WINDOWS,
        processes=1,
    )
    page = TEXT.format(
        measured=measured_on(),
        seeds=len(SEEDS),
        windows=WINDOWS,
        margin=100 * MARGIN,
        rows="\n".join(row(found, scenario) for scenario in SCENARIOS),
    )
    PAGE.write_text(page, encoding="utf-8")


def row(found: Comparison, scenario: str) -> str:
    """Return a scenario's row of the table."""
    means = {
        name: float(np.mean(found.runs.filter(scenario=scenario, policy=name)["violation_rate"]))
        for name in (*PLACEMENTS, "dtp")
    }
    best = min(PLACEMENTS, key=means.__getitem__)
    pair = found.difference(scenario, ("dtp", best), "violation_rate")
    is_within = (pair.value if pair.value == 0 else pair.high) < MARGIN
    cells = (scenario, f"{100 * means['dtp']:.2f}", best, shown(pair), "yes" if is_within else "no")
    return f"| {' | '.join(cells)} |"


def shown(pair: Interval) -> str:
    """Return a difference with its interval, in points."""
    if pair.value == 0 and pair.low != pair.low:
        return "0: the same runs"
    return f"{100 * pair.value:.2f} [{100 * pair.low:.2f}, {100 * pair.high:.2f}]"


if __name__ == "__main__":
    main()
