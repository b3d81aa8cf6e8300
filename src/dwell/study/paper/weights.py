"""The five weights of J: how much DTP's results depend on them, in every scenario (RQ4).

Two designs. A Sobol design varies all five together, each over a factor of `FACTOR` to either side
of the cell's value, evenly in the logarithm: weights are exchange rates, of which factors and not
differences mean something. The other design changes one weight at a time, to nothing, a half and
the double.

The rule is the same where all five weights *and* the threshold Δ_min are multiplied by one number.
Δ_min is kept, so that five weights are four exchange rates and a scale against Δ_min.

What is analysed contains no weight that is varied: V_D, L95, migrations, the tracking error, and J
by the cell's own weights, which says what it costs to weigh otherwise.

A changed weight may turn one decision, after which everything differs: a part of the variance over
weights is that of the few realisations that were played. `luck` estimates that part.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model import FrozenDict, Problem
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.intervals import Interval
from dwell.study.paper.cell import RANDOM, STEADY, TIMETABLE, by_length
from dwell.study.paper.contenders import believing
from dwell.study.paper.contrasts import Contrast
from dwell.study.paper.differences import difference_table, families
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import listed, number, percent, with_interval
from dwell.study.sensitivity import ROUNDING, Parameter, sobol_design, sobol_indices
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Reaction", "chapter", "luck", "verdict"]

Floats: TypeAlias = NDArray[np.float64]

#: The weights of an objective, and what the paper calls them.
WEIGHTS = {
    "latency": "α_L",
    "violations": "α_V",
    "robot": "α_r",
    "edge": "α_e",
    "switching": "α_S",
}
#: The cell's weights are multiplied, and divided, by at most this.
FACTOR = 4.0
#: Of the scrambling of the design.
SEED = 1

OUTPUTS: Mapping[str, str] = {
    "violation_rate": "V_D",
    "l95_ms": "L95",
    "migrations": "migrations",
    "tracking_rms_mm": "tracking RMS",
    "cost": "J by the cell's weights",
}
#: Change of V_D over the weights that is worth speaking of: a fifth of the aim.
MATERIAL = 0.01
#: Share of the variance that other realisations would not repeat, above which nothing is said.
MOSTLY_LUCK = 0.5
#: A weight whose total index is surely below this has no effect worth naming.
NEGLIGIBLE = 0.05

#: One at a time: factors by the words that stand for them.
STEPS = {"× 0": 0.0, "× ½": 0.5, "× 2": 2.0}
ONE_AT_A_TIME = ("baseline", "bursts", "step")
AS_IT_IS = "as in the cell"


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Vary the weights, all together and one at a time."""
    ranges = parameters(problem)
    design = sobol_design(ranges, scale.sobol_n, seed=SEED)
    together = studies(
        "weights",
        problem,
        weighing(design),
        (*STEADY, *TIMETABLE, *RANDOM),
        seeds=scale.sobol_seeds,
        lengths=(scale.sobol_windows, scale.dynamic_windows),
    )
    alone = studies(
        "weights-one",
        problem,
        stepping(problem),
        ONE_AT_A_TIME,
        seeds=scale.seeds,
        lengths=(scale.windows, scale.dynamic_windows),
    )
    return written(
        problem,
        scale,
        [runner.run(study) for study in together],
        [runner.run(study) for study in alone],
    )


def studies(
    name: str,
    problem: Problem,
    contenders: Sequence[Contender],
    scenarios: Sequence[str],
    *,
    seeds: int,
    lengths: tuple[int, int],
) -> list[Study]:
    """Return one study for each of the two lengths: a scenario with a timetable has its own."""
    return [
        Study(
            name=name + suffix,
            points=(Point({}, problem),),
            scenarios=mine,
            contenders=tuple(contenders),
            seeds=tuple(range(1, seeds + 1)),
            windows=windows,
        )
        for suffix, mine, windows in by_length(problem, scenarios, *lengths)
    ]


def parameters(problem: Problem) -> tuple[Parameter, ...]:
    """Return the range of every weight."""
    weights = problem.objective.weights
    return tuple(
        Parameter(
            symbol, getattr(weights, name) / FACTOR, getattr(weights, name) * FACTOR, log=True
        )
        for name, symbol in WEIGHTS.items()
    )


def weighing(design: Floats) -> list[Contender]:
    """Return a DTP for every row of a design."""
    return [
        believing(
            "dtp",
            "corrected",
            {
                f"objective.weights.{name}": float(value)
                for name, value in zip(WEIGHTS, row, strict=True)
            },
            name=f"{index:04d}",
        )
        for index, row in enumerate(design)
    ]


def stepping(problem: Problem) -> list[Contender]:
    """Return a DTP with the cell's weights, and one for every step of one of them."""
    weights = problem.objective.weights
    changed = [
        believing(
            "dtp",
            "corrected",
            {f"objective.weights.{name}": getattr(weights, name) * factor},
            name=f"{symbol} {step}",
        )
        for name, symbol in WEIGHTS.items()
        for step, factor in STEPS.items()
    ]
    return [believing("dtp", "corrected", name=AS_IT_IS), *changed]


# ------------------------------------------------------------------------------- reading


@dataclass(frozen=True, slots=True)
class Reaction:
    """How V_D reacts to the weights in a scenario.

    Parameters
    ----------
    scenario : str
    low, high : float
        V_D (mean over seeds) that 5 % and 95 % of the points of the design stay under.
    luck : float
        Share of the variance that other realisations would not repeat; NaN for one seed.
    totals : mapping of str to Interval
        Total index of each weight; empty where V_D is the same at every point.
    """

    scenario: str
    low: float
    high: float
    luck: float
    totals: Mapping[str, Interval]

    @property
    def material(self) -> bool:
        """Whether V_D changes by something worth speaking of."""
        return self.high - self.low > MATERIAL

    @property
    def leading(self) -> str | None:
        """The weight with the largest total index, of those that are shown to have an effect."""
        shown = [name for name, total in self.totals.items() if total.low > 0]
        return max(shown, key=lambda name: self.totals[name].value, default=None)

    def __str__(self) -> str:
        """``step (10.5 % to 12.2 %, most by α_r, total index 0.49 [0.17, 0.81])``."""
        by = "no single weight is shown to do it"
        if self.leading is not None:
            index = with_interval(self.totals[self.leading], decimals=2)
            by = f"most by {self.leading}, total index {index}"
        return f"{self.scenario} ({percent(self.low)} to {percent(self.high)}, {by})"


def outputs_of(result: StudyResult, scenario: str) -> dict[str, Floats]:
    """Return every output of a scenario, one row a seed and one column a contender."""
    import polars as pl

    study = result.study
    mine = result.runs.filter(pl.col("scenario") == scenario)
    shape = (len(study.contenders), len(study.seeds))
    return {
        name: mine[name].cast(pl.Float64).to_numpy().reshape(shape).T
        for name in OUTPUTS
        if name in mine.columns
    }


def luck(outputs: Floats) -> float:
    """Share of an output's variance over points that other seeds would not repeat.

    Parameters
    ----------
    outputs : float64 array, shape (seeds, points)

    Returns
    -------
    float
        What seeds and points make only together, in a two-way table without replication, divided
        by the number of seeds and by the variance of the mean over seeds; at most 1. NaN for one
        seed, 0 where nothing varies.
    """
    seeds, points = outputs.shape
    if seeds < 2:
        return float("nan")
    mean = outputs.mean(axis=0)
    if np.ptp(mean) <= ROUNDING * np.abs(mean).max():
        return 0.0
    variance = float(mean.var(ddof=1))
    residual = outputs - mean - outputs.mean(axis=1, keepdims=True) + outputs.mean()
    together = float((residual**2).sum()) / ((seeds - 1) * (points - 1))
    return float(min(together / seeds / variance, 1.0))


def indices(
    problem: Problem, scale: Scale, results: Iterable[StudyResult]
) -> tuple[pl.DataFrame, list[Reaction]]:
    """Return the indices of all outputs and scenarios, and how V_D reacts in each."""
    import polars as pl

    ranges = parameters(problem)
    frames, reactions = [], []
    for result in results:
        for scenario in result.study.scenarios:
            outputs = outputs_of(result, scenario)
            finite = {name: one for name, one in outputs.items() if np.isfinite(one).all()}
            found = sobol_indices(ranges, finite, scale.sobol_n)
            frames.append(found.select(pl.lit(scenario).alias("scenario"), pl.all()))
            rate = outputs["violation_rate"]
            low, high = np.quantile(rate.mean(axis=0), (0.05, 0.95))
            mine = found.filter((pl.col("output") == "violation_rate") & pl.col("ST").is_not_null())
            totals = {
                row["parameter"]: Interval(row["ST"], row["ST_low"], row["ST_high"])
                for row in mine.to_dicts()
            }
            reactions.append(
                Reaction(scenario, float(low), float(high), luck(rate), FrozenDict(totals))
            )
    return pl.concat(frames), reactions


# ------------------------------------------------------------------------------- verdict


def verdict(reactions: Sequence[Reaction]) -> Outcome:
    """Answer whether it matters how the weights are chosen, and which of them does it."""
    material = [one for one in reactions if one.material]
    unsure = [one for one in material if one.luck > MOSTLY_LUCK]
    sure = [one for one in material if one not in unsure]
    answer: Answer
    if len(sure) == len(reactions):
        answer = "yes"
    elif sure:
        answer = "in part"
    else:
        answer = "not shown" if unsure else "no"
    named = listed(one.scenario for one in sure)
    sentence = (
        f"Over weights between a quarter and four times the cell's, V_D of DTP changes by more "
        f"than {number(100 * MATERIAL, 0)} point in {len(sure)} of {len(reactions)} scenarios"
        + (f" ({named})." if sure else ".")
    )
    if unsure:
        sentence += (
            f" In {len(unsure)} more it changes as much, but more than half of that is the luck of "
            "the few realisations."
        )
    evidence = [
        f"V_D over the middle 90 % of the points{', mostly luck' if mostly else ''}: "
        f"{'; '.join(map(str, some))}."
        for mostly, some in ((False, sure), (True, unsure))
        if some
    ]
    idle = [
        symbol
        for symbol in WEIGHTS.values()
        if sure and all(one.totals[symbol].high < NEGLIGIBLE for one in sure)
    ]
    if idle:
        evidence.append(f"{listed(idle)} {'has' if len(idle) == 1 else 'have'} no part in it.")
    return Outcome(answer, sentence, tuple(evidence))


# ------------------------------------------------------------------------------- chapter


def written(
    problem: Problem,
    scale: Scale,
    together: Sequence[StudyResult],
    alone: Sequence[StudyResult],
) -> Chapter:
    """Write the chapter of finished runs."""
    found, reactions = indices(problem, scale, together)
    outcome = verdict(reactions)
    ranges = spread_table(together)
    steps = compared(alone)
    return Chapter(
        slug="weights",
        title="RQ4: Does it matter how the five weights are chosen?",
        design=design(problem, scale, together, alone),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(*unchanging(found), *judged(ranges), *steps_found(steps)),
        tables=(indices_table(found), ranges, *steps_tables(steps)),
        figures=(
            indices_figure(found, "violation_rate"),
            indices_figure(found, "migrations"),
            steps_figure(steps["violation_rate"]),
        ),
    )


def design(
    problem: Problem,
    scale: Scale,
    together: Sequence[StudyResult],
    alone: Sequence[StudyResult],
) -> str:
    """Say what was varied."""
    points = len(together[0].study.contenders)
    runs = sum(result.study.runs for result in together)
    ranges = listed(
        f"{one.name} {number(one.low, 3)} to {number(one.high, 3)}" for one in parameters(problem)
    )
    tried = listed(scenario for result in alone for scenario in result.study.scenarios)
    return (
        f"DTP with the estimator corrected; {ranges}, evenly in the logarithm: a factor of "
        f"{number(FACTOR, 0)} to either side of the cell's weights, beyond which one term of J "
        "would hardly count or be the only one. The order that the paper asks for (α_V > α_L > "
        f"α_S) holds at {percent(ordered(together[0].study.contenders), 0)} of the points. Δ_min "
        "and N_min stay, so that the common scale of the weights counts, too. Saltelli's design "
        f"with n = {scale.sobol_n} base points, {points} points, {scale.sobol_seeds} seeds in "
        f"common ({runs} runs in all; {scale.sobol_windows} windows, "
        f"{scale.dynamic_windows} where a scenario has a timetable); first-order (S1) and total "
        "(ST) indices of the mean over seeds, with 95 % intervals over base points. Outputs "
        "contain no weight that is varied. One at a time: each weight × 0, × ½ and × 2 in "
        f"{tried}, {scale.seeds} seeds of {scale.windows} windows (a timetable: all of it), paired "
        "with the cell's weights (sign-flip test, "
        "tracking: sign test; Holm over all comparisons of a metric)."
    )


def ordered(contenders: Sequence[Contender]) -> float:
    """Share of the points at which α_V > α_L > α_S."""
    found = [
        tuple(
            float(str(one.settings[f"objective.weights.{name}"]))
            for name in ("violations", "latency", "switching")
        )
        for one in contenders
    ]
    return sum(first > second > third for first, second, third in found) / len(found)


def unchanging(found: pl.DataFrame) -> tuple[str, ...]:
    """Name the scenarios in which an output does not depend on any weight at all."""
    import polars as pl

    same = found.filter(pl.col("insensitive")).unique(("scenario", "output"), maintain_order=True)
    return tuple(
        f"In {scenario} {listed(OUTPUTS[name] for name in mine['output'])} "
        f"{'is' if mine.height == 1 else 'are'} the same whatever the weights."
        for (scenario,), mine in same.group_by(["scenario"], maintain_order=True)
    )


def judged(ranges: Table) -> tuple[str, ...]:
    """Say what it costs, by the cell's weights, to weigh otherwise."""
    import polars as pl

    mine = ranges.frame.filter(pl.col("output") == OUTPUTS["cost"]).fill_null(float("nan"))
    worst = max(mine.to_dicts(), key=lambda row: row["high"] / row["low"] if row["low"] else 1.0)
    return (
        f"By the cell's own weights, other weights cost most in {worst['scenario']}: J goes from "
        f"{number(worst['low'], 2)} (5 % of the points) to {number(worst['high'], 2)} (95 %); of "
        f"that variance {percent(worst['luck'], 0)} is luck.",
    )


def steps_found(steps: Mapping[str, Family]) -> tuple[str, ...]:
    """Say which steps of one weight were shown to change a metric."""
    found = []
    for one in steps.values():
        shown = {name: said for name, said in one.verdicts.items() if said in ("lower", "higher")}
        named = "; ".join(f"{name} ({said})" for name, said in shown.items())
        found.append(
            f"One at a time, a change of {OUTPUTS[one.metric]} is shown in {len(shown)} of "
            f"{len(one.comparisons)} comparisons" + (f": {named}." if shown else ".")
        )
    return tuple(found)


def indices_table(found: pl.DataFrame) -> Table:
    """Sobol indices, one row a scenario, output and weight."""
    import polars as pl

    return Table(
        slug="weights-sobol",
        title="Sobol indices of the weights",
        frame=found.with_columns(pl.col("output").replace(dict(OUTPUTS))),
        units={
            "scenario": "text",
            "output": "text",
            "parameter": "text",
            "S1": "number",
            "ST": "number",
            "insensitive": "text",
        },
        headings={"parameter": "weight", "insensitive": "same at every point"},
        note=(
            "Estimate and 95 % interval over base points of the design; small indices may seem to "
            "be negative. ST − S1 is what a weight does together with others."
        ),
    )


def spread_table(results: Iterable[StudyResult]) -> Table:
    """How far each output goes over the design, and how much of that is luck."""
    import polars as pl

    rows = []
    for result in results:
        for scenario in result.study.scenarios:
            for name, outputs in outputs_of(result, scenario).items():
                share = name == "violation_rate"
                mean = outputs.mean(axis=0) * (100 if share else 1)
                low, middle, high = np.quantile(mean, (0.05, 0.5, 0.95))
                finite = np.isfinite(outputs).all()
                rows.append(
                    {
                        "scenario": scenario,
                        "output": f"{OUTPUTS[name]} (%)" if share else OUTPUTS[name],
                        "low": float(low),
                        "median": float(middle),
                        "high": float(high),
                        "luck": luck(outputs) if finite else None,
                    }
                )
    return Table(
        slug="weights-ranges",
        title="What the outputs come to over the weights",
        frame=pl.DataFrame(rows, infer_schema_length=None).fill_nan(None),
        units={
            "scenario": "text",
            "output": "text",
            "low": "number",
            "median": "number",
            "high": "number",
            "luck": "percent",
        },
        headings={"low": "5 % of the points", "high": "95 % of the points"},
        note=(
            "Means over seeds at the points of the design. Luck: the part of the "
            "variance over points that other realisations would not repeat."
        ),
    )


def compared(results: Sequence[StudyResult]) -> dict[str, Family]:
    """Compare every step of one weight to the cell's weights."""
    import polars as pl

    runs = pl.concat([result.runs for result in results])
    pairs: dict[str, Contrast] = {
        f"{scenario}: {one.name}": (
            {"scenario": scenario, "policy": one.name},
            {"scenario": scenario, "policy": AS_IT_IS},
        )
        for result in results
        for scenario in result.study.scenarios
        for one in result.study.contenders
        if one.name != AS_IT_IS
    }
    metrics = [name for name in OUTPUTS if name in runs.columns]
    return families(runs, "one weight changed, against the cell's weights", metrics, pairs)


def steps_tables(steps: Mapping[str, Family]) -> tuple[Table, ...]:
    """One row a scenario and step: the differences from the cell's weights, in two tables."""
    names = list(steps)
    return tuple(
        difference_table(
            {name: steps[name] for name in mine},
            slug=f"weights-one{suffix}",
            title=f"One weight changed, less the cell's weights: {what}",
            note=note,
        )
        for mine, suffix, what, note in (
            (names[:3], "", "misses, latency, moves", ""),
            (
                *(names[3:], "-more", "tracking and J"),
                "J by the cell's weights; tracking: median and sign test.",
            ),
        )
        if mine
    )


def indices_figure(found: pl.DataFrame, output: str) -> Figure:
    """Bars of S1 and ST, one panel a scenario."""
    import polars as pl

    mine = found.filter((pl.col("output") == output) & pl.col("ST").is_not_null())
    frame = pl.concat(
        mine.select(
            "scenario",
            "parameter",
            pl.lit(name).alias("index"),
            pl.col(name).alias("y"),
            pl.col(f"{name}_low").alias("y_low"),
            pl.col(f"{name}_high").alias("y_high"),
        )
        for name in ("S1", "ST")
    )
    absent = [
        name
        for name in found["scenario"].unique(maintain_order=True)
        if name not in frame["scenario"]
    ]
    left_out = f" Not in it, as nothing varies there: {listed(absent)}." if absent else ""
    return Figure(
        slug=f"weights-sobol-{output.replace('_', '-')}",
        title=f"Share of each weight in the variance of {OUTPUTS[output]}",
        kind="bars",
        frame=frame,
        x="parameter",
        y="y",
        series="index",
        facet="scenario",
        y_label="share of the variance",
        y_unit="percent",
        note=f"First-order and total Sobol indices with 95 % intervals.{left_out}",
    )


def steps_figure(one: Family) -> Figure:
    """Change of a metric at every step of one weight."""
    import polars as pl

    frame = one.table().select(
        pl.col("comparison").str.splitn(": ", 2).struct.field("field_0").alias("scenario"),
        pl.col("comparison")
        .str.splitn(": ", 2)
        .struct.field("field_1")
        .str.splitn(" ", 2)
        .struct.rename_fields(["weight", "step"])
        .struct.unnest(),
        pl.col("difference").alias("y"),
        pl.col("low").alias("y_low"),
        pl.col("high").alias("y_high"),
    )
    return Figure(
        slug="weights-one",
        title=f"One weight changed: {OUTPUTS[one.metric]} against that with the cell's weights",
        kind="intervals",
        frame=frame,
        x="weight",
        y="y",
        series="step",
        facet="scenario",
        y_label=f"change of {OUTPUTS[one.metric]}",
        y_unit="change",
        line_at=0.0,
        line_label="no change",
        note="Mean of the differences, paired by seed, with its 95 % interval.",
    )
