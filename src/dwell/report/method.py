"""Last part of a report: the cell, its placements and scenarios, and the policies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from dwell.display import Measure, decimals_for, write_number
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.estimators.registry import resolved
from dwell.model import (
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Pipeline,
    Placement,
    Problem,
    Process,
    Replicas,
    Trace,
)
from dwell.model.bounds import counted
from dwell.model.disturbed import on_node
from dwell.model.placement import written_nodes
from dwell.policies.registry import estimator_of
from dwell.report.formatting import OURS, percent, shown_contender, write_ms
from dwell.report.page import Block, Definitions
from dwell.report.palette import FAMILIES, Palette, contended
from dwell.report.table import Columns, Table, Text

#: Sentences by the name in brackets after a policy.
BELIEFS = {
    **{name: estimator.sentence for name, estimator in ESTIMATORS.items()},
    "hindsight": "is told, one window late, what every placement would have cost: what the rule "
    "does with estimates that are right.",
}
#: Sentences by the name after a policy and a hyphen.
VARIANTS = {
    "thresholds": "by the thresholds alone, without a cost.",
    "tuned": "with settings that were chosen on seeds that nothing else is done on.",
    "escape": "with the escape: it may move before the dwell time is over, where the placement it "
    "is on is over a cap.",
    "dwell": "under the dwell time of Algorithm 1.",
}


def method_blocks(
    problem: Problem, scenarios: Sequence[str], policies: Iterable[str], prefix: str = ""
) -> list[Block]:
    """Return the descriptions of a cell, its scenarios and the policies."""
    return [
        Definitions(cell_definitions(problem)),
        scenarios_table(problem, scenarios, prefix),
        Definitions(describe_contenders(problem, policies)),
    ]


def cell_definitions(problem: Problem) -> dict[str, str]:
    """Return the settings of a cell and its controller, by heading."""
    estimator = estimator_of(problem)
    problem = resolved(problem, estimator)
    pipeline, controller = problem.pipeline, problem.controller
    span_s = problem.window_ms / 1e3
    nodes = problem.fabric.nodes.values()
    return {
        "cell": problem.name,
        "pipeline": str(pipeline),
        **_rates(pipeline),
        "period": write_ms(pipeline.period_ms),
        "deadline": write_ms(pipeline.deadline_ms),
        "nodes": ", ".join(
            f"{one.name} ({one.tier}, {counted(one.cores, 'core')}{_accelerators(one)})"
            for one in nodes
        ),
        "window": f"{counted(problem.window_cycles, 'cycle')}, "
        f"{write_number(span_s, decimals_for(span_s, 1))} s",
        "warm-up": counted(problem.warmup_windows, "window"),
        "cost": _cost(problem),
        "caps": _caps(problem),
        "controller": f"on {problem.controller_node}, begins with {problem.initial}",
        "decisions": f"every {counted(problem.decide_cycles, 'cycle')}",
        "N_min": counted(problem.min_dwell, "window"),
        **({"dwell": f"{least} cycles at least"} if (least := controller.min_dwell_cycles) else {}),
        "Δ_min": f"{controller.min_improvement:g}",
        "estimator": estimator,
    }


def _rates(pipeline: Pipeline) -> dict[str, str]:
    """Return the rates of tasks, the sampled flows and the chains, if there are any."""
    bounds = {
        name: f", at most {write_ms(chain.max_age_ms)}" if chain.is_bounded else ""
        for name, chain in pipeline.chains.items()
    }
    parts = {
        "every n cycles": [f"{name} {rate}" for name, rate in pipeline.rates.items() if rate > 1],
        "sampled": [f"{flow.source} → {flow.target}" for flow in pipeline.flows if flow.sampled],
        "chains": [
            f"{name}: {chain.source} to {chain.target}{bounds[name]}"
            for name, chain in pipeline.chains.items()
        ],
    }
    return {name: "; ".join(those) for name, those in parts.items() if those}


def placements_table(problem: Problem, prefix: str = "") -> Table:
    """Return a table of the nodes of movable tasks in each candidate."""
    movable = [name for name, task in problem.pipeline.tasks.items() if not task.anchored]
    rows = [
        {
            "placement": name,
            **{task: written_nodes(placement[task]) for task in movable},
            **_copies(placement),
        }
        for name, placement in problem.candidates.items()
    ]
    columns: Columns = [
        Text("placement", "placement", "placement"),
        *(Text(one, one) for one in movable),
        *([Text("copies", "copies")] if problem.replicas else []),
    ]
    palette = Palette.of(problem.candidates)
    return Table(f"{prefix}candidates", "Placements", columns, rows, palette=palette)


def _copies(placement: Placement) -> dict[str, str]:
    """Return the members of a placement with replicas."""
    if not isinstance(placement, Replicas):
        return {}
    after = f"after {write_ms(placement.after_ms)}" if placement.after_ms else "at once"
    return {"copies": f"{placement.members[0]}; {placement.members[1]} {after}"}


def scenarios_table(problem: Problem, names: Sequence[str], prefix: str = "") -> Table:
    """Return a table of the scenarios, with one row per disturbance."""
    rows = []
    for name in names:
        for item in problem.scenario(name):
            row = {"scenario": name, "at_s": item.at_s, "for_s": item.for_s, "ramp_s": item.ramp_s}
            if item.episodes is not None:
                row |= {
                    "off_s": item.episodes.every_s.expectation,
                    "on_s": item.episodes.for_s.expectation,
                }
            rows.append({**row, **_disturbance(item)})
    columns: Columns = [
        Text("where", "where"),
        Text("what", "what"),
        Measure("at_s", "from", "s"),
        Measure("for_s", "for", "s"),
        Measure("ramp_s", "ramp", "s"),
        Measure("off_s", "off, mean", "s"),
        Measure("on_s", "on, mean", "s"),
    ]
    return Table(
        f"{prefix}scenarios",
        "Scenarios: what is disturbed",
        columns,
        rows,
        Text("scenario", "", "scenario"),
        "Off and on: of episodes, whose times are drawn.",
    )


def _disturbance(item: NodeDisturbance | LinkDisturbance) -> dict[str, str]:
    if isinstance(item, NodeDisturbance):
        return {"where": item.node, "what": on_node(item)}
    what = ["down"] if item.down else []
    if item.add_delay_ms is not None:
        what.append(f"delay {_process(item.add_delay_ms)}")
    if item.loss:
        what.append(f"loss {percent(item.loss, 1)}")
    if math.isfinite(item.rate_mbps):
        what.append(f"{item.rate_mbps:g} Mbit/s")
    return {"where": item.link.replace("->", "→"), "what": ", ".join(what)}


def _process(process: Process) -> str:
    """Return the kind of a process and its parameters in milliseconds, as text."""
    if isinstance(process, Trace):
        return f"{process.expectation:.3g} ms in the mean, replayed from {process.table.file}"
    numbers = ", ".join(
        f"{name} {getattr(process, name):g}"
        for name in getattr(process, "__dataclass_fields__", ())
        if isinstance(getattr(process, name), int | float)
    )
    return f"{type(process).__name__.lower()} ({numbers}) ms"


def _accelerators(node: Node) -> str:
    return "".join(f", {count} × {kind}" for kind, count in node.accelerators.items())


def _cost(problem: Problem) -> str:
    """Return the formula of J with the weights and targets of a cell."""
    objective = problem.objective
    weights, targets, chain = objective.weights, objective.targets, objective.latency
    l95 = "L95" if chain is None else f"L95 of the age of {chain}"
    terms = [
        f"{weights.latency:g} · {l95} / {targets.latency_ms:.4g} ms",
        f"{weights.violations:g} · V_D",
        f"{weights.robot:g} · U_r / {targets.robot:g}",
        f"{weights.edge:g} · U_e / {targets.edge:g}",
    ]
    if weights.cloud is not None and targets.cloud is not None:
        terms.append(f"{weights.cloud:g} · U of the cloud / {targets.cloud:g}")
    if weights.age and targets.age_ms is not None:
        terms.append(f"{weights.age:g} · age / {targets.age_ms:.4g} ms")
    if weights.price and targets.price_per_hour is not None:
        terms.append(f"{weights.price:g} · price of bytes / {targets.price_per_hour:g} /h")
    terms.append(f"{weights.switching:g} · share of the tasks moved")
    of = "; U of accelerators, too" if objective.accelerators else ""
    return f"J = {' + '.join(terms)}{of}"


def _caps(problem: Problem) -> str:
    caps = problem.objective.caps
    found = []
    if math.isfinite(caps.latency_ms):
        found.append(f"L95 {caps.latency_ms:g} ms")
    if math.isfinite(caps.utilisation):
        found.append(f"U {percent(caps.utilisation)}")
    if caps.misses is not None:
        found.append(f"at most {counted(caps.misses.m, 'miss')} in {caps.misses.k} cycles")
    return ", ".join(found) or "–"


def describe_contenders(problem: Problem, names: Iterable[str]) -> dict[str, str]:
    """Return a sentence per policy, variant and estimator, by the shown name.

    `names` are names of policies in tables; the result leaves out unknown names.
    """
    names = tuple(names)
    sentences: dict[str, str] = {}
    statics = [name for name in problem.candidates if name in names]
    if statics:
        sentences[", ".join(statics)] = "Placements; as policies these never move."
    known = [one for one in map(contended, names) if one is not None]
    for family, policy in FAMILIES.items():
        if any(one.family == family for one in known):
            remark = f" {OURS}" if family == "atp" else ""
            sentences[shown_contender(family)] = f"{policy.sentence}{remark}"
    if "DTP as printed" in names:
        sentences["DTP as printed"] = "has the profile, one decision per window, and N_min = 3."
    parts = {part for one in known for part in (one.variant, one.belief)}
    for form, texts in (("… ({})", BELIEFS), ("…-{}", VARIANTS)):
        sentences |= {form.format(name): text for name, text in texts.items() if name in parts}
    return sentences


def numbered(seeds: Sequence[int]) -> str:
    """Return seeds as text: a range, ``seeds 1 to 20``, or a list, ``seeds 1, 5``."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"seeds {seeds[0]} to {seeds[-1]}"
    return f"{'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}"
