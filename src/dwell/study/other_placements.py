"""The results of every placement, if it never moves, on the realisation of a run."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice

from dwell.model import FrozenDict, Problem
from dwell.record import Run
from dwell.sim import Realisation, simulate_realisation
from dwell.study.summary import answer_of

#: Most candidates that are simulated, in the order of the cell file, the initial one first.
MOST = 8
#: Key of a run's record.
PLACEMENTS = "placements"


def other_placements(
    problem: Problem,
    realisation: Realisation,
    most: int = MOST,
    known: Mapping[str, Run] = FrozenDict(),
) -> dict[str, dict[str, float]]:
    """Simulate placements that never move.

    Parameters
    ----------
    known : mapping of str to Run
        Runs that are not simulated again, by candidate.

    Returns
    -------
    dict of str to dict
        `violation_rate`, `l95_ms` and `cost` by candidate, as `dwell.study.summary` has them.

    Raises
    ------
    SimulationError
        If the realisation has no window after the warm-up.
    """
    first = problem.initial
    names = (first, *(name for name in problem.candidates if name != first))

    def run(name: str) -> Run:
        return known.get(name) or simulate_realisation(problem, realisation, policy=name)

    return {name: answer_of(run(name), problem) for name in islice(names, most)}
