"""Predictions of the paper for its cell (its table of scenarios), and whether runs agree.

The predictions are qualitative: words. To hold them against runs, each is read as a condition on
numbers, which is stated beside it, and the answer is one of three: it agrees, it differs, or the
runs leave it open. A condition holds, or fails, only where the whole 95 % interval over seeds says
so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np

from dwell.model.number_arrays import Floats
from dwell.study.intervals import Interval, mean_interval, median_interval, share_interval, under
from dwell.study.kept_bounds import ABOVE_ZERO, AIM, keeps
from dwell.study.over_seeds import difference_of, windows_behind
from dwell.study.results import StudyRuns

if TYPE_CHECKING:
    import polars as pl

Answer: TypeAlias = Literal["agrees", "differs", "open"]
Test: TypeAlias = Callable[[StudyRuns, str], bool | None]

CANDIDATES = {"LOC", "SO", "HYB"}
DTP = "dtp"


class PaperClaim(NamedTuple):
    """A few words of the paper on a static placement, and the condition they are read as.

    Parameters
    ----------
    words : str
        The paper's.
    reading : str
        The condition, in words.
    holds : callable
        The condition on runs in a scenario: True, False, or None where the runs do not tell.
    """

    words: str
    reading: str
    holds: Test


class Prediction(NamedTuple):
    """One row of the paper's table.

    Parameters
    ----------
    scenario : str
        Its name in a cell file.
    claims : mapping of str to tuple of PaperClaim
        By the static placement that they are about.
    dtp : str
        The paper's words on the placement that dominates under DTP.
    dominant : tuple of str
        The placements meant by that.
    share : float
        Share of the windows that these words ask for.
    """

    scenario: str
    claims: Mapping[str, tuple[PaperClaim, ...]]
    dtp: str
    dominant: tuple[str, ...]
    share: float

    @property
    def reading(self) -> str:
        """Reading of the paper's words on DTP."""
        names = " or ".join(self.dominant)
        return f"at least {self.share * 100:.0f} % of the windows under {names}"


def _under_aim(words: str, policy: str) -> PaperClaim:
    return PaperClaim(words, "V_D under 5 %", partial(_stands, policy, "under"))


def _over_aim(policy: str) -> PaperClaim:
    return PaperClaim("High V_D", "V_D above 5 %", partial(_stands, policy, "over"))


def _stands(policy: str, word: str, comparison: StudyRuns, scenario: str) -> bool | None:
    """Whether V_D stands under or over the aim; None where that is not shown."""
    rates = _values(comparison, scenario, policy, "violation_rate")
    if rates is None:
        return None
    shown = under(rates, AIM, windows=comparison.windows_behind(scenario, policy))
    return None if shown == "not shown" else shown == word


def _more(
    words: str, reading: str, policy: str, column: str, other: str, *, than_in: str | None = None
) -> PaperClaim:
    """A policy shows more in a column than another policy, which may be in another scenario."""

    def holds(comparison: StudyRuns, scenario: str) -> bool | None:
        elsewhere = than_in or scenario
        first = _values(comparison, scenario, policy, column)
        second = _values(comparison, elsewhere, other, column)
        if first is None or second is None or not np.isfinite([*first, *second]).all():
            return None
        groups = (
            comparison.runs.filter(scenario=scenario, policy=policy),
            comparison.runs.filter(scenario=elsewhere, policy=other),
        )
        difference = difference_of(column, windows_behind(*groups))(first, second)
        return keeps(difference, at_least=ABOVE_ZERO)

    return PaperClaim(words, reading, holds)


def _saturated(words: str, reading: str, policy: str, column: str) -> PaperClaim:
    """A tier is at its utilisation cap, or above."""

    def holds(comparison: StudyRuns, scenario: str) -> bool | None:
        values = _values(comparison, scenario, policy, column)
        cap = min(comparison.problem.objective.caps.utilisation, 1.0)
        # Just under the cap, so that a node at exactly 1 all the time counts.
        return None if values is None else keeps(mean_interval(values), at_least=cap - 1e-9)

    return PaperClaim(words, reading, holds)


def _typically_in_time(words: str, policy: str) -> PaperClaim:
    """The median latency is within the deadline."""

    def holds(comparison: StudyRuns, scenario: str) -> bool | None:
        values = _values(comparison, scenario, policy, "p50_ms")
        if values is None:
            return None
        return keeps(median_interval(values), at_most=comparison.problem.pipeline.deadline_ms)

    return PaperClaim(words, "the median latency is within D", holds)


def _values(comparison: StudyRuns, scenario: str, policy: str, column: str) -> Floats | None:
    """One number a seed; None where there are no such runs."""
    if policy not in comparison.policies or scenario not in comparison.scenarios:
        return None
    return comparison.values(scenario, policy, column)


_SPREAD = "distance from the median to the 95th percentile below SO's"

#: The paper's table, row by row.
PAPER: tuple[Prediction, ...] = (
    Prediction(
        "baseline",
        {
            "LOC": (
                _under_aim("Low V_D", "LOC"),
                _more("high U_r", "U_r above SO's", "LOC", "u_robot", "SO"),
            ),
            "SO": (
                _more("Low U_r", "U_r below LOC's", "LOC", "u_robot", "SO"),
                _more("moderate V_D", "V_D above LOC's", "SO", "violation_rate", "LOC"),
            ),
        },
        "Mostly LOC; occasional HYB",
        ("LOC",),
        0.5,
    ),
    Prediction(
        "robot-cpu-stress",
        {
            "LOC": (_over_aim("LOC"), _saturated("U_r sat.", "U_r at its cap", "LOC", "u_robot")),
            "SO": (
                _more("Mitigated", "V_D below LOC's", "LOC", "violation_rate", "SO"),
                _more(
                    *("higher L95", "L95 above that of LOC without stress"),
                    *("SO", "l95_ms", "LOC"),
                    than_in="baseline",
                ),
            ),
        },
        "Converges to SO",
        ("SO",),
        0.9,
    ),
    Prediction(
        "edge-cpu-stress",
        {
            "LOC": (
                _under_aim("Stable", "LOC"),
                _more("U_r elevated", "U_r above SO's", "LOC", "u_robot", "SO"),
            ),
            "SO": (_over_aim("SO"), _saturated("U_e sat.", "U_e at its cap", "SO", "u_edge")),
        },
        "LOC or HYB",
        ("LOC", "HYB"),
        0.9,
    ),
    Prediction(
        "network-impairment",
        {
            "LOC": (_more("Low variance", _SPREAD, "SO", "spread_ms", "LOC"),),
            "SO": (_over_aim("SO"), _typically_in_time("via jitter", "SO")),
        },
        "Converges to LOC",
        ("LOC",),
        0.9,
    ),
)


class Judgement(NamedTuple):
    """Behaviour of DTP in a scenario, beside the paper's prediction.

    Parameters
    ----------
    answer : {"agrees", "differs", "open"}
        Whether the whole interval of the share lies at or above what the words ask for, or below;
        open where it allows for either.
    leader : str
        Placement with the largest mean share of the windows.
    share : Interval
        Share of the predicted placements together.
    """

    answer: Answer
    leader: str
    share: Interval


def applies(comparison: StudyRuns) -> bool:
    """Whether the paper's predictions are about this cell at all: its candidates, its words."""
    names = {prediction.scenario for prediction in PAPER}
    return comparison.problem.candidates.keys() == CANDIDATES and bool(
        names & set(comparison.scenarios)
    )


def judge_placement(comparison: StudyRuns, prediction: Prediction, policy: str = DTP) -> Judgement:
    """Hold the predicted dominant placement against the shares of windows.

    Parameters
    ----------
    comparison : StudyRuns
        With the prediction's scenario and `policy`, of a cell to which the paper applies.
    policy : str
        The one that is called DTP.
    """
    shares = {
        name: comparison.values(prediction.scenario, policy, f"share_{name}")
        for name in comparison.problem.candidates
    }
    together = np.sum([shares[name] for name in prediction.dominant], axis=0)
    together = np.minimum(together, 1.0)
    windows = comparison.windows_behind(prediction.scenario, policy)
    share = share_interval(together, windows=windows)
    answer = _answer(keeps(share, at_least=prediction.share))
    leader = max(shares, key=lambda name: shares[name].mean())
    return Judgement(answer, leader, share)


def judge_claim(comparison: StudyRuns, scenario: str, claim: PaperClaim) -> Answer:
    """Hold the words on a static placement against its runs."""
    return _answer(claim.holds(comparison, scenario))


def _answer(holds: bool | None) -> Answer:
    return "open" if holds is None else "agrees" if holds else "differs"


def paper_predictions(comparison: StudyRuns, policies: Sequence[str] = (DTP,)) -> pl.DataFrame:
    """Hold every prediction of the paper's table against runs of its cell.

    Parameters
    ----------
    comparison : StudyRuns
        Runs at a single point of the candidates LOC, SO and HYB, in some of the paper's
        scenarios.
    policies : sequence of str
        Policies that the predictions about DTP are held against.

    Returns
    -------
    DataFrame
        One row a prediction: ``scenario``; ``policy``, or the placement that it is about; the
        paper's ``words`` and their ``reading``; ``answer`` (agrees, differs, open); of a policy
        also ``leader``, the placement with most windows, and the ``share`` of the predicted one in
        them with ``share_low`` and ``share_high``. No rows for another cell.
    """
    import polars as pl

    rows: list[tuple[object, ...]] = []
    mine = [one for one in PAPER if one.scenario in comparison.scenarios]
    for one in mine if applies(comparison) else ():
        for policy in policies:
            found = judge_placement(comparison, one, policy)
            words = (one.scenario, policy, one.dtp, one.reading)
            rows.append((*words, found.answer, found.leader, *found.share))
        for placement, claims in one.claims.items():
            for claim in claims:
                answer = judge_claim(comparison, one.scenario, claim)
                rows.append(
                    (one.scenario, placement, claim.words, claim.reading, answer, *[None] * 4)
                )
    texts = ("scenario", "policy", "words", "reading", "answer", "leader")
    numbers = ("share", "share_low", "share_high")
    schema = {**dict.fromkeys(texts, pl.String), **dict.fromkeys(numbers, pl.Float64)}
    return pl.DataFrame(rows, schema=schema, orient="row").fill_nan(None)
