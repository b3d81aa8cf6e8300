"""Disturbances of a run by node, link and time, including the sampled episodes."""

from __future__ import annotations

from collections.abc import Sequence

from dwell.errors import TraceError
from dwell.model import Problem, Scenario
from dwell.record import Run
from dwell.sim import Drawing


def disturbances_of(run: Run) -> Scenario:
    """Return the disturbances of a run with their times: recorded, else sampled again.

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
    """Return a scenario's disturbances with sampled episodes; without episodes of missing traces.

    Parameters
    ----------
    seed, windows : int
        Seed and length of the run; episodes are sampled up to its end.
    streams : str
        Prefix of the names of random streams, for a cell of a fleet.
    shared, disturbances
        Shared nodes of a fleet, and their disturbances (see `dwell.draw`).
    """
    try:
        return Drawing(
            *(problem, scenario),
            seed=seed,
            windows=windows,
            streams=streams,
            shared=shared,
            disturbances=disturbances,
        ).episodes()
    except TraceError:
        # The episodes have recorded times, and a run does not include their traces.
        items = (*problem.scenario(scenario), *disturbances)
        return tuple(dict.fromkeys(item for item in items if item.episodes is None))
