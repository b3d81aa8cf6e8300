"""Which part of a study's runs is independent: the windows of a run, or the whole run alone."""

from __future__ import annotations

from collections.abc import Iterable

from dwell.estimators.slow_processes import slow_processes
from dwell.model import Problem
from dwell.study.over_seeds import RUN, WINDOW


def unit_of(cells: Iterable[tuple[Problem, str]], windows: int) -> str:
    """Return `WINDOW` if each run can show whatever any run shows, else `RUN`.

    A run cannot if it replays a recorded trace, whose bad stretch is in few runs, or if it is
    shorter than an on/off process is off and on, or than the correlation time of an AR(1) process.

    Parameters
    ----------
    cells : iterable of (Problem, str)
        The cells of a run with their scenarios.
    windows : int
        Length of the run.
    """
    for problem, scenario in cells:
        slow, run_ms = slow_processes(problem, scenario), windows * problem.window_ms
        episodes = [item.episodes for item in problem.scenario(scenario) if item.episodes]
        lasting_ms = (
            *(one.renewal_ms for one in slow.on_off),
            *(1e3 * (one.every_s.expectation + one.for_s.expectation) for one in episodes),
            *(one.cycles * problem.pipeline.period_ms for one in slow.memories),
        )
        if slow.loops or max(lasting_ms, default=0.0) > run_ms:
            return RUN
    return WINDOW
