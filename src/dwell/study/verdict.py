"""Verdict on a run: whether it kept the aim for its share of missed deadlines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from dwell.model import Problem
from dwell.model.objective import AIM
from dwell.record import Run
from dwell.study.independence import unit_of
from dwell.study.intervals import share_interval, under
from dwell.study.metric import METRICS
from dwell.study.over_seeds import WINDOW

Word: TypeAlias = Literal["kept", "missed", "open"]

_WORDS: dict[str, Word] = {"under": "kept", "over": "missed", "not shown": "open"}


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """Whether the share of missed deadlines is under the aim.

    Parameters
    ----------
    word : {"kept", "missed", "open"}
        Kept or missed if `dwell.study.under` shows it by the run's windows; open otherwise, and
        if the windows of the run are not independent (a recorded trace, long episodes).
    rate : float
        V_D of all counted cycles.
    low, high : float or None
        95 % interval of the windows' mean; None if the windows are not independent or too few.
    aim : float
    """

    word: Word
    rate: float
    low: float | None
    high: float | None
    aim: float

    def __str__(self) -> str:
        metric, interval = METRICS["violation_rate"], ""
        if self.low is not None and self.high is not None:
            interval = f" [{metric.number(self.low)}, {metric.number(self.high)}]"
        return (
            f"{metric.text(self.rate)}{interval} of {metric.wording} "
            f"(aim: under {self.aim * 100:g} %): {self.word}"
        )


def verdict_of(run: Run, problem: Problem, rate: float, aim: float = AIM) -> RunVerdict:
    """Judge a run by the windows after its warm-up.

    Parameters
    ----------
    rate : float
        V_D of the run's summary (`dwell.study.summary`).
    aim : float
        The run should miss a smaller share of its deadlines.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    windows = run.arrays("windows")
    rates = windows["violation_rate"][~windows["warmup"]].tolist()
    if run.is_simulated:
        cells = [(problem, str(run.meta["scenario"]))]
        if unit_of(cells, len(windows["warmup"])) != WINDOW:
            return RunVerdict("open", rate, None, None, aim)
    interval = share_interval(rates, windows=len(rates))
    if not interval.known:
        return RunVerdict("open", rate, None, None, aim)
    word = _WORDS[under(rates, aim, windows=len(rates))]
    return RunVerdict(word, rate, min(interval.low, rate), max(interval.high, rate), aim)
