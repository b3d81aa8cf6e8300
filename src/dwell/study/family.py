"""Families of comparisons: what may be said of many at once.

Twenty comparisons at 5 % find one difference on average where there is none. All comparisons that
answer one question on one metric are therefore a family, and its p values are adjusted together:
with a probability of 95 % not one of its verdicts is luck. Neither metrics nor questions share a
family: the 5 % hold for each, and a report says how many there are.
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
from dwell.study.over_seeds import has_median, is_share, metric_values, windows_behind
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

#: Begin of a verdict that is none, and what stands for it in the rows of a page.
CANNOT_TELL, UNTOLD = "cannot tell", "–"
#: Verdicts of a pair that is the same run, and of one with the same latencies only.
SAME_RUN, SAME_CYCLES = "same run", "same cycles"
#: The columns of runs that are equal then.
EQUAL = {SAME_RUN: PLAYED, SAME_CYCLES: LATENCIES}

#: Columns of runs and what they have to be, for one run a seed to be left.
Labels: TypeAlias = Mapping[str, object]
#: Two groups of runs, one run a seed each.
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
        Column that is compared.
    comparisons : mapping of str to PairedDifference, PairedMedian or SameRun
        By a name, for instance ``baseline: dtp, LOC``. The first of a pair is what a verdict is
        about. What is the same run is not tested, and does not count among the comparisons.
    """

    question: str
    metric: str
    comparisons: Mapping[str, Difference]

    @classmethod
    def of_runs(
        cls, runs: pl.DataFrame, question: str, metric: str, pairs: Mapping[str, Contrast]
    ) -> Family:
        """Compare a metric between pairs of groups of runs, seed by seed.

        Metrics that may be infinite are compared by medians, the others by means; pairs that
        played every cycle alike under every seed are the same run.

        Parameters
        ----------
        runs : DataFrame
            One row a run, with a column ``seed``; see `dwell.study.StudyResult`.
        pairs : mapping of str to (labels, labels)
            By a name; what columns are in the runs of each group. Both leave one run a seed.

        Raises
        ------
        SimulationError
            If labels leave no run, or several a seed.
        MetricError
            If there is no such column; with the nearest name.
        """
        return cls(
            question, metric, {name: _contrast(runs, metric, pair) for name, pair in pairs.items()}
        )

    @property
    def tested(self) -> dict[str, PairedDifference | PairedMedian]:
        """The comparisons that have a p value: all but the same run."""
        known = self.comparisons.items()
        return {name: item for name, item in known if not isinstance(item, SameRun)}

    @property
    def adjusted(self) -> dict[str, float]:
        """Holm's p value of each comparison that is tested."""
        tested = self.tested
        return dict(zip(tested, holm([item.p for item in tested.values()]), strict=True))

    @property
    def verdicts(self) -> dict[str, Comparative]:
        """Where the first is lower or higher, with 95 % confidence in all of them together.

        "No difference shown" is no proof that there is none: intervals say what is left open. Where
        nothing can be shown, whatever the numbers are, `cannot_tell` says so.
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
        """Return one row a comparison, in their order.

        Returns
        -------
        DataFrame
            ``question``, ``metric``, ``comparison``; ``centre`` (mean or median), ``difference``,
            ``low``, ``high``; ``d_z`` (null for medians), ``superiority``; ``n`` (pairs), ``p``,
            ``p_holm``, ``p_least`` (the smallest that ``p_holm`` can be with so many pairs and
            comparisons) and ``verdict``. What is NaN is null; of the same run, all but the
            difference and the superiority.
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
            centre = "median" if has_median(self.metric) else "mean"
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
    """Return one number a seed, in the order of the seeds.

    Parameters
    ----------
    runs : DataFrame
        One row a run.
    labels : mapping of str to object
        Leave one run a seed.

    Raises
    ------
    SimulationError
        If they leave none, or several a seed.
    MetricError
        If there is no such column; with the nearest name.
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
    """Return how two groups of runs, one run a seed each, played every cycle alike.

    Parameters
    ----------
    runs : DataFrame
        One row per run. A table that was made of runs, and has no digests of their cycles, says
        nothing.

    Returns
    -------
    str
        `SAME_RUN`, `SAME_CYCLES`, or nothing if they differ.
    """
    for word, column in EQUAL.items():
        if column in runs.columns:
            first, second = (_group(runs, labels).select("seed", column) for labels in pair)
            if first.equals(second, null_equal=False):
                return word
    return ""


def _contrast(runs: pl.DataFrame, metric: str, pair: Contrast) -> Difference:
    """Compare the first of a pair to the second; by medians where a column may be infinite."""
    first, second = (seed_values(runs, metric, labels) for labels in pair)
    word = played_alike(runs, pair)
    if word and np.array_equal(first, second):
        return SameRun(len(first), word)
    if has_median(metric):
        return paired_median(first, second)
    windows = windows_behind(*(_group(runs, labels) for labels in pair))
    return paired_difference(first, second, shares=is_share(metric), windows=windows)


def cannot_tell(seeds: int, comparisons: int = 1) -> str:
    """Return ``cannot tell with 3 seeds`` where so many can show nothing; an empty text elsewhere.

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
    """Return how often each word stands there that says that nothing can be told.

    A page says each of them once, and `UNTOLD` in its rows.
    """
    return dict(Counter(word for word in words if word.startswith(CANNOT_TELL)))


def _least_adjusted(pairs: int, comparisons: int) -> float:
    """Return the smallest p value of any of so many comparisons, adjusted."""
    return min(1.0, comparisons * least_p(pairs))


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values by Holm's step-down procedure.

    The i-th smallest of m, from 0, is multiplied by m - i, and none becomes smaller than the one
    before it. The probability that any of those at or below α is wrong is at most α, however they
    depend on each other (Holm 1979, DOI 10.2307/4615733).

    Parameters
    ----------
    p_values : sequence of float
        In [0, 1].

    Returns
    -------
    list of float
        In the order given, at most 1.

    Raises
    ------
    SimulationError
        If one is not in [0, 1].
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
