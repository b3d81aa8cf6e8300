"""RQ4: the five weights of J: how much DTP's results depend on them, in every scenario.

All five together in a Sobol design, and one at a time: see README.md.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import polars as pl
from SALib.analyze import sobol as analysis
from SALib.sample import sobol as sampling

from dwell.model import Problem
from dwell.study import Contender, Interval, StudyResult
from reproduction.cell import DYNAMIC, STEADY, by_length, dtp, of_cell
from reproduction.maps import LABELS
from reproduction.questions import Run
from reproduction.scale import Scale
from reproduction.verdicts import COLUMNS, Answer, claims

TITLE = "RQ4: Does it matter how the five weights are chosen?"

#: The weights of an objective, and what the paper calls them.
WEIGHTS = {"latency": "α_L", "violations": "α_V", "robot": "α_r", "edge": "α_e", "switching": "α_S"}
#: The cell's weights are multiplied, and divided, by at most this.
FACTOR = 4.0
OUTPUTS = ("violation_rate", "l95_ms", "migrations", "tracking_rms_mm", "cost")
#: The design is made for the unit cube; its range is ours to apply.
#: Differences of V_D that are taken for none, written down before any fresh seed was played.
MARGIN = 0.005
SALIB = {"num_vars": len(WEIGHTS), "names": list(WEIGHTS), "bounds": [[0.0, 1.0]] * len(WEIGHTS)}

#: One at a time: factors by the words that stand for them.
STEPS = {"× 0": 0.0, "× ½": 0.5, "× 2": 2.0}
ONE_AT_A_TIME = ("baseline", "step", "bursts")
AS_IT_IS = "as in the cell"


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Vary the weights, all together and one at a time."""
    shares = sampling.sample(SALIB, scale.sobol_n, calc_second_order=False, scramble=True, seed=1)
    weights = np.array([getattr(cell.objective.weights, name) for name in WEIGHTS])
    rows = weights / FACTOR * (FACTOR * FACTOR) ** shares
    together = [
        of_cell(f"weights{suffix}", cell, mine, weighing(rows), seeds, windows)
        for seeds in (scale.fresh_seeds[: scale.sobol_seeds],)
        for suffix, mine, windows in by_length(
            (*STEADY, *DYNAMIC), scale.sobol_windows, scale.dynamic_windows
        )
    ]
    alone = [
        of_cell(f"weights-one{suffix}", cell, mine, stepping(cell), scale.fresh_seeds, windows)
        for suffix, mine, windows in by_length(ONE_AT_A_TIME, scale.windows, scale.dynamic_windows)
    ]
    swept = pl.concat([indices(run(study), scale.sobol_n) for study in together])
    runs = pl.concat([run(study).runs for study in alone])
    pairs = [(one.name, AS_IT_IS) for one in alone[0].contenders if one.name != AS_IT_IS]
    asked = {"One weight changed changes a metric": pairs}
    return Answer(
        pl.concat(claims(runs, OUTPUTS, ONE_AT_A_TIME, asked, *alone, margin=MARGIN)),
        {"Outputs over the weights, the part of it that is luck, and Sobol indices": swept},
        cells_of(swept, f"{scale.sobol_seeds} seeds of {scale.sobol_n * 7} settings"),
    )


def cells_of(swept: pl.DataFrame, design: str) -> pl.DataFrame:
    """Return the total indices of V_D, and what V_D spans over the weights, as a map."""
    rates = swept.filter(metric=OUTPUTS[0])
    shares = rates.select(
        panel=pl.lit("S_T: share of the variance of V_D"),
        row="scenario",
        column="weight",
        effect="ST",
        low="ST_low",
        high="ST_high",
    )
    spans = rates.unique("scenario", maintain_order=True).select(
        panel=pl.lit("V_D, points: 5th to 95th percentile"),
        row="scenario",
        column=pl.lit("all five"),
        effect=100 * (pl.col("high") - pl.col("low")),
    )
    cells = pl.concat([shares, spans], how="diagonal")
    words = {"claim": "Sobol indices", "first": "", "second": "", "metric": OUTPUTS[0], "word": ""}
    return cells.with_columns(
        **{name: pl.lit(word) for name, word in words.items()},
        design=pl.lit(design),
        scenario="row",
        **{name: pl.lit(None, pl.Float64) for name in ("p", "p_least")},
    ).select(*LABELS, *COLUMNS)


def weighing(rows: np.ndarray) -> tuple[Contender, ...]:
    """Return a DTP for every row of a design."""
    paths = [f"objective.weights.{name}" for name in WEIGHTS]
    return tuple(
        dtp(f"{index:04d}", dict(zip(paths, map(float, row), strict=True)))
        for index, row in enumerate(rows)
    )


def stepping(cell: Problem) -> tuple[Contender, ...]:
    """Return a DTP with the cell's weights, and one for every step of one of them."""
    weights = cell.objective.weights
    changed = [
        dtp(f"{symbol} {step}", {f"objective.weights.{name}": getattr(weights, name) * factor})
        for (name, symbol), (step, factor) in product(WEIGHTS.items(), STEPS.items())
    ]
    return (dtp(AS_IT_IS, {}), *changed)


def indices(result: StudyResult, n: int) -> pl.DataFrame:
    """Return one row a scenario, output and weight: the output's range, its luck, S1 and ST.

    Indices have the ends of their 95 % intervals over base points of the design; small ones may
    seem to be negative. They are null where the output is the same at every point, or infinite.
    """
    study = result.study
    shape = (len(study.contenders), len(study.seeds))
    rows: list[dict[str, object]] = []
    for scenario, output in product(study.scenarios, OUTPUTS):
        mine = result.runs.filter(scenario=scenario)[output].cast(pl.Float64)
        outputs = mine.to_numpy().reshape(shape).T
        mean = outputs.mean(axis=0)
        finite = bool(np.isfinite(outputs).all())
        found = None
        # The points of the design proper: all others mix two of them.
        base = np.concatenate([mean[:: len(mean) // n], mean[len(mean) // n - 1 :: len(mean) // n]])
        if finite and np.ptp(base) > 1e-12 * np.abs(base).max():
            found = analysis.analyze(
                SALIB, mean, calc_second_order=False, num_resamples=500, conf_level=0.95, seed=1
            )
        low, middle, high = np.quantile(mean, (0.05, 0.5, 0.95))
        for index, symbol in enumerate(WEIGHTS.values()):
            row: dict[str, object] = {"scenario": scenario, "metric": output, "weight": symbol}
            row |= {"low": low, "median": middle, "high": high}
            row["luck"] = luck(outputs) if finite else None
            for name in ("S1", "ST"):
                value = half = np.nan
                if found is not None:
                    value, half = float(found[name][index]), float(found[f"{name}_conf"][index])
                row |= Interval(value, value - half, value + half).columns(name)
            rows.append(row)
    return pl.DataFrame(rows, infer_schema_length=None).fill_nan(None)


def luck(outputs: np.ndarray) -> float:
    """Share of an output's variance over points that other seeds would not repeat; at most 1.

    `outputs` has a row a seed and a column a point. What the two make only together, in a two-way
    table without replication, is divided by the number of seeds and by the variance of the mean
    over seeds. NaN for one seed, 0 where nothing varies.
    """
    seeds, points = outputs.shape
    if seeds < 2:
        return float("nan")
    mean = outputs.mean(axis=0)
    if np.ptp(mean) <= 1e-12 * np.abs(mean).max():
        return 0.0
    residual = outputs - mean - outputs.mean(axis=1, keepdims=True) + outputs.mean()
    together = float((residual**2).sum()) / ((seeds - 1) * (points - 1))
    return float(min(together / seeds / mean.var(ddof=1), 1.0))
