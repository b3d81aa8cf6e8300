"""Searched cell: a cell with `candidates: all` gets its candidates, once before a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from dwell.errors import Fault, PlacementError, ProblemError
from dwell.estimators.remembered import Remembered
from dwell.model.placement import Placement
from dwell.model.problem import Problem

#: Newest searches of this process.
KNOWN = Remembered[Problem, Mapping[str, Placement]](8)


def searched(problem: Problem) -> Problem:
    """Return the problem with the candidates that its search finds; others as they are.

    The search is `dwell.search` in baseline, with 1,000 cycles and seed 0. The named candidates are
    the first ones; the cheapest other placements follow as A1, A2 and so on.

    Raises
    ------
    ProblemError
        If no placement is feasible, with the reasons; or the cell has several rates.
    """
    every = problem.every_placement
    if every is None or every.is_found:
        return problem
    found = KNOWN.answer(problem, lambda: dict(_found(problem, every.keep)))
    candidates = {**problem.candidates, **found}
    return replace(problem, candidates=candidates, every_placement=replace(every, is_found=True))


def _found(problem: Problem, keep: int) -> Iterator[tuple[str, Placement]]:
    """Yield the found candidates with their names."""
    from dwell.estimators.placement_search import FIRST_CYCLES, rank

    try:
        ranking = rank(problem, cycles=FIRST_CYCLES, top=keep)
    except PlacementError as error:
        raise ProblemError([Fault("candidates.all", str(error))]) from None
    named = problem.candidates
    others = [one.placement for one in ranking.best if one.placement not in named.values()]
    yield from zip(free_names(named), others[: keep - len(named)], strict=False)


def free_names(named: Mapping[str, Placement]) -> Iterator[str]:
    """Yield names of found placements: A1, A2 and so on, without the given names."""
    return (name for k in range(1, 10_000) if (name := f"A{k}") not in named)
