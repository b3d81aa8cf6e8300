"""How a comparison was made: the cell, the runs, the intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from dwell.model import (
    AR1,
    Constant,
    Disturbance,
    Exponential,
    Gamma,
    LogNormal,
    NodeDisturbance,
    Normal,
    Problem,
    Process,
    Scenario,
    Trace,
    Uniform,
)
from dwell.report.formatting import listed, percent, shown_scenario, write_number
from dwell.report.page import definitions, items, paragraph
from dwell.study import Comparison

__all__ = ["describe_cell", "describe_scenario", "method", "placements"]


def method(comparison: Comparison) -> Iterator[str]:
    """Return the parts of the section that says how the numbers came about."""
    problem = comparison.problem
    yield paragraph(
        "For every scenario and seed one realisation of everything random (execution times, "
        "delays, losses, foreign load) is drawn before any policy acts, and every policy plays "
        "the same one: differences between policies are differences of pairs. A discrete-event "
        "simulation carries each cycle through queues, nodes and links. The controller sees a "
        "window when it closes, and decides for those after it."
    )
    yield definitions(
        {
            **describe_cell(problem),
            "estimator": f"“{problem.controller.estimator}”",
            "run": f"{comparison.windows} windows, of which the first {problem.warmup_windows} "
            "are warm-up and count nowhere",
            "seeds": _ranges(comparison.seeds),
            "intervals": "95 %, two-sided, over seeds, by the studentised bootstrap; of medians, "
            "by order statistics. None is taken over windows or cycles, which are not independent.",
            "versions": ", ".join(f"{name} {text}" for name, text in comparison.versions.items()),
        }
    )
    yield paragraph("What the scenarios add to the cell:")
    yield items(
        f"{shown_scenario(name)}: {describe_scenario(problem.scenario(name))}."
        for name in comparison.scenarios
    )


def describe_cell(problem: Problem) -> dict[str, str]:
    """Say what a cell is, and what its controller does, by headings."""
    pipeline, controller = problem.pipeline, problem.controller
    span_s = problem.window_cycles * pipeline.period_ms / 1e3
    return {
        "pipeline": f"{' → '.join(pipeline.topological())}; period "
        f"{write_number(pipeline.period_ms)} ms, deadline {write_number(pipeline.deadline_ms)} ms",
        "nodes": listed(
            f"{node.name} ({node.tier}, {node.cores} cores)"
            for node in problem.fabric.nodes.values()
        ),
        "window": f"{problem.window_cycles} cycles, {write_number(span_s)} s",
        "cost": _cost(problem),
        "caps": _caps(problem),
        "controller": f"on {problem.controller_node}, begins with {problem.initial}; a migration "
        f"is followed by {controller.min_dwell} windows without another (N_min), and must promise "
        f"an improvement of J above {controller.min_improvement:g} (Δ_min)",
    }


def placements(problem: Problem, names: Sequence[str]) -> str:
    """Say where each candidate puts the tasks that can move."""
    movable = [name for name, task in problem.pipeline.tasks.items() if not task.anchored]
    parts = []
    for name in names:
        placement = problem.candidates[name]
        where = listed(f"{task} on {placement[task]}" for task in movable)
        parts.append(f"{name} has {where}" if where else f"{name} is the only placement")
    return "; ".join(parts) + "."


def describe_scenario(scenario: Scenario) -> str:
    """Say what a scenario does to the fabric, what happens alike in several places once."""
    where: dict[str, list[str]] = {}
    for item in scenario:
        what, place = _disturbance(item)
        where.setdefault(what, []).append(place)
    return "; ".join(f"{what} on {listed(places)}" for what, places in where.items()) or "nothing"


def _disturbance(item: Disturbance) -> tuple[str, str]:
    """Return what a disturbance does, and where."""
    what = []
    if isinstance(item, NodeDisturbance):
        place = item.node
        if item.stress_threads:
            what.append(f"{item.stress_threads} threads of foreign work")
    else:
        place = item.link.replace("->", "→")
        if item.add_delay_ms is not None:
            what.append(f"{_process(item.add_delay_ms)} more delay a message")
        if item.loss:
            what.append(f"{percent(item.loss, 1)} of the messages lost")
        if math.isfinite(item.rate_mbps):
            what.append(f"a rate of {item.rate_mbps:g} Mbit/s")
    if item.down:
        what.append("an outage")
    when = ""
    if item.at_s or math.isfinite(item.for_s):
        until = f" for {item.for_s:g} s" if math.isfinite(item.for_s) else ""
        when = f" from {item.at_s:g} s{until}"
    if item.episodes is not None:
        off_s, on_s = (one.expectation for one in (item.episodes.every_s, item.episodes.for_s))
        when += f", in episodes (off {off_s:.3g} s, on {on_s:.3g} s in the mean)"
    if item.ramp_s:
        falls = " and falling likewise" if math.isfinite(item.for_s) else ""
        when += f", growing for {item.ramp_s:g} s{falls}"
    return (listed(what) or "no change") + when, place


def _process(process: Process) -> str:
    """Return a process in words, milliseconds."""
    match process:
        case Constant(value):
            return f"{value:g} ms"
        case Normal(mean, std):
            return f"{mean:g} ± {std:g} ms (normal)"
        case Uniform(low, high):
            return f"{low:g} to {high:g} ms"
        case LogNormal(mean, cv):
            return f"{mean:g} ms (lognormal, cv {cv:g})"
        case Gamma(mean, cv):
            return f"{mean:g} ms (gamma, cv {cv:g})"
        case AR1(mean, cv, rho):
            return f"{mean:g} ms (autoregressive, cv {cv:g}, rho {rho:g})"
        case Exponential(mean):
            return f"{mean:g} ms (exponential)"
        case Trace():
            return f"{process.expectation:.3g} ms (replayed from {process.table.file})"
    return f"{process.expectation:.3g} ms in the mean"


def _cost(problem: Problem) -> str:
    """Return J with the numbers of this cell."""
    weights, targets = problem.objective.weights, problem.objective.targets
    terms = [
        f"{weights.latency:g} · L95 / {targets.latency_ms:.4g} ms",
        f"{weights.violations:g} · V_D",
        f"{weights.robot:g} · U_r / {targets.robot:g}",
        f"{weights.edge:g} · U_e / {targets.edge:g}",
    ]
    if weights.cloud is not None and targets.cloud is not None:
        terms.append(f"{weights.cloud:g} · U of the cloud / {targets.cloud:g}")
    terms.append(f"{weights.switching:g} · share of the tasks moved")
    return "J = " + " + ".join(terms)


def _caps(problem: Problem) -> str:
    caps = problem.objective.caps
    found = []
    if math.isfinite(caps.latency_ms):
        found.append(f"L95 {caps.latency_ms:g} ms")
    if math.isfinite(caps.utilisation):
        found.append(f"utilisation {percent(caps.utilisation)}")
    return ", ".join(found) or "none"


def _ranges(seeds: Sequence[int]) -> str:
    """``1 to 20``, or the list where it is none."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))
