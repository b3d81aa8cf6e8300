"""`dwell check`: every fault of a cell, or what it amounts to before anything is run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

import dwell
from dwell.cli.completion import nodes
from dwell.cli.options import CellArgument, Insecure, Json, Keys, Scenario, Traces
from dwell.cli.output import aligned, print_json, warn, with_error
from dwell.cli.placement_prices import placement_prices
from dwell.display import milliseconds
from dwell.errors import ExitCode, Fault, PolicyError, ProblemError
from dwell.model.bounds import counted
from dwell.model.controller_settings import AUTO
from dwell.model.entry_points import WARNINGS, added, added_name

if TYPE_CHECKING:
    from dwell.estimators.prices import Price
    from dwell.estimators.shadow_price import ShadowPrice
    from dwell.model import Problem


def check(
    cell: CellArgument,
    traces: Traces = None,
    node: Annotated[
        str | None,
        typer.Option(
            help="Check instead that this computer can be this node of the live cell: import and "
            "construct its stages and actuators.",
            autocompletion=nodes,
            hidden=True,
        ),
    ] = None,
    scenario: Scenario = "baseline",
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Find all faults of a cell, or show what its candidates do.

    Faults and warnings go to stderr, one per line as file:line: path: message. The exit code is 2
    with faults, 0 with warnings only.
    """
    try:
        problem = dwell.load(cell, traces=traces)
    except ProblemError as error:
        _refuse(error.faults, str(error), as_json=as_json)
    if node is not None:
        if not added_name("check_node")(
            problem, cell, node, keys, insecure=insecure, as_json=as_json
        ):
            raise typer.Exit(ExitCode.WRONG)
        return
    if faults := tuple(class_faults(problem)):
        _refuse(faults, "\n".join(f"{cell}: {fault}" for fault in faults), as_json=as_json)
    from dwell.estimators import searched, warnings_of
    from dwell.estimators.cell_warnings import unpriced
    from dwell.estimators.prices import prices_of
    from dwell.estimators.registry import resolved
    from dwell.estimators.shadow_price import affordable
    from dwell.model.evolve import evolve
    from dwell.policies.registry import estimator_of

    try:
        problem = searched(problem)
    except ProblemError as error:
        _refuse(error.faults, f"{cell}: {error}", as_json=as_json)
    estimator = estimator_of(problem)
    problem = resolved(evolve(problem, {"controller.estimator": estimator}), estimator)
    prices, tried = prices_of(problem, scenario), _shadow_prices(problem)
    fractions = {name: affordable(problem, shadows) for name, shadows in tried.items()}
    cycles = min(price.cycles for price in prices.values())
    warnings = (
        *warnings_of(problem),
        *unpriced(problem, scenario, cycles),
        *chain.from_iterable(warn(problem) for warn in added(WARNINGS).values()),
    )
    if as_json:
        rows = [_fault(warning) for warning in warnings]
        contents = {"valid": True, **_contents(problem), "priced_under": scenario}
        candidates = _priced(problem, prices)
        for name, fraction in fractions.items():
            candidates[name]["shadow_fraction"] = fraction
            candidates[name]["shadow_prices"] = [asdict(one) for one in tried[name]]
        print_json(contents | {"candidates": candidates, "warnings": rows})
    else:
        notes = _shadow_notes(problem, tried, fractions)
        typer.echo("\n".join((_summary(problem, prices, scenario), *notes)))
        warn(cell, warnings)


def _refuse(faults: Iterable[Fault], text: str, *, as_json: bool) -> NoReturn:
    """Print the faults of a cell, and exit."""
    if as_json:
        rows = [_fault(fault) | {"line": fault.line} for fault in faults]
        print_json({"valid": False, "faults": rows})
    else:
        typer.echo(text, err=True)
    raise typer.Exit(ExitCode.WRONG)


def class_faults(problem: Problem) -> Iterator[Fault]:
    """Yield the faults of the policy and the estimator where these are a user's classes."""
    from dwell.estimators import by_name as make_estimator
    from dwell.estimators.registry import resolved
    from dwell.model.bounds import CLASS_PATH
    from dwell.policies import by_name as make_policy
    from dwell.policies.registry import estimator_of

    settings, estimator = problem.controller, estimator_of(problem)
    try:
        if CLASS_PATH.holds(estimator):
            make_estimator(estimator, problem)
        problem = resolved(problem, estimator)
    except ProblemError as error:
        yield Fault("controller.estimator", str(error))
    try:
        if CLASS_PATH.holds(settings.policy) and settings.policy not in problem.candidates:
            make_policy(settings.policy, problem)
    except PolicyError as error:
        yield Fault("controller.policy", str(error))


def _fault(fault: Fault) -> dict[str, Any]:
    return {"path": fault.path, "message": fault.message}


def _contents(problem: Problem) -> dict[str, Any]:
    """Return the contents of the cell as plain values."""
    pipeline = problem.pipeline
    return {
        "name": problem.name,
        "period_ms": pipeline.period_ms,
        "deadline_ms": pipeline.deadline_ms,
        "window_cycles": problem.window_cycles,
        "tasks": {name: list(task.on) for name, task in pipeline.tasks.items()},
        "nodes": {name: node.tier for name, node in problem.fabric.nodes.items()},
        "links": list(problem.fabric.links),
        "scenarios": list(problem.scenarios),
        "controller": {
            "policy": problem.controller.policy,
            "estimator": problem.controller.estimator,
            "decide_cycles": problem.decide_cycles,
            "min_dwell": problem.min_dwell,
            "min_dwell_cycles": problem.controller.min_dwell_cycles,
        },
    }


def _priced(problem: Problem, prices: Mapping[str, Price]) -> dict[str, Any]:
    """Return the candidates with their prices as plain values."""
    return {
        name: {
            "placement": dict(placement),
            "l95_ms": prices[name].l95_ms,
            "l95_error_ms": prices[name].l95_error_ms,
            "uncut_l95_ms": prices[name].uncut_l95_ms,
            "lost_windows": prices[name].lost_windows,
            "violation_rate": prices[name].violation_rate,
            "violation_error": prices[name].violation_error,
            "own_work": dict(prices[name].own),
            "cycles": prices[name].cycles,
            "is_settled": prices[name].is_settled,
            **_further(prices[name]),
            **placement_prices(problem, placement, prices[name].price_per_hour),
        }
        for name, placement in problem.candidates.items()
    }


def _further(price: Price) -> dict[str, float]:
    """Return what J and caps need beyond L95, V_D and utilisation, by name."""
    age_ms, age_error_ms = price.age or (None, None)
    values = {"age_ms": age_ms, "age_error_ms": age_error_ms, "misses": price.misses}
    return {name: value for name, value in values.items() if value is not None}


def _summary(problem: Problem, prices: Mapping[str, Price], scenario: str) -> str:
    from dwell.study.metric import METRICS

    pipeline, nodes = problem.pipeline, problem.fabric.nodes
    resources = problem.fabric.resources
    movable = [
        f"{name} ({', '.join(task.on)})"
        for name, task in pipeline.tasks.items()
        if not task.anchored
    ]
    what = "node" if len(resources) == len(nodes) else "node and accelerator"
    l95, rate = METRICS["l95_ms"], METRICS["violation_rate"]
    money = {
        name: placement_prices(problem, placement, prices[name].price_per_hour)
        for name, placement in problem.candidates.items()
    }
    priced = [METRICS[column] for column in next(iter(money.values()))]
    used = [f"{one} (%)" for one in resources]
    age, cap = METRICS["seen_age_ms"], problem.objective.caps.misses
    head = ["candidate", l95.heading, rate.heading, *used, *(one.heading for one in priced)]
    head += [age.heading] if problem.objective.weighs_age else []
    head += [] if cap is None else [f"over {cap.m} in {cap.k} (%)"]
    rows = [
        [
            name,
            with_error(milliseconds(price.l95_ms), price.l95_error_ms),
            with_error(rate.number(price.violation_rate), price.violation_error * 100),
            *(f"{price.own[one] * 100:.0f}" for one in resources),
            *(metric.number(money[name][metric.column]) for metric in priced),
            *([] if price.age is None else [with_error(milliseconds(price.age[0]), price.age[1])]),
            *([] if price.misses is None else [f"{price.misses * 100:.2f}"]),
        ]
        for name, price in prices.items()
    ]
    controller, least = problem.controller, counted(problem.min_dwell, "window")
    span_s = min(price.cycles for price in prices.values()) * pipeline.period_ms / 1e3
    chain = problem.objective.latency
    of = "" if chain is None else f" of the age of {chain}"
    disturbed = f" for {span_s:.4g} s" if problem.scenario(scenario) else ""
    return "\n".join(
        (
            f"{problem.name}: no faults",
            f"{counted(len(pipeline.tasks), 'task')}, {counted(len(nodes), 'node')}, "
            f"{counted(len(problem.fabric.links), 'link')}; "
            f"P {pipeline.period_ms:.4g} ms, D {pipeline.deadline_ms:.4g} ms, "
            f"W {counted(problem.window_cycles, 'cycle')}",
            f"decisions: {controller.policy} with {controller.estimator}, every "
            f"{counted(problem.decide_cycles, 'cycle')}; N_min {least}",
            f"can move: {', '.join(movable) or 'nothing'}",
            f"scenarios: {', '.join(problem.scenarios)}",
            "",
            f"{scenario[0].upper()}{scenario[1:]}, each simulated alone{disturbed}: L95{of} (at "
            f"most {milliseconds(problem.censor_ms)} ms) and V_D of a window with standard errors, "
            f"and the cell's own work on each {what}",
            aligned(head, rows),
            *(f"{name}: {note}" for name, price in prices.items() for note in _notes(price)),
        )
    )


def _shadow_prices(problem: Problem) -> Mapping[str, Sequence[ShadowPrice]]:
    """Return the prices that decide the shares of shadows; empty if a share is set."""
    from dwell.estimators.registry import shadowing
    from dwell.estimators.shadow_price import shadow_prices

    settings = problem.controller
    is_priced = settings.estimator in shadowing() and settings.shadow_fraction == AUTO
    return shadow_prices(problem) if is_priced else {}


def _shadow_notes(
    problem: Problem, tried: Mapping[str, Sequence[ShadowPrice]], fractions: Mapping[str, float]
) -> Iterator[str]:
    """Yield the shares of shadows, and why they are not larger."""
    from dwell.model.shadow_plan import alternatives

    # Replicas whose members are the only other candidates send no shadows.
    idle = {
        name
        for name, others in zip(problem.candidates, alternatives(problem.candidates), strict=True)
        if name in problem.replicas and not others
    }
    fractions = {name: fraction for name, fraction in fractions.items() if name not in idle}
    most = problem.shadow_fraction
    if free := [name for name, fraction in fractions.items() if fraction == most]:
        yield f"shadows: {most:g} under {', '.join(free)}"
    for name, fraction in fractions.items():
        if fraction == most:
            continue
        too_dear = tried[name][0 if fraction else -1]
        more = f"miss {too_dear.violation_rate * 100:.2f} points more"
        if problem.objective.weights.violations * too_dear.violation_rate < too_dear.cost / 2:
            more = f"have an L95 {milliseconds(too_dear.l95_ms)} ms longer"
        alone = "" if fraction else f"; under {name} the estimator learns from the incumbent alone"
        yield f"shadows: {fraction:g}; at {too_dear.fraction:g} {name} would {more}{alone}"


def _notes(price: Price) -> Iterator[str]:
    """Yield the reasons for which a price says less than its numbers."""
    if price.lost_windows:
        share = f"{price.lost_windows * 100:.3g} % of windows"
        yield f"lost in {share}: more than 5 % of their cycles never complete"
    if not price.is_settled:
        yield f"not settled after {price.cycles} cycles: the means of the two halves differ"
