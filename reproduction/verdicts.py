"""A verdict is a row: claim, design, effect with its interval, and the word that the rule gives.

The rules are those of docs/background/statistics.md. Differences are paired by seed; a word
compares the first of a pair to the second, under Holm's procedure over all comparisons of a claim
and metric, and `p_least` is the smallest p value that so many seeds and comparisons allow.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import polars as pl

from dwell.study import AIM, Family, Interval, Study, over_seeds, under

#: Groups of runs that are compared, by (scenario, first, second): what is in their columns.
Pairs: TypeAlias = Mapping[tuple[str, str, str], tuple[Mapping[str, object], Mapping[str, object]]]

TEXTS = ("claim", "design", "scenario", "first", "second", "metric", "word")
NUMBERS = ("effect", "low", "high", "p", "p_least")
COLUMNS = (*TEXTS[:-1], *NUMBERS, "word")
SCHEMA = {name: pl.String if name in TEXTS else pl.Float64 for name in COLUMNS}


class Answer(NamedTuple):
    """What came of a question: a row a verdict, and what else the runs show, by a title."""

    verdicts: pl.DataFrame
    tables: Mapping[str, pl.DataFrame]


def design_of(*studies: Study) -> str:
    """``20 seeds of 150 windows``, of each study."""
    return ", ".join(
        dict.fromkeys(f"{len(one.seeds)} seeds of {one.windows} windows" for one in studies)
    )


def policies(scenarios: Iterable[str], pairs: Iterable[tuple[str, str]]) -> Pairs:
    """Return the pairs of policies in every scenario."""
    wanted = tuple(pairs)
    return {
        (scenario, first, second): between(scenario, first, second)
        for scenario in scenarios
        for first, second in wanted
    }


def values(runs: pl.DataFrame, column: str, **labels: object) -> np.ndarray:
    """Return a column of the runs with these labels: one number a seed, in the order of seeds."""
    mine = runs.filter(*(pl.col(name) == label for name, label in labels.items())).sort("seed")
    return mine[column].cast(pl.Float64).to_numpy()


def by_policy(runs: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """Return columns of the runs over seeds, one row a scenario and policy."""
    return over_seeds(runs, ("scenario", "policy"), columns)


def between(
    scenario: str, first: str, second: str, **more: object
) -> tuple[dict[str, object], dict[str, object]]:
    """Return the labels of two policies in a scenario; `more` holds in both groups."""
    common: dict[str, object] = {"scenario": scenario, **more}
    return {**common, "policy": first}, {**common, "policy": second}


def compare(
    runs: pl.DataFrame, claim: str, metrics: Iterable[str], pairs: Pairs, *studies: Study
) -> pl.DataFrame:
    """Compare pairs in every metric; each metric is a family of its own.

    Returns
    -------
    DataFrame
        One row a pair and metric: ``claim``, ``design``, ``scenario``, ``first``, ``second``,
        ``metric``; ``effect`` (the first less the second: mean, or median where a metric may be
        infinite) with ``low`` and ``high``, ``p`` (Holm's), ``p_least`` and ``word``.
    """
    found = [pl.DataFrame(schema=SCHEMA)]
    named = {" | ".join(names): pair for names, pair in pairs.items()}
    for metric in metrics:
        rows = Family.of_runs(runs, claim, metric, named).table()
        columns = {
            name: pl.Series([names[index] for names in pairs], dtype=pl.String)
            for index, name in enumerate(("scenario", "first", "second"))
        }
        found.append(
            rows.select(
                "metric",
                pl.col("difference").alias("effect"),
                *("low", "high", pl.col("p_holm").alias("p"), "p_least"),
                pl.col("verdict").alias("word"),
                claim=pl.lit(claim),
                design=pl.lit(design_of(*studies)),
            )
            .with_columns(**columns)
            .select(COLUMNS)
        )
    return pl.concat(found)


def claims(
    runs: pl.DataFrame,
    metrics: Iterable[str],
    scenarios: Iterable[str],
    pairs: Mapping[str, Iterable[tuple[str, str]]],
    *studies: Study,
) -> list[pl.DataFrame]:
    """Compare pairs of policies in every scenario, by claim."""
    return [
        compare(runs, claim, metrics, policies(scenarios, mine), *studies)
        for claim, mine in pairs.items()
    ]


def judge(
    claim: str, scenario: str, policy: str, metric: str, known: Interval, word: str, *studies: Study
) -> pl.DataFrame:
    """Return the row of a verdict that is no comparison: a bound, and what its interval says."""
    row = (claim, design_of(*studies), scenario, policy, "", metric, *known, None, None, word)
    return pl.DataFrame([row], schema=SCHEMA, orient="row").fill_nan(None)


def under_aim(rows: pl.DataFrame, runs: pl.DataFrame, *studies: Study) -> pl.DataFrame:
    """Judge of every policy whether V_D is under 5 %: of `rows` over seeds, made of `runs`."""
    found = [pl.DataFrame(schema=SCHEMA)]
    for row in rows.iter_rows(named=True):
        mine = runs.filter(scenario=row["scenario"], policy=row["policy"])["violation_rate"]
        limits = (row["violation_rate_at_least"], row["violation_rate_at_most"])
        known = Interval(row["violation_rate"], *limits)
        word = under(mine.to_list(), AIM)
        names = ("V_D under 5 %", row["scenario"], row["policy"], "violation_rate")
        found.append(judge(*names, known, word, *studies))
    return pl.concat(found)


def counted(verdicts: pl.DataFrame) -> pl.DataFrame:
    """Count the words of every claim, pair and metric: one row each, a column a word."""
    keys = ("claim", "first", "second", "metric")
    words = list(dict.fromkeys(verdicts["word"]))
    return verdicts.group_by(keys, maintain_order=True).agg(
        pl.len().alias("of"), *((pl.col("word") == word).sum().alias(word) for word in words)
    )
