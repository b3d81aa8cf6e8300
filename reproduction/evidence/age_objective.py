"""Does the mean age in J lower the tracking error? Which metric ranks the tracking error of runs?

``python -m reproduction.evidence.age_objective`` simulates both and writes `age-objective.md`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.stats import spearmanr

from dwell.model import Servo
from dwell.study import Interval, Point, StudyResult, compare, run_study
from reproduction.cell import DYNAMIC, RANDOM, STEADY, TIMETABLE, TIMETABLE_WINDOWS, paper_cell
from reproduction.evidence.measured_on import measured_on
from reproduction.questions import study_file

PAGE = Path(__file__).with_name("age-objective.md")
#: Windows of runs in scenarios that change at random.
RANDOM_WINDOWS = 100
#: Runs whose tracking errors are ranked: every placement in every scenario.
RANKED_SEEDS, RANKED_WINDOWS = range(1, 11), 60
#: Metrics that rank runs, with their titles.
RANKING = {"aoi_mean_ms": "mean age", "l95_ms": "L95", "violation_rate": "V_D"}
ERROR = "tracking_rms_mm"
RESAMPLES = 200

Floats: TypeAlias = NDArray[np.float64]
Rank: TypeAlias = Callable[[Floats, Floats], float]

TEXT = """# Age in place of L95 and V_D

Last m{measured} `python -m reproduction.evidence.age_objective`
wrote this page.

## Does it lower the tracking error?

[age.yaml](../studies/age.yaml): DTP with three objectives on the canonical cell, {seeds} paired
seeds. *Age* weighs the mean age (4), and not L95 and V_D; *age and V_D* weighs the mean age (1) in
place of L95. Runs in steady scenarios have {steady} windows, in `step` and `drift` {timetable}, in
the others {random}. Differences from the weights of the cell (L95 1, V_D 3) have 95 % intervals
over seeds. *Better*: the error is lower, and V_D is not higher, by these intervals.

| scenario | objective | error (mm) | difference (mm) | V_D (%) | difference (points) | moves | |
|---|---|---|---|---|---|---|---|
{rows}

* *Age* prefers SO to LOC and HYB: SO has a lower mean age, and more misses. The error falls by at
  most 0.4 %. V_D is equal or lower in `robot-cpu-stress` and `drift`; it rises in baseline,
  `bursts`, `mixture` and `step`.
* In `flapping` *age* raises the error. If E is loaded, or its network slow, it changes nothing.
* *Age and V_D* changes nearly nothing: misses decide, as with the weights of the cell.

## Which metric ranks the tracking error?

Spearman's rank correlation with the servo's tracking error (root mean square): {placements} in
{scenarios} scenarios, {ranked} seeds, {ranked_windows} windows per run. Intervals (95 %) resample
the seeds. *Within*: the mean over scenarios of the correlation of the runs in one scenario.
The mean age ranks runs best with each plant, most clearly among runs in the same scenario.

| plant | runs | {titles} |
|---|---|---|---|---|
{ranks}
"""


def main() -> None:
    """Simulate, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder that keeps finished runs")
    folder = parser.parse_args().out
    parts = list(played(folder))
    ranks = list(rankings())
    study = parts[0].study
    page = TEXT.format(
        measured=measured_on()[1:],
        seeds=len(study.seeds),
        steady=study.windows,
        timetable=TIMETABLE_WINDOWS,
        random=RANDOM_WINDOWS,
        rows="\n".join(row for part in parts for row in rows(part)),
        placements=", ".join(paper_cell().candidates),
        scenarios=len((*STEADY, *DYNAMIC)),
        ranked=len(RANKED_SEEDS),
        ranked_windows=RANKED_WINDOWS,
        titles=" | ".join(RANKING.values()),
        ranks="\n".join(ranks),
    )
    PAGE.write_text(page, encoding="utf-8")


# ------------------------------------------------------------------------------ objectives


def played(folder: Path | None) -> Iterator[StudyResult]:
    """Yield the study in steady scenarios, and in two kinds of scenarios that change."""
    study = study_file("age")
    changing = (Point({}, paper_cell()),)
    lengths = {RANDOM: RANDOM_WINDOWS, TIMETABLE: TIMETABLE_WINDOWS}
    yield run_study(study, folder=folder and folder / study.name, processes=1)
    for scenarios, windows in lengths.items():
        name = f"{study.name}-{windows}"
        part = replace(study, name=name, points=changing, scenarios=scenarios, windows=windows)
        yield run_study(part, folder=folder and folder / name, processes=1)


def rows(result: StudyResult) -> Iterator[str]:
    """Yield the rows of a study's table: each objective with age, against the first."""
    usual, *others = result.study.policies
    for scenario in result.study.scenarios:
        yield f"| `{scenario}` | {usual} | {means(result, scenario, usual)} |"
        for name in others:
            error = result.difference(scenario, (name, usual), ERROR)
            missed = result.difference(scenario, (name, usual), "violation_rate")
            yield f"| | {name} | {means(result, scenario, name, error, missed)} |"


def means(
    result: StudyResult,
    scenario: str,
    policy: str,
    error: Interval | None = None,
    missed: Interval | None = None,
) -> str:
    """Return the cells of a policy: means, differences, and whether it is better."""
    runs = result.runs.filter(scenario=scenario, policy=policy)
    mean_mm, rate, moves = (
        float(runs[name].cast(pl.Float64).to_numpy().mean())
        for name in (ERROR, "violation_rate", "migrations")
    )
    cells = [
        f"{mean_mm:.2f}",
        shown(error, 1.0, 3),
        f"{100 * rate:.2f}",
        shown(missed, 100.0, 2),
        f"{moves:.1f}",
        word(error, missed),
    ]
    return " | ".join(cells)


def shown(difference: Interval | None, factor: float, decimals: int) -> str:
    """Return a difference with its interval, in a unit."""
    if difference is None:
        return ""
    if is_none(difference):
        return "0: the same runs"
    low, value, high = (
        f"{factor * one:.{decimals}f}".replace("-", "−")
        for one in (difference.low, difference.value, difference.high)
    )
    return f"{value} [{low}, {high}]"


def word(error: Interval | None, missed: Interval | None) -> str:
    """Return whether an objective lowers the error at equal or lower V_D."""
    if error is None or missed is None:
        return ""
    if is_none(error) and is_none(missed):
        return "same"
    if error.high < 0:
        return "better" if is_none(missed) or missed.low <= 0 else "lower error, higher V_D"
    return "higher error" if error.low > 0 else "no difference shown"


def is_none(difference: Interval) -> bool:
    """Whether both policies had the same runs."""
    return difference.value == 0 and difference.low != difference.low


# -------------------------------------------------------------------------------- rankings


def plants() -> dict[str, Servo]:
    """Return the cell's servo, a faster one, and one whose commands are accelerations."""
    servo = paper_cell().servo
    assert servo is not None
    double = replace(servo, plant="double-integrator", gain=16.0, damping=8.0)
    return {
        f"integrator, gain {servo.gain:g} 1/s (the cell's)": servo,
        "integrator, gain 8 1/s": replace(servo, gain=8.0),
        "double integrator, gain 16 1/s², damping 8 1/s": double,
    }


def rankings() -> Iterator[str]:
    """Yield a row for each plant."""
    cell = paper_cell()
    for name, servo in plants().items():
        found = compare(
            replace(cell, servo=servo),
            policies=list(cell.candidates),
            scenarios=[*STEADY, *DYNAMIC],
            seeds=RANKED_SEEDS,
            windows=RANKED_WINDOWS,
            processes=1,
        )
        values = {metric: by_seed(found.runs, metric) for metric in (*RANKING, ERROR)}
        for runs, rank in (("all", rank_of_all), ("within", rank_within)):
            cells = [shown_rank(values[metric], values[ERROR], rank) for metric in RANKING]
            yield f"| {name} | {runs} | {' | '.join(cells)} |"


def by_seed(runs: pl.DataFrame, metric: str) -> Floats:
    """Return a metric of all runs, shape (seeds, scenarios, placements)."""
    ordered = runs.sort("seed", "scenario", "policy")[metric].cast(pl.Float64)
    return ordered.to_numpy().reshape(len(RANKED_SEEDS), len((*STEADY, *DYNAMIC)), -1)


def shown_rank(one: Floats, other: Floats, rank: Rank) -> str:
    """Return the rank correlation of two metrics, and its interval."""
    rng = np.random.default_rng(1)
    drawn = rng.integers(len(one), size=(RESAMPLES, len(one)))
    low, high = np.quantile([rank(one[seeds], other[seeds]) for seeds in drawn], (0.025, 0.975))
    return f"{rank(one, other):.2f} [{low:.2f}, {high:.2f}]"


def rank_of_all(one: Floats, other: Floats) -> float:
    """Return Spearman's rank correlation of two metrics over all runs."""
    return float(spearmanr(one.ravel(), other.ravel()).statistic)


def rank_within(one: Floats, other: Floats) -> float:
    """Return the mean over scenarios of the rank correlation over the runs in a scenario."""
    return float(np.mean([rank_of_all(one[:, i], other[:, i]) for i in range(one.shape[1])]))


if __name__ == "__main__":
    main()
