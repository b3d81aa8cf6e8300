"""Families of comparisons, with p values adjusted for their number.

Twenty comparisons at 5 % give one false difference on average. All comparisons that answer one
question on one metric are therefore a family, and its p values are adjusted together: with a
probability of 95 % none of its verdicts is due to chance. Each metric and each question has its own
family and its own 5 %; a report states the number of families.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from dwell.errors import SimulationError
from dwell.model.bounds import counted
from dwell.model.number_arrays import Floats
from dwell.study.intervals import CONFIDENCE
from dwell.study.metric import metric_of
from dwell.study.over_seeds import metric_values, windows_behind
from dwell.study.pairs import (
    PairedDifference,
    PairedMedian,
    SameRun,
    least_p,
    paired_difference,
    paired_median,
)
from dwell.study.summary import LATENCIES, PLAYED

if TYPE_CHECKING:
    import polars as pl

#: First words of a verdict with too few seeds, and its mark in the rows of a page.
CANNOT_TELL, UNTOLD = "cannot tell", "–"
#: Verdicts on identical runs, and on runs with identical latencies only.
SAME_RUN, SAME_CYCLES = "same run", "same cycles"
#: Columns of digests that are equal for each of these verdicts.
EQUAL = {SAME_RUN: PLAYED, SAME_CYCLES: LATENCIES}

#: Values by column that select one run per seed.
Labels: TypeAlias = Mapping[str, object]
#: Two groups of runs, each with one run per seed.
Contrast: TypeAlias = "tuple[Labels, Labels]"

#: ``lower``, ``higher``, ``no difference shown``, `SAME_RUN`, `SAME_CYCLES`, or `cannot_tell`.
Comparative: TypeAlias = str
Difference: TypeAlias = PairedDifference | PairedMedian | SameRun


@dataclass(frozen=True, slots=True)
class Family:
    """All comparisons that answer one question on one metric.

    Parameters
    ----------
    question : str
        The question in words, for instance ``is DTP cheaper than each static placement?``
    metric : str
        Name of the compared column.
    comparisons : mapping of str to PairedDifference, PairedMedian or SameRun
        By a name, for instance ``baseline: dtp, LOC``. A verdict is about the first of a pair.
        A `SameRun` is not tested and does not count as a comparison.
    """

    question: str
    metric: str
    comparisons: Mapping[str, Difference]

    @classmethod
    def of_runs(
        cls, runs: pl.DataFrame, question: str, metric: str, pairs: Mapping[str, Contrast]
    ) -> Family:
        """Compare a metric between pairs of groups of runs, seed by seed.

        Metrics that may be infinite are compared by medians, other metrics by means. A pair whose
        cycles are identical for every seed becomes a `SameRun`.

        Parameters
        ----------
        runs : DataFrame
            One row per run, with a column ``seed``; see `dwell.study.StudyResult`.
        pairs : mapping of str to (labels, labels)
            By a name: the values by column that select each group, one run per seed.

        Raises
        ------
        SimulationError
            If labels select no run, or several runs per seed.
        MetricError
            If the column is unknown; the message suggests the nearest name.
        """
        return cls(
            question, metric, {name: _contrast(runs, metric, pair) for name, pair in pairs.items()}
        )

    @property
    def tested(self) -> dict[str, PairedDifference | PairedMedian]:
        """The comparisons with a p value: all except each `SameRun`."""
        known = self.comparisons.items()
        return {name: item for name, item in known if not isinstance(item, SameRun)}

    @property
    def adjusted(self) -> dict[str, float]:
        """The p value of each tested comparison, adjusted by Holm's procedure."""
        tested = self.tested
        return dict(zip(tested, holm([item.p for item in tested.values()]), strict=True))

    @property
    def verdicts(self) -> dict[str, Comparative]:
        """Whether the first is lower or higher, with 95 % confidence for all verdicts together.

        "No difference shown" does not prove that the two are equal: the interval shows which
        differences are possible. If the seeds are too few, the text of `cannot_tell` replaces it.
        """
        words: dict[int, Comparative] = {-1: "lower", 1: "higher", 0: "no difference shown"}
        adjusted, tested = self.adjusted, self.tested
        told = {
            name: cannot_tell(item.n, len(tested))
            or words[item.direction if adjusted[name] <= 1 - CONFIDENCE else 0]
            for name, item in tested.items()
        }
        return {
            name: item.word if isinstance(item, SameRun) else told[name]
            for name, item in self.comparisons.items()
        }

    def verdict(self, name: str) -> Comparative:
        """Return the verdict of one comparison."""
        if name not in self.comparisons:
            known = ", ".join(self.comparisons) or "none"
            raise SimulationError(
                f"no comparison {name!r} in the family “{self.question}”; it has {known}"
            )
        return self.verdicts[name]

    def table(self) -> pl.DataFrame:
        """Return a table with one row per comparison, in order.

        Returns
        -------
        DataFrame
            ``question``, ``metric``, ``comparison``; ``centre`` (mean or median), ``difference``,
            ``low``, ``high``; ``d_z`` (null for medians), ``superiority``; ``n`` (pairs), ``p``,
            ``p_holm``, ``p_least`` (the smallest possible ``p_holm`` for the numbers of pairs and
            comparisons) and ``verdict``. NaN becomes null. A `SameRun` has null in the interval,
            ``d_z`` and the p values.
        """
        import polars as pl

        columns = {
            **dict.fromkeys(("question", "metric", "comparison", "centre"), pl.String),
            **dict.fromkeys(("difference", "low", "high", "d_z", "superiority"), pl.Float64),
            "n": pl.Int64,
            **dict.fromkeys(("p", "p_holm", "p_least"), pl.Float64),
            "verdict": pl.String,
        }
        adjusted, verdicts, count = self.adjusted, self.verdicts, len(self.tested)
        rows = []
        for name, item in self.comparisons.items():
            centre = "median" if metric_of(self.metric).values == "median" else "mean"
            known = {"difference": 0.0, "superiority": 0.5, "n": item.n}
            if not isinstance(item, SameRun):
                centre = "mean" if isinstance(item, PairedDifference) else "median"
                known = asdict(item)
                known["difference"] = known.pop(centre)
                known["p_holm"] = adjusted[name]
                known["p_least"] = _least_adjusted(item.n, count)
            labels = {"question": self.question, "metric": self.metric, "comparison": name}
            rows.append({**labels, "centre": centre, **known, "verdict": verdicts[name]})
        return pl.DataFrame(rows, schema=columns).fill_nan(None)


def seed_values(runs: pl.DataFrame, column: str, labels: Labels) -> Floats:
    """Return one number per seed, in the order of the seeds.

    Parameters
    ----------
    runs : DataFrame
        One row per run.
    labels : mapping of str to object
        Values by column that select one run per seed.

    Raises
    ------
    SimulationError
        If the labels select no run, or several runs per seed.
    MetricError
        If the column is unknown; the message suggests the nearest name.
    """
    group = _group(runs, labels)
    if group.is_empty() or group["seed"].n_unique() != group.height:
        raise SimulationError(
            f"{dict(labels)} leaves {group.height} runs of {group['seed'].n_unique()} seeds; it "
            "must leave one a seed"
        )
    return metric_values(group, column)


def _group(runs: pl.DataFrame, labels: Labels) -> pl.DataFrame:
    """Return the runs with some labels, in the order of their seeds."""
    import polars as pl

    return runs.filter(*(pl.col(name) == value for name, value in labels.items())).sort("seed")


def played_alike(runs: pl.DataFrame, pair: Contrast) -> str:
    """Return whether two groups of runs are identical, by the digests of their cycles.

    Parameters
    ----------
    runs : DataFrame
        One row per run. Without columns of digests the groups count as different.

    Returns
    -------
    str
        `SAME_RUN`, `SAME_CYCLES`, or an empty text if the groups differ.
    """
    for word, column in EQUAL.items():
        if column in runs.columns:
            first, second = (_group(runs, labels).select("seed", column) for labels in pair)
            if first.equals(second, null_equal=False):
                return word
    return ""


def _contrast(runs: pl.DataFrame, metric: str, pair: Contrast) -> Difference:
    """Compare the first of a pair with the second, by medians if the column may be infinite."""
    first, second = (seed_values(runs, metric, labels) for labels in pair)
    word = played_alike(runs, pair)
    if word and np.array_equal(first, second):
        return SameRun(len(first), word)
    values = metric_of(metric).values
    if values == "median":
        return paired_median(first, second)
    windows = windows_behind(*(_group(runs, labels) for labels in pair))
    return paired_difference(first, second, shares=values == "share", windows=windows)


def cannot_tell(seeds: int, comparisons: int = 1) -> str:
    """Return ``cannot tell with 3 seeds`` if these are too few for any verdict, else an empty text.

    Parameters
    ----------
    seeds : int
        Pairs of every comparison.
    comparisons : int
        Size of the family: the smallest of m p values is multiplied by m.
    """
    if _least_adjusted(seeds, comparisons) <= 1 - CONFIDENCE:
        return ""
    return f"{CANNOT_TELL} with {counted(seeds, 'seed')}"


def untold(words: Iterable[str]) -> dict[str, int]:
    """Count each verdict that begins with `CANNOT_TELL`.

    A page prints each of these verdicts once, and `UNTOLD` in its rows.
    """
    return dict(Counter(word for word in words if word.startswith(CANNOT_TELL)))


def _least_adjusted(pairs: int, comparisons: int) -> float:
    """Return the smallest possible adjusted p value in a family of comparisons."""
    return min(1.0, comparisons * least_p(pairs))


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values by Holm's step-down procedure.

    The i-th smallest of m values (i from 0) is multiplied by m - i, and raised to the value before
    it if that is larger. The probability that any rejection at level α is wrong is at most α, for
    any dependence between the tests (Holm 1979, DOI 10.2307/4615733).

    Parameters
    ----------
    p_values : sequence of float
        In [0, 1].

    Returns
    -------
    list of float
        In the order of `p_values`, at most 1.

    Raises
    ------
    SimulationError
        If a value is not in [0, 1].
    """
    values = np.asarray(p_values, np.float64)
    wrong = values[~((values >= 0) & (values <= 1))]
    if wrong.size:
        raise SimulationError(f"a p value is {wrong[0]}; it must be in [0, 1]")
    order = np.argsort(values, kind="stable")
    stepped = values[order] * np.arange(len(values), 0, -1)
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return [float(value) for value in adjusted]
