"""The report of a comparison: one page that answers its question, and shows what from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING

from dwell.model import Disturbance, NodeDisturbance, Problem, Scenario
from dwell.report import figures
from dwell.report.findings import (
    COST,
    DTP,
    RATE,
    Status,
    explain,
    judge_all,
    limits,
    question,
    standing,
    verdict,
)
from dwell.report.page import (
    Cell,
    definitions,
    document,
    figure,
    items,
    marked,
    paragraph,
    section,
    swatch,
    table,
)
from dwell.report.palette import INK, Palette
from dwell.report.timeline import timeline
from dwell.report.wording import (
    Measure,
    listed,
    shown_policy,
    shown_scenario,
    write_interval,
    write_number,
)
from dwell.study import AIM, Comparison, Interval
from dwell.study.predictions import Answer, judge_claim

if TYPE_CHECKING:
    import polars as pl

__all__ = ["comparison_html"]

TITLE = "Placement policies compared"
L95 = Measure("l95_ms", "L95", "ms")
MEASURES = (
    RATE,
    L95,
    Measure("u_robot", "U_r", "%", 100.0),
    Measure("u_edge", "U_e", "%", 100.0),
    Measure("migrations", "migrations"),
)
MORE = (
    Measure("p95_ms", "P95 of all cycles", "ms"),
    Measure("lost", "lost cycles"),
    Measure("longest_misses", "misses in a row"),
    Measure("compute_ms", "computing", "ms"),
    Measure("queue_ms", "waiting", "ms"),
    Measure("network_ms", "network", "ms"),
)
TAGS: dict[Answer, tuple[str, str]] = {
    "agrees": ("agrees", "good"),
    "agrees in part": ("agrees in part", "open"),
    "differs": ("differs", "bad"),
    "open": ("not decided by these runs", "open"),
}
STANDING: dict[Status, tuple[str, str]] = {
    "under": ("under 5 %", "good"),
    "above": ("above", "bad"),
    "open": ("not shown", "open"),
    "none seen": ("no miss", "good"),
}


def comparison_html(*comparisons: Comparison) -> str:
    """Return a self-contained page about one comparison, or about several one after the other.

    Parameters
    ----------
    *comparisons : Comparison
        At least one, of cells with different names.

    Returns
    -------
    str
        HTML without scripts, and without anything that is loaded from elsewhere.
    """
    body = [f"<h1>{TITLE}</h1>"]
    for comparison in comparisons:
        if len(comparisons) > 1:
            body.append(f'<h1 class="chapter">{escape(comparison.problem.name)}</h1>')
        body += _chapter(comparison)
    return document(TITLE, body)


def _chapter(comparison: Comparison) -> Iterator[str]:
    palette = Palette.of(comparison.problem.candidates, comparison.policies)
    yield paragraph(_subtitle(comparison), "subtitle")
    yield paragraph(question(comparison), "question")
    yield items(verdict(comparison))
    yield section("Results", *_results(comparison, palette))
    if judge_all(comparison):
        yield section("Prediction and result", *_predictions(comparison))
    yield section("Figures", *_figures(comparison, palette))
    shown = _shown_in_time(comparison)
    if shown is not None:
        heading = f"{shown_policy(shown)} through time"
        yield section(heading, *_timelines(comparison, palette, shown))
        yield section("What was estimated, and what was measured", _beliefs(comparison, shown))
    yield section("More numbers", _more(comparison))
    yield section("How it was measured", *_method(comparison))
    yield section("What it does not say", items(limits(comparison)))


def _subtitle(comparison: Comparison) -> str:
    problem = comparison.problem
    minutes = comparison.windows * problem.window_cycles * problem.pipeline.period_ms / 60e3
    runs = len(comparison.scenarios) * len(comparison.policies) * len(comparison.seeds)
    return (
        f"Cell “{problem.name}”: {len(comparison.scenarios)} scenarios × "
        f"{len(comparison.policies)} policies × {len(comparison.seeds)} seeds = {runs} simulated "
        f"runs of {write_number(minutes)} minutes each"
    )


# ----------------------------------------------------------------------------------- results


def _results(comparison: Comparison, palette: Palette) -> Iterator[str]:
    problem = comparison.problem
    statics = [name for name in problem.candidates if name in comparison.policies]
    if statics:
        yield paragraph(f"{_placements(problem, statics)} These never move; the others do.")
    yield paragraph(
        "V_D is the share of cycles that finished after the deadline or not at all; L95 the 95th "
        "percentile of a window's latencies, averaged over the windows; U_r and U_e the "
        "utilisation of the busiest robot and edge node; J the cost that weighs all of these and "
        "that DTP seeks to lower. Migrations are those of one run. Each number is the mean over "
        f"{len(comparison.seeds)} seeds with its 95 % interval."
    )
    shares = [Measure(f"share_{name}", name, "%", 100.0, decimals=0) for name in problem.candidates]
    measures = (*MEASURES, *shares, COST)
    head = [Cell("policy")]
    for measure in measures:
        head.append(Cell(marked(measure.heading), "pair", 2))
        if measure is RATE:
            head.append(Cell("to 5 %"))
    rows: list[tuple[str, Sequence[Cell]]] = []
    width = 2 * len(measures) + 2
    for scenario in comparison.scenarios:
        rows.append(("group", [Cell(escape(shown_scenario(scenario)), columns=width)]))
        rows += [
            ("", _result_row(comparison, palette, measures, scenario, policy))
            for policy in comparison.policies
        ]
    yield table(
        head,
        rows,
        "The last columns but one are the shares of windows that began under each placement. Bold: "
        "the lowest V_D and J of a scenario. “Under 5 %” stands where the one-sided 95 % limit of "
        "V_D is below 5 %, “above” where the limit from below is above it.",
    )


def _result_row(
    comparison: Comparison,
    palette: Palette,
    measures: Sequence[Measure],
    scenario: str,
    policy: str,
) -> list[Cell]:
    row = [Cell(_named(palette, policy))]
    for measure in measures:
        means = {
            name: comparison.values(scenario, name, measure.column).mean()
            for name in comparison.policies
        }
        best = measure in (RATE, COST) and means[policy] == min(means.values())
        row += _pair(comparison.interval(scenario, policy, measure.column), measure, best=best)
        if measure is RATE:
            word, kind = STANDING[standing(comparison, scenario, policy)]
            row.append(Cell(f'<span class="{kind}">{word}</span>'))
    return row


def _pair(interval: Interval, measure: Measure, *, best: bool = False) -> list[Cell]:
    """Return a number and its error as two cells, so that columns of numbers align."""
    written = write_interval(interval, measure)
    return [Cell(written.value, "num best" if best else "num"), Cell(written.error, "err")]


def _named(palette: Palette, policy: str) -> str:
    """Return a policy's name behind its mark: a square for a placement, a ring for the others."""
    colour = palette.policies[policy].colour
    name = escape(shown_policy(policy))
    if policy in palette.placements:
        return swatch(colour) + name
    ring = "currentColor" if colour == INK else colour
    return f'<span class="swatch ring" style="border-color:{ring}"></span>{name}'


def _placements(problem: Problem, names: Sequence[str]) -> str:
    """Say where each candidate puts the tasks that can move."""
    movable = [name for name, task in problem.pipeline.tasks.items() if not task.anchored]
    parts = []
    for name in names:
        placement = problem.candidates[name]
        where = listed(f"{task} on {placement[task]}" for task in movable)
        parts.append(f"{name} has {where}" if where else f"{name} is the only placement")
    return "; ".join(parts) + "."


# ------------------------------------------------------------------------------- predictions


def _predictions(comparison: Comparison) -> Iterator[str]:
    yield paragraph(
        "What the paper's table of scenarios says, in its words, and what the runs say. Words are "
        "read as conditions on numbers, given in brackets; a condition holds or fails only where "
        "the 95 % interval over seeds says so. On this cell the paper predicts; it does not report."
    )
    for judgement in judge_all(comparison):
        prediction = judgement.prediction
        word, kind = TAGS[judgement.answer]
        yield (
            f"<h3>{escape(shown_scenario(prediction.scenario))}"
            f'<span class="tag {kind}">{word}</span></h3>'
        )
        yield (
            f"<p>Predicted under DTP: <b>“{escape(prediction.dtp)}”</b> "
            f'<span class="note">[{escape(prediction.reading)}]</span></p>'
        )
        yield paragraph(" ".join(explain(comparison, judgement)))
        rows: list[tuple[str, Sequence[Cell]]] = []
        for policy, claims in prediction.claims.items():
            for claim in claims:
                word, kind = TAGS[judge_claim(comparison, prediction.scenario, claim)]
                rows.append(
                    (
                        "",
                        [
                            Cell(escape(policy)),
                            Cell(marked(f"“{claim.words}”")),
                            Cell(marked(claim.reading)),
                            Cell(f'<span class="{kind}">{word}</span>'),
                        ],
                    )
                )
        head = [Cell("static"), Cell("the paper"), Cell("read as"), Cell("these runs")]
        yield table(head, rows, "")


# ----------------------------------------------------------------------------------- figures


def _figures(comparison: Comparison, palette: Palette) -> Iterator[str]:
    deadline_ms = comparison.problem.pipeline.deadline_ms
    yield figure(
        figures.intervals(comparison, palette, RATE, limit=AIM, limit_name="the aim, 5 %"),
        "Missed deadlines: mean over seeds, with the 95 % interval as a bar where it is wider than "
        "the mark. Open marks at the left edge: no miss. The axis may be logarithmic.",
    )
    yield figure(
        figures.intervals(comparison, palette, L95, limit=deadline_ms, limit_name="the deadline"),
        "Tail latency: L95 as the controller sees it, a cycle that has not finished counting with "
        "its age.",
    )
    yield figure(
        figures.distributions(comparison, palette),
        "Final latencies of all cycles after the warm-up, all seeds together. A curve that "
        "crosses the dashed line below the dotted one misses more than 5 %; one that never "
        "reaches 100 % lost cycles.",
    )
    moving = [name for name in comparison.policies if name not in comparison.statics]
    if moving:
        yield figure(
            figures.placement_shares(comparison, palette, moving),
            "Where the policies that move spent their windows.",
        )
    yield figure(
        figures.latency_split(comparison),
        "Where the time goes along the critical path of the cycles that finished: computing, "
        "waiting for a worker or for other inputs, and on the network. Lost cycles are not in it.",
    )
    yield figure(
        figures.node_use(comparison),
        "Utilisation of each node as its operating system shows it: foreign work included.",
    )


def _shown_in_time(comparison: Comparison) -> str | None:
    """Which policy the timelines show: DTP, else the first that moves."""
    moving = [name for name in comparison.policies if name not in comparison.statics]
    return DTP if DTP in moving else next(iter(moving), None)


def _timelines(comparison: Comparison, palette: Palette, policy: str) -> Iterator[str]:
    problem = comparison.problem
    yield paragraph(
        f"One run in each scenario, of seed {comparison.seeds[0]}. Each mark is a window and has "
        "the colour of the placement that was active. In the lowest panel the lines are what the "
        "policy believed the other placements would cost: where a line lies below the marks of "
        "its colour, the estimate was too good."
    )
    for scenario in comparison.scenarios:
        example = comparison.examples[scenario, policy]
        yield f"<h3>{escape(shown_scenario(scenario))}</h3>"
        svg = timeline(
            example.windows,
            example.decisions,
            placements=palette.placements,
            period_ms=problem.pipeline.period_ms,
            deadline_ms=problem.pipeline.deadline_ms,
            name=f"time-{problem.name}-{scenario}",
        )
        moves = int(example.decisions["migrated"].sum())
        yield figure(svg, f"{shown_policy(policy)}: {moves} migrations, the warm-up included.")


# ------------------------------------------------------------------------------------ tables


def _beliefs(comparison: Comparison, policy: str) -> str:
    """Return the table of estimated against measured J."""
    import polars as pl

    palette = Palette.of(comparison.problem.candidates)
    head = [
        Cell("placement"),
        Cell("estimated while not active", "num"),
        Cell(f"measured under {escape(shown_policy(policy))}", "num"),
        Cell("measured when run alone", "num"),
    ]
    rows: list[tuple[str, Sequence[Cell]]] = []
    mine = comparison.costs.filter(pl.col("policy") == policy)
    for scenario in comparison.scenarios:
        rows.append(("group", [Cell(escape(shown_scenario(scenario)), columns=4)]))
        here = mine.filter(pl.col("scenario") == scenario)
        for name, colour in palette.placements.items():
            found = here.filter(pl.col("candidate") == name)
            numbers = [_known_mean(found[column]) for column in ("estimated", "measured")]
            if name in comparison.statics:
                numbers.append(float(comparison.values(scenario, name, "cost").mean()))
            else:
                numbers.append(math.nan)
            cells = [Cell(write_number(number, COST.decimals), "num") for number in numbers]
            rows.append(("", [Cell(swatch(colour) + escape(name)), *cells]))
    return table(
        head,
        rows,
        f"J of each placement, mean over seeds. Estimates are those that "
        f"{shown_policy(policy)} was given (“{comparison.problem.controller.estimator}”), the "
        "switching term included; a dash: it was never, or always, active.",
    )


def _more(comparison: Comparison) -> str:
    palette = Palette.of(comparison.problem.candidates, comparison.policies)
    head = [Cell("policy"), *(Cell(marked(measure.heading), "pair", 2) for measure in MORE)]
    rows: list[tuple[str, Sequence[Cell]]] = []
    for scenario in comparison.scenarios:
        rows.append(("group", [Cell(escape(shown_scenario(scenario)), columns=2 * len(MORE) + 1)]))
        for policy in comparison.policies:
            row = [Cell(_named(palette, policy))]
            for measure in MORE:
                row += _pair(comparison.interval(scenario, policy, measure.column), measure)
            rows.append(("", row))
    cycles = comparison.runs["cycles"].mean()
    return table(
        head,
        rows,
        "P95 is the 95th percentile of the final latencies of all cycles of a run, ∞ where more "
        "than 5 % never finished; its value is the median over seeds, its interval lies between "
        "order statistics. Lost are cycles of which a message, a job or an input was dropped or "
        f"replaced, of {write_number(cycles if isinstance(cycles, float) else math.nan, 0)} in a "
        "run. The last three are means over the cycles that finished.",
    )


# ------------------------------------------------------------------------------------ method


def _method(comparison: Comparison) -> Iterator[str]:
    problem = comparison.problem
    pipeline, objective, controller = problem.pipeline, problem.objective, problem.controller
    weights, targets, caps = objective.weights, objective.targets, objective.caps
    span_s = problem.window_cycles * pipeline.period_ms / 1e3
    yield paragraph(
        "For every scenario and seed one realisation of everything random (execution times, "
        "delays, losses, foreign load) is drawn before any policy acts, and every policy plays "
        "the same one. Differences between policies are therefore differences of pairs. A "
        "discrete-event simulation carries each cycle through queues, nodes and links. The "
        "controller sees a window when it closes, and decides for those after it."
    )
    yield definitions(
        {
            "pipeline": f"{' → '.join(pipeline.topological())}; period "
            f"{write_number(pipeline.period_ms)} ms, deadline "
            f"{write_number(pipeline.deadline_ms)} ms",
            "nodes": listed(
                f"{node.name} ({node.tier}, {node.cores} cores)"
                for node in problem.fabric.nodes.values()
            ),
            "window": f"{problem.window_cycles} cycles, {write_number(span_s)} s",
            "run": f"{comparison.windows} windows, of which the first {problem.warmup_windows} "
            "are warm-up and count nowhere",
            "seeds": _ranges(comparison.seeds),
            "scenarios": "; ".join(
                f"{shown_scenario(name)}: {disturbances(problem.scenario(name))}"
                for name in comparison.scenarios
            ),
            "cost": f"J = {weights.latency:g} · L95/{targets.latency_ms:.4g} ms + "
            f"{weights.violations:g} · V_D + {weights.robot:g} · U_r/{targets.robot:g} + "
            f"{weights.edge:g} · U_e/{targets.edge:g} + {weights.switching:g} · share of tasks "
            "moved",
            "caps": f"L95 {caps.latency_ms:g} ms, utilisation {caps.utilisation:g}",
            "controller": f"on {problem.controller_node}, begins with {problem.initial}; at "
            f"least {controller.min_dwell} windows between a migration and the next decision "
            f"(N_min), improvement above {controller.min_improvement:g} (Δ_min), estimator "
            f"“{controller.estimator}”",
            "intervals": "95 %, two-sided, over seeds: Student's t; medians by order statistics. "
            "No interval is taken over windows or cycles, which are not independent.",
            "versions": ", ".join(f"{name} {text}" for name, text in comparison.versions.items()),
        }
    )


def disturbances(scenario: Scenario) -> str:
    """Say what a scenario does to the fabric."""
    return listed(map(_disturbance, scenario)) or "nothing added"


def _disturbance(item: Disturbance) -> str:
    what = []
    if isinstance(item, NodeDisturbance):
        if item.stress_threads:
            what.append(f"{item.stress_threads} foreign threads on {item.node}")
        where = item.node
    else:
        where = item.link.replace("->", "→")
        if item.add_delay_ms is not None:
            what.append(f"+{item.add_delay_ms.expectation:.3g} ms on {where} in the mean")
        if item.loss:
            what.append(f"{item.loss:.1%} loss on {where}")
        if math.isfinite(item.rate_mbps):
            what.append(f"{item.rate_mbps:g} Mbit/s on {where}")
    if item.down:
        what.append(f"{where} down")
    text = listed(what) or f"nothing on {where}"
    if item.at_s or math.isfinite(item.for_s):
        until = f" for {item.for_s:g} s" if math.isfinite(item.for_s) else ""
        text += f" from {item.at_s:g} s{until}"
    return text


def _ranges(seeds: Sequence[int]) -> str:
    """``1 to 20``, or the list where it is none."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]} ({len(seeds)})"
    return ", ".join(map(str, seeds))


def _known_mean(values: pl.Series) -> float:
    mean = values.drop_nulls().drop_nans().mean()
    return float(mean) if isinstance(mean, float) else math.nan
