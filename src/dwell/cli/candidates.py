"""`dwell candidates`: the placements with the least J among all placements of a cell."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

import dwell
from dwell.cli.options import CellArgument, Json, Scenario, Seed, Traces, flag, option
from dwell.cli.output import aligned, print_json, with_error
from dwell.cli.placement_prices import placement_prices
from dwell.errors import ProblemError
from dwell.model.bounds import counted

if TYPE_CHECKING:
    from dwell.estimators.placement_search import Ranked, Ranking
    from dwell.model import Placement, Problem


def candidates(
    cell: CellArgument,
    traces: Traces = None,
    scenario: Scenario = "baseline",
    scenarios: Annotated[
        str | None,
        option("NAME,NAME", "Scenarios in place of --scenario; J is the largest of them."),
    ] = None,
    cycles: Annotated[
        int | None,
        option(
            "N",
            "Cycles per placement.",
            default="1000, doubled until the two best differ, at most 100000",
            min=1,
        ),
    ] = None,
    seed: Seed = 0,
    top: Annotated[int, option("K", "Placements to show.", min=1, max=100)] = 8,
    as_yaml: Annotated[bool, flag("--yaml", "Print them as a block of a cell file.")] = False,
    as_json: Json = False,
) -> None:
    """Find the cheapest of all placements of a cell.

    The search simulates each placement that a lower bound of J does not exclude, on common samples.
    A scenario with disturbances is simulated for 300 windows.
    """
    from dwell.estimators.placement_search import rank, rank_until_apart, require_runs

    problem = dwell.load(cell, traces=traces)
    try:
        problem.objective.require_searchable()
    except ProblemError as error:
        raise ProblemError(error.faults, str(cell)) from None
    names = (scenario,) if scenarios is None else tuple(dict.fromkeys(scenarios.split(",")))
    if cycles is None:
        ranking = rank_until_apart(problem, names, seed=seed, top=top)
    else:
        require_runs(problem, cycles, "--cycles")
        ranking = rank(problem, names, cycles=cycles, seed=seed, top=top)
    called = dict(_named(problem, ranking.best))
    if as_json:
        print_json(_contents(problem, ranking, called))
    elif as_yaml:
        typer.echo(_block(problem, called), nl=False)
    else:
        typer.echo("\n".join(_summary(problem, names, ranking, called)))


def _named(problem: Problem, best: Sequence[Ranked]) -> Iterator[tuple[str, Placement]]:
    """Yield the placements with their names in the cell file, or as A1, A2, and so on."""
    from dwell.estimators.searched_cell import free_names

    known = {placement: name for name, placement in problem.candidates.items()}
    free = free_names(problem.candidates)
    for one in best:
        yield known.get(one.placement) or next(free), one.placement


def _movable(problem: Problem, placement: Placement) -> Mapping[str, str]:
    tasks = problem.pipeline.tasks
    return {task: node for task, node in placement.first.items() if not tasks[task].anchored}


def _contents(
    problem: Problem, ranking: Ranking, called: Mapping[str, Placement]
) -> dict[str, Any]:
    from dwell.cost import cost_error

    difference, error = ranking.difference
    return {
        "candidates": {
            name: {
                "placement": dict(one.placement),
                "cost": one.cost,
                "cost_error": cost_error(one.qos.error, problem.objective),
                "l95_ms": one.qos.l95_ms,
                "violation_rate": one.qos.violation_rate,
                "errors": one.qos.error,
                "utilisation": dict(one.qos.utilisation),
                **placement_prices(problem, one.placement, one.qos.price_per_hour),
            }
            for name, one in zip(called, ranking.best, strict=True)
        },
        "cycles": ranking.cycles,
        "exact": ranking.is_exact,
        "gap": ranking.gap,
        "tie": ranking.is_tie,
        "difference": difference,
        "difference_error": error,
        "placements": ranking.placements,
        "looked": ranking.looked,
        "simulated": ranking.simulated,
        "pruned": dict(ranking.pruned),
    }


def _block(problem: Problem, called: Mapping[str, Placement]) -> str:
    """Return a block `candidates:` of a cell file."""
    from dwell.cellfile.yaml_text import yaml_of

    block = {name: dict(_movable(problem, placement)) for name, placement in called.items()}
    return yaml_of({"candidates": block})


def _summary(
    problem: Problem, scenarios: Sequence[str], ranking: Ranking, called: Mapping[str, Placement]
) -> Iterator[str]:
    from dwell.cost import cost_error
    from dwell.study.metric import METRICS

    l95, rate, cost = METRICS["l95_ms"], METRICS["violation_rate"], METRICS["cost"]
    resources = problem.fabric.resources
    yield (
        f"{problem.name}: {counted(ranking.placements, 'placement')}, {', '.join(scenarios)}, "
        f"{counted(ranking.cycles, 'cycle')} each"
    )
    yield ""
    rows = []
    for name, one in zip(called, ranking.best, strict=True):
        l95_error, rate_error = one.qos.error or (0.0, 0.0)
        error = cost_error(one.qos.error, problem.objective)
        money = placement_prices(problem, one.placement, one.qos.price_per_hour)
        rows.append(
            [
                name,
                with_error(f"{one.cost:.3f}", error),
                with_error(f"{one.qos.l95_ms:.1f}", l95_error),
                with_error(f"{one.qos.violation_rate * 100:.2f}", rate_error * 100),
                *(f"{one.qos.utilisation[resource] * 100:.0f}" for resource in resources),
                *(METRICS[column].number(value) for column, value in money.items()),
            ]
        )
    head = [
        "placement",
        cost.heading,
        l95.heading,
        rate.heading,
        *(f"U of {r} (%)" for r in resources),
        *(METRICS[column].heading for column in money),
    ]
    yield aligned(head, rows)
    yield ""
    (first, placement), *others = called.items()
    on = defaultdict(list)
    for task, node in _movable(problem, placement).items():
        on[node].append(task)
    yield f"{first}: " + "; ".join(f"{', '.join(tasks)} on {node}" for node, tasks in on.items())
    for name, other in others:
        moved = ", ".join(f"{task} on {other[task]}" for task in other.moved(placement))
        yield f"{name}: as {first}, with {moved}"
    yield ""
    yield _found(ranking, list(called))


def _found(ranking: Ranking, names: Sequence[str]) -> str:
    """Return how sure the order is, and how many placements were simulated."""
    excluded = "".join(f"; {number} {reason}" for reason, number in ranking.pruned.items())
    counts = f"{ranking.simulated} simulated{excluded}"
    if not ranking.is_exact:
        return (
            f"not exact: stopped after {ranking.looked} partial placements; a placement may be "
            f"cheaper by up to {ranking.gap * 100:.2g} % ({counts})"
        )
    if len(names) < 2:
        return f"the only placement ({counts})"
    gain, error = ranking.difference
    if ranking.is_tie:
        return f"tie: J of {names[1]} is {gain:.2g} ± {error:.2g} above J of {names[0]} ({counts})"
    return f"J of {names[1]} is {gain:.2g} ± {error:.2g} above J of {names[0]} ({counts})"
