"""Disturbances of a run by node, link and time: episodes as they were drawn."""

from __future__ import annotations

from dwell.errors import TraceError
from dwell.model import Problem, Scenario
from dwell.record import Run
from dwell.sim import drawn_scenario


def disturbances_of(run: Run) -> Scenario:
    """Return the disturbances of a run, each with its time: as played, else as drawn.

    Raises
    ------
    RunError
        If the run's record of them cannot be read.
    """
    scenario, seed = run.meta.get("scenario"), run.meta.get("seed")
    played = run.played is not None or run.meta.get("kind", "simulated") != "simulated"
    known = scenario in run.problem.scenarios and isinstance(seed, int)
    if played or not known or run.windows.is_empty():
        return run.disturbances
    return drawn_disturbances(run.problem, str(scenario), int(str(seed)), run.windows.height)


def drawn_disturbances(problem: Problem, scenario: str, seed: int, windows: int) -> Scenario:
    """Return a scenario's disturbances as they are drawn; without episodes that cannot be.

    Parameters
    ----------
    seed, windows : int
        The run's; episodes are drawn as far as it reaches.
    """
    try:
        return drawn_scenario(problem, scenario=scenario, seed=seed, windows=windows)
    except TraceError:
        # Their times are recorded ones, which a run does not have.
        return tuple(item for item in problem.scenario(scenario) if item.episodes is None)
