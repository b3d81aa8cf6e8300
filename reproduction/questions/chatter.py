"""RQ3: Hamming penalty against threshold hysteresis: which of them keeps DTP calmer.

Experiments match the mean threshold: α_S > 0 beside α_S = 0 with Δ_min raised by α_S times the mean
distance of two candidates. What the penalty can do at most follows from the rule: see README.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

import polars as pl

from dwell.model import Placement, Problem
from dwell.study import Contender, Study, StudyResult
from reproduction.cell import RANDOM, of_cell, with_candidates
from reproduction.maps import map_of
from reproduction.questions import Run
from reproduction.scale import Scale
from reproduction.verdicts import Answer, by_policy, claims

TITLE = "RQ3: Does the Hamming-distance penalty suppress chatter more finely than a threshold?"

SCENARIOS, ESTIMATORS, DWELLS = ("baseline", *RANDOM), ("profile", "corrected"), (0, 3)
#: α_S of the penalty; the cell's is among them.
STRENGTHS, FEW_STRENGTHS = (0.2, 0.4, 0.8), (0.2, 0.8)
#: What runs are judged by. J without switching and the tasks moved follow from two prices of a
#: move, this one and the contender's own, which must differ.
JUDGED_BY = 1.0
RULES = PENALTY, THRESHOLD = "penalty", "threshold"
#: Differences of V_D that are taken for none, written down before any fresh seed was played.
MARGIN = 0.005
METRICS = ("migrations", "returns", "moved", "violation_rate", "j_still")
PRICE = "objective.weights.switching"


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Compare the penalty to a threshold of the same mean; with two candidates, too."""
    strengths = FEW_STRENGTHS if scale.coarse else STRENGTHS
    three = study_of("chatter", judging(cell), strengths, scale.fresh_seeds, scale)
    # The two that are farthest apart, at one strength.
    far = max(combinations(cell.candidates, 2), key=lambda pair: distance(cell, *pair))
    two = study_of(
        "chatter-two", judging(with_candidates(cell, far)), (0.2,), scale.some_seeds, scale
    )
    runs, check = (with_moves(run(study)) for study in (three, two))
    calmer = {"The penalty is calmer than a threshold of the same mean": pairs_of(strengths)}
    same = {"With two candidates, the penalty differs from the threshold": pairs_of((0.2,))}
    verdicts = claims(runs, METRICS, SCENARIOS, calmer, three, margin=MARGIN)
    cells = pl.concat(verdicts).filter(metric=METRICS[0])
    verdicts += claims(check, METRICS, SCENARIOS, same, two, margin=MARGIN)
    return Answer(
        pl.concat(verdicts),
        {
            "Chatter and its price under both rules": by_policy(runs, METRICS),
            "Two candidates: runs that are the same under both rules, number by number": (
                identical(check)
            ),
        },
        map_of(cells, _label, 1.0),
    )


def _label(row: dict[str, str]) -> tuple[str, str, str]:
    estimator, dwell, rule = row["first"].split(", ")
    panel = f"Migrations: {estimator}, {dwell}"
    return panel, f"α_S = {rule.removeprefix(PENALTY)}", row["scenario"]


def judging(cell: Problem) -> Problem:
    """Return the cell with the price of a move that runs are judged by."""
    weights = replace(cell.objective.weights, switching=JUDGED_BY)
    return replace(cell, objective=replace(cell.objective, weights=weights))


def distance(cell: Problem, first: str, second: str) -> float:
    """Share of tasks that change node between two candidates."""
    one, other = (Placement(cell.candidates[name]) for name in (first, second))
    return len(one.moved(other)) / len(one)


def study_of(
    name: str, cell: Problem, strengths: Sequence[float], seeds: tuple[int, ...], scale: Scale
) -> Study:
    """Return both rules at every strength, dwell and estimator, and DTP with neither."""
    least = cell.controller.min_improvement
    pairs = list(combinations(cell.candidates, 2))
    mean = sum(distance(cell, *pair) for pair in pairs) / len(pairs)
    who = []
    for estimator, dwell in product(ESTIMATORS, DWELLS):
        ruled = [("neither", 0.0, 0.0, least)]
        for strength in strengths:
            ruled.append((PENALTY, strength, strength, least))
            ruled.append((THRESHOLD, strength, 0.0, least + strength * mean))
        for rule, strength, switching, improvement in ruled:
            settings = {
                "controller.min_dwell": dwell,
                "controller.min_improvement": improvement,
                PRICE: switching,
            }
            called = named(estimator, dwell, rule, strength)
            who.append(Contender(called, "dtp", estimator, settings))
    return of_cell(name, cell, SCENARIOS, who, seeds, scale.windows)


def named(estimator: str, dwell: int, rule: str, strength: float) -> str:
    """Name of a contender."""
    return f"{estimator}, N_min = {dwell}, {rule} {strength:g}"


def pairs_of(strengths: Sequence[float]) -> list[tuple[str, str]]:
    """Return the penalty beside the threshold, at every estimator, dwell and strength."""
    return [
        (named(estimator, dwell, PENALTY, strength), named(estimator, dwell, THRESHOLD, strength))
        for estimator, dwell, strength in product(ESTIMATORS, DWELLS, strengths)
    ]


def with_moves(result: StudyResult) -> pl.DataFrame:
    """Return the runs with the tasks that they moved, and their J without switching.

    J by the price of a move p is J without it, plus p times the mean share of tasks moved; it is
    known for two prices: the contender's own (the table of costs) and that which runs are judged
    by.
    """
    keys = ["scenario", "policy", "seed"]
    own = (
        result.costs.group_by(keys)
        .agg((pl.col("measured").fill_null(0.0) * pl.col("windows")).sum(), pl.col("windows").sum())
        .select(*keys, own=pl.col("measured") / pl.col("windows"))
    )
    prices = {one.name: float(str(one.settings[PRICE])) for one in result.study.contenders}
    tasks = len(result.study.points[0].problem.pipeline.tasks)
    runs = result.runs.join(own, on=keys, how="left", maintain_order="left")
    price = pl.col("policy").replace_strict(prices, return_dtype=pl.Float64)
    moved = (pl.col("cost") - pl.col("own")) / (JUDGED_BY - price)
    return runs.with_columns(
        # Whole, but for rounding.
        moved=(moved * pl.col("windows") * tasks).round(6),
        j_still=pl.col("cost") - JUDGED_BY * moved,
    ).drop("own")


def identical(runs: pl.DataFrame) -> pl.DataFrame:
    """Count pairs of runs with two candidates that are the same in every number, by N_min."""
    rows = []
    plain = runs.drop("cost", "j_still").sort("scenario", "policy", "seed")
    for dwell in DWELLS:
        policies = [[named(one, dwell, rule, 0.2) for one in ESTIMATORS] for rule in RULES]
        first, second = (
            plain.filter(pl.col("policy").is_in(names)).drop("policy").rows() for names in policies
        )
        same = sum(one == other for one, other in zip(first, second, strict=True))
        rows.append({"min_dwell": dwell, "same": same, "of": len(first)})
    return pl.DataFrame(rows)
