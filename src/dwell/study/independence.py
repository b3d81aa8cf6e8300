"""Independent unit of a study's runs: the window or the run."""

from __future__ import annotations

from collections.abc import Iterable

from dwell.estimators.slow_processes import slow_processes
from dwell.model import Problem
from dwell.study.over_seeds import RUN, WINDOW


def unit_of(cells: Iterable[tuple[Problem, str]], windows: int) -> str:
    """Return `WINDOW` if every event can occur in every run, else `RUN`.

    `RUN` applies to recorded traces, because few runs include a trace's bad stretch. It also
    applies to runs shorter than the mean time between begins of an on/off process or of episodes,
    or shorter than the correlation time of an AR(1) process.

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
