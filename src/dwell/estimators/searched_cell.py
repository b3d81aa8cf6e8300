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

    The search is `dwell.search` in baseline, with 1,000 cycles and seed 0. The named candidates
    are first. As A1, A2 and so on follow the cheapest placement, the cheapest without each of
    its nodes in turn, and the next cheapest.

    Raises
    ------
    ProblemError
        If no placement is feasible, with the reasons.
    """
    every = problem.every_placement
    if every is None or every.is_found:
        return problem
    found = KNOWN.answer(problem, lambda: dict(_found(problem, every.keep)))
    candidates = {**problem.candidates, **found}
    return replace(problem, candidates=candidates, every_placement=replace(every, is_found=True))


def _found(problem: Problem, keep: int) -> Iterator[tuple[str, Placement]]:
    """Yield the found candidates with their names."""
    try:
        cheapest, *next_ones = _cheapest(problem, keep)
    except PlacementError as error:
        raise ProblemError([Fault("candidates.all", str(error))]) from None
    named = problem.candidates
    ranked = dict.fromkeys((cheapest, *_without_a_node(problem, cheapest), *next_ones))
    others = [one for one in ranked if one not in named.values()]
    yield from zip(free_names(named), others[: keep - len(named)], strict=False)


def _cheapest(problem: Problem, most: int) -> list[Placement]:
    from dwell.estimators.placement_search import FIRST_CYCLES, rank

    return [one.placement for one in rank(problem, cycles=FIRST_CYCLES, top=most).best]


def _without_a_node(problem: Problem, placement: Placement) -> Iterator[Placement]:
    """Yield the cheapest placement without each node that movable tasks of a placement use.

    Placements that are all cheap at baseline are often alike, and a fault of one node affects all.
    """
    pipeline = problem.pipeline
    used = {placement[name] for name, task in pipeline.tasks.items() if not task.anchored}
    for left_out in (node for node in problem.fabric.nodes if node in used):
        tasks = {
            name: replace(task, on={node: of for node, of in task.on.items() if node != left_out})
            for name, task in pipeline.tasks.items()
            if not task.anchored
        }
        if not all(task.on for task in tasks.values()):
            continue
        pipe = replace(pipeline, tasks={**pipeline.tasks, **tasks})
        try:
            yield from _cheapest(replace(problem, pipeline=pipe, candidates={}), 1)
        except PlacementError:
            continue


def free_names(named: Mapping[str, Placement]) -> Iterator[str]:
    """Yield names of found placements: A1, A2 and so on, without the given names."""
    return (name for k in range(1, 10_000) if (name := f"A{k}") not in named)
