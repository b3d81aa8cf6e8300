"""Disturbances of a run by node, link and time: episodes as they were drawn."""

from __future__ import annotations

from collections.abc import Sequence

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
    played = run.played is not None or not run.is_simulated
    known = scenario in run.problem.scenarios and isinstance(seed, int)
    if played or not known or run.windows.is_empty():
        return run.disturbances
    return drawn_disturbances(
        *(run.problem, str(scenario), int(str(seed)), run.windows.height),
        streams=str(run.meta.get("streams", "")),
        shared=run.meta.get("shared", ()),
        disturbances=run.shared_disturbances,
    )


def drawn_disturbances(
    problem: Problem,
    scenario: str,
    seed: int,
    windows: int,
    *,
    streams: str = "",
    shared: Sequence[str] = (),
    disturbances: Scenario = (),
) -> Scenario:
    """Return a scenario's disturbances as they are drawn; without episodes that cannot be.

    Parameters
    ----------
    seed, windows : int
        The run's; episodes are drawn as far as it reaches.
    streams : str
        What the names of its streams begin with: those of a cell of a fleet.
    shared, disturbances
        Nodes that the cells of a fleet share, and what happens to them (see `dwell.draw`).
    """
    try:
        return drawn_scenario(
            problem,
            scenario=scenario,
            seed=seed,
            windows=windows,
            streams=streams,
            shared=shared,
            disturbances=disturbances,
        )
    except TraceError:
        # Their times are recorded ones, which a run does not have.
        items = (*problem.scenario(scenario), *disturbances)
        return tuple(dict.fromkeys(item for item in items if item.episodes is None))
