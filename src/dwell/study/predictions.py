"""What the paper predicts for its cell, and whether runs agree (its table of scenarios).

The predictions are qualitative: words. To hold them against runs, each is read as a condition on
numbers, which is stated beside it, and the answer is one of four: it agrees, it agrees in part, it
differs, or the runs do not tell. A condition holds, or fails, only where the 95 % interval over
seeds says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.study.comparison import AIM
from dwell.study.intervals import (
    Interval,
    mean_interval,
    median_interval,
    share_difference_interval,
    share_interval,
    under,
)
from dwell.study.over_seeds import difference_of
from dwell.study.results import StudyRuns

if TYPE_CHECKING:
    import polars as pl

Answer: TypeAlias = Literal["agrees", "agrees in part", "differs", "open"]
Test: TypeAlias = Callable[["PaperEvidence"], bool | None]

CANDIDATES = {"LOC", "SO", "HYB"}
DTP = "dtp"


@dataclass(frozen=True, slots=True)
class PaperEvidence:
    """A comparison, seen from one scenario; tests answer None where the runs do not tell."""

    comparison: StudyRuns
    scenario: str

    def under_aim(self, policy: str) -> bool | None:
        """Whether the violation rate is under the aim."""
        values = self._values(policy, "violation_rate")
        known = {"under": True, "over": False}
        return None if values is None else known.get(under(values, AIM))

    def more(
        self, policy: str, column: str, other: str, *, scenario: str | None = None
    ) -> bool | None:
        """Whether a policy shows more of something than another, here or in another scenario."""
        mine, theirs = self._values(policy, column), self._values(other, column, scenario)
        if mine is None or theirs is None or not np.isfinite([*mine, *theirs]).all():
            return None
        return _sign(difference_of(column)(mine, theirs))

    def saturated(self, policy: str, column: str) -> bool | None:
        """Whether a tier is at its utilisation cap, or above."""
        values = self._values(policy, column)
        cap = min(self.comparison.problem.objective.caps.utilisation, 1.0)
        # Just under the cap, so that a node at exactly 1 all the time counts.
        return None if values is None else _sign(mean_interval(values - (cap - 1e-9)))

    def typically_in_time(self, policy: str) -> bool | None:
        """Whether the median latency is within the deadline."""
        values = self._values(policy, "p50_ms")
        if values is None:
            return None
        median, deadline_ms = median_interval(values), self.comparison.problem.pipeline.deadline_ms
        if not median.known:
            return None
        return True if median.high <= deadline_ms else False if median.low > deadline_ms else None

    def _values(
        self, policy: str, column: str, scenario: str | None = None
    ) -> NDArray[np.float64] | None:
        """One number a seed; None where there are no such runs."""
        scenario = scenario or self.scenario
        if policy not in self.comparison.policies or scenario not in self.comparison.scenarios:
            return None
        return self.comparison.values(scenario, policy, column)


@dataclass(frozen=True, slots=True)
class PaperClaim:
    """A few words of the paper on a static placement, and the condition they are read as.

    Parameters
    ----------
    words : str
        The paper's.
    reading : str
        The condition, in words.
    holds : callable
        The condition: True, False, or None where the runs do not tell.
    """

    words: str
    reading: str
    holds: Test


@dataclass(frozen=True, slots=True)
class Prediction:
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
        """What the words on DTP are read as."""
        names = " or ".join(self.dominant)
        return f"{names} leads, with at least {self.share * 100:.0f} % of the windows"


def _low(policy: str) -> PaperClaim:
    return PaperClaim("Low V_D", "V_D under 5 %", lambda e: e.under_aim(policy))


def _high(policy: str) -> PaperClaim:
    return PaperClaim("High V_D", "V_D above 5 %", lambda e: _not(e.under_aim(policy)))


#: The paper's table, row by row.
PAPER: tuple[Prediction, ...] = (
    Prediction(
        "baseline",
        {
            "LOC": (
                _low("LOC"),
                PaperClaim("high U_r", "U_r above SO's", lambda e: e.more("LOC", "u_robot", "SO")),
            ),
            "SO": (
                PaperClaim("Low U_r", "U_r below LOC's", lambda e: e.more("LOC", "u_robot", "SO")),
                PaperClaim(
                    "moderate V_D",
                    "V_D above LOC's",
                    lambda e: e.more("SO", "violation_rate", "LOC"),
                ),
            ),
        },
        "Mostly LOC; occasional HYB",
        ("LOC",),
        0.5,
    ),
    Prediction(
        "robot-cpu-stress",
        {
            "LOC": (
                _high("LOC"),
                PaperClaim("U_r sat.", "U_r at its cap", lambda e: e.saturated("LOC", "u_robot")),
            ),
            "SO": (
                PaperClaim(
                    "Mitigated",
                    "V_D below LOC's",
                    lambda e: e.more("LOC", "violation_rate", "SO"),
                ),
                PaperClaim(
                    "higher L95",
                    "L95 above that of LOC without stress",
                    lambda e: e.more("SO", "l95_ms", "LOC", scenario="baseline"),
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
                PaperClaim("Stable", "V_D under 5 %", lambda e: e.under_aim("LOC")),
                PaperClaim(
                    "U_r elevated", "U_r above SO's", lambda e: e.more("LOC", "u_robot", "SO")
                ),
            ),
            "SO": (
                _high("SO"),
                PaperClaim("U_e sat.", "U_e at its cap", lambda e: e.saturated("SO", "u_edge")),
            ),
        },
        "LOC or HYB",
        ("LOC", "HYB"),
        0.9,
    ),
    Prediction(
        "network-impairment",
        {
            "LOC": (
                PaperClaim(
                    "Low variance",
                    "distance from the median to the 95th percentile below SO's",
                    lambda e: e.more("SO", "spread_ms", "LOC"),
                ),
            ),
            "SO": (
                _high("SO"),
                PaperClaim(
                    "via jitter",
                    "the median latency is within D",
                    lambda e: e.typically_in_time("SO"),
                ),
            ),
        },
        "Converges to LOC",
        ("LOC",),
        0.9,
    ),
)


@dataclass(frozen=True, slots=True)
class Judgement:
    """What DTP did in a scenario, beside what the paper predicts.

    Parameters
    ----------
    answer : {"agrees", "agrees in part", "differs", "open"}
        In part: the predicted placement leads, and neither every seed nor the interval has the
        share that its words ask for. Open: the interval over seeds allows for either.
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
    others = [name for name in shares if name not in prediction.dominant]
    rival = max(others, key=lambda name: shares[name].mean())
    share = share_interval(together)
    answer = _answer(_sign(share_difference_interval(together, shares[rival])))
    # Few seeds that all have the whole share leave an interval below it, which says nothing.
    enough = share.low >= prediction.share or together.min() >= prediction.share
    if answer == "agrees" and not enough:
        answer = "agrees in part"
    leader = max(shares, key=lambda name: shares[name].mean())
    return Judgement(answer, leader, share)


def judge_claim(comparison: StudyRuns, scenario: str, claim: PaperClaim) -> Answer:
    """Hold the words on a static placement against its runs."""
    return _answer(claim.holds(PaperEvidence(comparison, scenario)))


def _answer(holds: bool | None) -> Answer:
    return "open" if holds is None else "agrees" if holds else "differs"


def paper_predictions(comparison: StudyRuns, policies: Sequence[str] = (DTP,)) -> pl.DataFrame:
    """Hold every prediction of the paper's table against runs of its cell.

    Parameters
    ----------
    comparison : StudyRuns
        Of a single point; compares the candidates LOC, SO and HYB, in some of the paper's
        scenarios.
    policies : sequence of str
        Those that the predictions about DTP are held against.

    Returns
    -------
    DataFrame
        One row a prediction: ``scenario``; ``policy``, or the placement that it is about; the
        paper's ``words`` and their ``reading``; ``answer`` (agrees, agrees in part, differs,
        open); of a policy also ``leader``, the placement with most windows, and the ``share`` of
        the predicted one in them with ``share_low`` and ``share_high``. No rows for another cell.
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


def _sign(difference: Interval) -> bool | None:
    """Whether a difference is above 0; None where its interval does not tell."""
    if not difference.known:
        return None
    if difference.low > 0:
        return True
    return False if difference.high < 0 else None


def _not(answer: bool | None) -> bool | None:
    return None if answer is None else not answer
