"""Predictions of the paper for its cell (its table of scenarios), and whether runs agree.

The predictions are qualitative. Each is read as a condition on numbers, shown with it. The answer
for the runs is "agrees", "differs" or "open". A condition holds or fails only if the complete 95 %
interval over seeds does; otherwise it is open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np

from dwell.model.number_arrays import Floats
from dwell.model.objective import AIM
from dwell.study.intervals import Interval, mean_interval, median_interval, share_interval, under
from dwell.study.kept_bounds import ABOVE_ZERO, keeps
from dwell.study.over_seeds import difference_of, windows_behind
from dwell.study.results import StudyRuns

if TYPE_CHECKING:
    import polars as pl

Answer: TypeAlias = Literal["agrees", "differs", "open"]
Test: TypeAlias = Callable[[StudyRuns, str], bool | None]

CANDIDATES = {"LOC", "SO", "HYB"}
DTP = "dtp"


class PaperClaim(NamedTuple):
    """A statement of the paper about a static placement, and its reading as a condition.

    Parameters
    ----------
    words : str
        The paper's words.
    reading : str
        The condition, in words.
    holds : callable
        The condition on runs in a scenario: True, False, or None if open.
    """

    words: str
    reading: str
    holds: Test


class Prediction(NamedTuple):
    """One row of the paper's table.

    Parameters
    ----------
    scenario : str
        Name of the scenario in a cell file.
    claims : mapping of str to tuple of PaperClaim
        Statements by static placement.
    dtp : str
        The paper's words on the placement that dominates under DTP.
    dominant : tuple of str
        The predicted dominant placements.
    share : float
        Least share of the windows that counts as dominant.
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
    """Whether the verdict on V_D and the aim is `word`; None if it is "not shown"."""
    rates = _values(comparison, scenario, policy, "violation_rate")
    if rates is None:
        return None
    shown = under(rates, AIM, windows=comparison.windows_behind(scenario, policy))
    return None if shown == "not shown" else shown == word


def _more(
    words: str, reading: str, policy: str, column: str, other: str, *, than_in: str | None = None
) -> PaperClaim:
    """Claim that a policy has more in a column than another, possibly in another scenario."""

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
    """Claim that a tier is at its utilisation cap, or above."""

    def holds(comparison: StudyRuns, scenario: str) -> bool | None:
        values = _values(comparison, scenario, policy, column)
        cap = min(comparison.problem.objective.caps.utilisation, 1.0)
        # The tolerance includes a node that is always at exactly 1.
        return None if values is None else keeps(mean_interval(values), at_least=cap - 1e-9)

    return PaperClaim(words, reading, holds)


def _typically_in_time(words: str, policy: str) -> PaperClaim:
    """Claim that the median latency is within the deadline."""

    def holds(comparison: StudyRuns, scenario: str) -> bool | None:
        values = _values(comparison, scenario, policy, "p50_ms")
        if values is None:
            return None
        return keeps(median_interval(values), at_most=comparison.problem.pipeline.deadline_ms)

    return PaperClaim(words, "the median latency is within D", holds)


def _values(comparison: StudyRuns, scenario: str, policy: str, column: str) -> Floats | None:
    """Return one number per seed; None if the runs lack the policy or the scenario."""
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
    """Behaviour of DTP in a scenario, compared with the paper's prediction.

    Parameters
    ----------
    answer : {"agrees", "differs", "open"}
        Agrees if the complete interval of `share` is at or above the prediction's share, differs if
        it is below, else open.
    leader : str
        Placement with the largest mean share of the windows.
    share : Interval
        Sum of the shares of the predicted placements.
    """

    answer: Answer
    leader: str
    share: Interval


def applies(comparison: StudyRuns) -> bool:
    """Whether the cell has the paper's candidates, and the study one of its scenarios."""
    names = {prediction.scenario for prediction in PAPER}
    return comparison.problem.candidates.keys() == CANDIDATES and bool(
        names & set(comparison.scenarios)
    )


def judge_placement(comparison: StudyRuns, prediction: Prediction, policy: str = DTP) -> Judgement:
    """Compare the predicted dominant placements with a policy's shares of windows.

    Parameters
    ----------
    comparison : StudyRuns
        Runs of the paper's cell, with the prediction's scenario and `policy`.
    policy : str
        Name of the policy that counts as DTP.
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
    """Compare a statement about a static placement with its runs."""
    return _answer(claim.holds(comparison, scenario))


def _answer(holds: bool | None) -> Answer:
    return "open" if holds is None else "agrees" if holds else "differs"


def paper_predictions(comparison: StudyRuns, policies: Sequence[str] = (DTP,)) -> pl.DataFrame:
    """Compare every prediction of the paper's table with runs of its cell.

    Parameters
    ----------
    comparison : StudyRuns
        Runs without parameters, with the candidates LOC, SO and HYB and some of the paper's
        scenarios.
    policies : sequence of str
        Policies to compare with the predictions about DTP.

    Returns
    -------
    DataFrame
        One row per prediction: ``scenario``; ``policy``, the policy or static placement; the
        paper's ``words`` and their ``reading``; ``answer`` (agrees, differs, open). A row about DTP
        also has ``leader``, the placement with the largest share of windows, and the ``share`` of
        the predicted placements with ``share_low`` and ``share_high``. The table has no rows for
        another cell.
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
