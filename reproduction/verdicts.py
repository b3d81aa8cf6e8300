"""A verdict is a row: claim, design, effect with its interval, and the word that the rule gives.

The rules are those of docs/background/statistics.md. Differences are paired by seed; a word
compares the first of a pair to the second, under Holm's procedure over all comparisons of a claim
and metric, and `p_least` is the smallest p value that so many seeds and comparisons allow.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import polars as pl

from dwell.model import AIM
from dwell.study import (
    UNTOLD,
    Family,
    Interval,
    Study,
    over_seeds,
    under,
    untold,
    windows_behind,
)

#: Word of a difference that is not shown and whose interval lies within a margin named beforehand:
#: two one-sided tests at 2.5 %.
WITHIN = "within the margin"
NUMBERS = ("effect", "low", "high", "p", "p_least")
COLUMNS = ("claim", "design", "scenario", "first", "second", "metric", *NUMBERS, "word")
SCHEMA = {name: pl.Float64 if name in NUMBERS else pl.String for name in COLUMNS}


class Answer(NamedTuple):
    """What came of a question: a row a verdict, and what else the runs show, by a title.

    A research question also has the map that answers it (`reproduction.maps`).
    """

    verdicts: pl.DataFrame
    tables: Mapping[str, pl.DataFrame]
    cells: pl.DataFrame | None = None


def design_of(*studies: Study) -> str:
    """``20 seeds of 150 windows``, of each study."""
    return ", ".join(
        dict.fromkeys(f"{len(one.seeds)} seeds of {one.windows} windows" for one in studies)
    )


def values(runs: pl.DataFrame, column: str, **labels: object) -> np.ndarray:
    """Return a column of the runs with these labels: one number a seed, in the order of seeds."""
    mine = runs.filter(*(pl.col(name) == label for name, label in labels.items())).sort("seed")
    return mine[column].cast(pl.Float64).to_numpy()


def by_policy(runs: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """Return columns of the runs over seeds, one row a scenario and policy."""
    return over_seeds(runs, ("scenario", "policy"), columns)


def claims(
    runs: pl.DataFrame,
    metrics: Iterable[str],
    scenarios: Iterable[str],
    pairs: Mapping[str, Iterable[tuple[str, str]]],
    *studies: Study,
    margin: float = 0.0,
) -> list[pl.DataFrame]:
    """Compare pairs of policies in every scenario, by claim; each metric is a family of its own.

    Parameters
    ----------
    margin : float
        Differences of V_D within it have the word `WITHIN`, if it was written down before any of
        the seeds was played; 0 claims none.

    Returns
    -------
    list of DataFrame
        One row a pair and metric: ``claim``, ``design``, ``scenario``, ``first``, ``second``,
        ``metric``; ``effect`` (the first less the second: mean, or median where a metric may be
        infinite) with ``low`` and ``high``, ``p`` (Holm's), ``p_least`` and ``word``.
    """
    schema = dict.fromkeys(("scenario", "first", "second"), pl.String)
    renamed = {"difference": "effect", "p_holm": "p", "verdict": "word"}
    frames = [pl.DataFrame(schema=SCHEMA)]
    for claim, metric in product(pairs, metrics):
        rows = [(scenario, *pair) for scenario, pair in product(scenarios, pairs[claim])]
        contrasts = {
            " | ".join((scenario, first, second)): (
                {"scenario": scenario, "policy": first},
                {"scenario": scenario, "policy": second},
            )
            for scenario, first, second in rows
        }
        family = Family.of_runs(runs, claim, metric, contrasts).table().drop("p").rename(renamed)
        labels = pl.DataFrame(rows, schema=schema, orient="row")
        labels = labels.with_columns(claim=pl.lit(claim), design=pl.lit(design_of(*studies)))
        frame = labels.hstack(family).select(COLUMNS)
        if margin and metric.endswith("violation_rate"):
            inside = (pl.col("low") >= -margin) & (pl.col("high") <= margin)
            is_equal = inside & (pl.col("word") == "no difference shown")
            word = pl.when(is_equal).then(pl.lit(WITHIN)).otherwise("word")
            frame = frame.with_columns(word=word)
        frames.append(frame)
    return frames


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
        mine = runs.filter(scenario=row["scenario"], policy=row["policy"])
        limits = (row["violation_rate_at_least"], row["violation_rate_at_most"])
        known = Interval(row["violation_rate"], *limits)
        word = under(mine["violation_rate"].to_list(), AIM, windows=windows_behind(mine))
        names = ("V_D under 5 %", row["scenario"], row["policy"], "violation_rate")
        found.append(judge(*names, known, word, *studies))
    return pl.concat(found)


def brief(verdicts: pl.DataFrame) -> pl.DataFrame:
    """Put `UNTOLD` for the words that say that nothing can be told: the page has them once."""
    once = dict.fromkeys(untold(verdicts["word"]), UNTOLD)
    return verdicts.with_columns(pl.col("word").replace(once))


def counted(verdicts: pl.DataFrame) -> pl.DataFrame:
    """Count the words of every claim, pair and metric: one row each, a column a word.

    What cannot be told is one word, `UNTOLD`.
    """
    keys = ("claim", "first", "second", "metric")
    verdicts = brief(verdicts)
    words = list(dict.fromkeys(verdicts["word"]))
    return verdicts.group_by(keys, maintain_order=True).agg(
        pl.len().alias("of"), *((pl.col("word") == word).sum().alias(word) for word in words)
    )
