"""The report of a comparison: one page that answers its question, and shows what from."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from html import escape

import numpy as np

from dwell.model import Node
from dwell.report import figures
from dwell.report.contenders import describe_contenders, palette_of
from dwell.report.findings import (
    COST,
    DTP,
    RATE,
    Status,
    beliefs,
    explain,
    judge_all,
    limits,
    question,
    standing,
    verdict,
)
from dwell.report.formatting import (
    OURS,
    Measure,
    listed,
    percent,
    shown_contender,
    shown_policy,
    shown_scenario,
    write_interval,
    write_number,
)
from dwell.report.method import method
from dwell.report.page import (
    Cell,
    definitions,
    document,
    figure,
    items,
    marked,
    named,
    paragraph,
    section,
    swatch,
    table,
)
from dwell.report.palette import Palette
from dwell.report.style import PageStyle
from dwell.study import AIM, Comparison, Interval, StudyResult
from dwell.study.predictions import Answer, Prediction, judge_claim

__all__ = ["comparison_html"]

TITLE = "Placement policies compared"
L95 = Measure("l95_ms", "L95", "ms")
MEASURES = (
    RATE,
    L95,
    COST,
    Measure("u_robot", "U_r", "%", 100.0),
    Measure("u_edge", "U_e", "%", 100.0),
    Measure("migrations", "migrations"),
)
MORE = (
    Measure("p95_ms", "P95 of all cycles", "ms", ends=True),
    Measure("lost", "lost cycles"),
    Measure("compute_ms", "computing", "ms"),
    Measure("queue_ms", "waiting", "ms"),
    Measure("network_ms", "network", "ms"),
)
ACTUATOR = (
    Measure("longest_misses", "misses in a row"),
    Measure("misses_in_20", "most misses in 20"),
    Measure("over_5_in_100", "stretches of 100 with more than 5", "%", 100.0),
    Measure("aoi_mean_ms", "mean age", "ms"),
    Measure("aoi_p95_ms", "age for 95 % of the time", "ms"),
    Measure("aoi_peak_ms", "largest age", "ms"),
    Measure("tracking_rms_mm", "tracking error", "mm"),
)
TAGS: dict[Answer, tuple[str, str]] = {
    "agrees": ("agrees", "good"),
    "agrees in part": ("agrees in part", "open"),
    "differs": ("differs", "bad"),
    "open": ("not decided by these runs", "open"),
}
STANDING: dict[Status, tuple[str, str]] = {
    "under": ("under", "good"),
    "above": ("above", "bad"),
    "open": ("open", "open"),
    "no miss": ("no miss", "open"),
}


def comparison_html(*comparisons: Comparison, tenants: StudyResult | None = None) -> str:
    """Return a self-contained page about one comparison, or about several one after the other.

    Parameters
    ----------
    *comparisons : Comparison
        At least one, of cells with different names.
    tenants : StudyResult, optional
        Of `dwell.study.tenants_demo`; a table of its own.

    Returns
    -------
    str
        HTML without scripts, and without anything that is loaded from elsewhere.
    """
    body = [f"<h1>{TITLE}</h1>"]
    for comparison in comparisons:
        if len(comparisons) > 1:
            body.append(f'<h1 class="chapter">Cell {escape(comparison.problem.name)}</h1>')
        body += _chapter(comparison, tenants)
    return document(TITLE, body)


def _chapter(comparison: Comparison, tenants: StudyResult | None) -> Iterator[str]:
    palette = palette_of(comparison.problem, comparison.policies)
    look = PageStyle(palette, frozenset(comparison.scenarios))
    yield paragraph(_subtitle(comparison), "subtitle")
    yield paragraph(question(comparison), "question")
    yield items(verdict(comparison))
    yield section("Results", *_results(comparison, palette))
    if tenants is not None:
        yield section("V_D by the share of time that E’s tenants take", _tenants(tenants))
    if judge_all(comparison):
        yield section("Prediction and result", *_predictions(comparison, palette))
    yield section("Figures", *_figures(comparison, look))
    shown = _shown_in_time(comparison)
    if shown is not None:
        heading = f"{shown_policy(shown)} through time"
        yield section(heading, *_timelines(comparison, look, shown))
        yield section("What was estimated, and what was measured", _beliefs(comparison, shown))
    yield section("More numbers", *_more(comparison))
    yield section("How it was measured", *method(comparison))
    yield section("What it does not say", items(limits(comparison)))


def _subtitle(comparison: Comparison) -> str:
    problem = comparison.problem
    minutes = comparison.windows * problem.window_cycles * problem.pipeline.period_ms / 60e3
    runs = len(comparison.scenarios) * len(comparison.policies) * len(comparison.seeds)
    return (
        f"Cell “{problem.name}”: {len(comparison.scenarios)} scenarios × "
        f"{len(comparison.policies)} policies × {len(comparison.seeds)} seeds = {runs} runs of "
        f"{write_number(minutes)} minutes, simulated"
    )


# ----------------------------------------------------------------------------------- results


def _results(comparison: Comparison, palette: Palette) -> Iterator[str]:
    problem = comparison.problem
    yield definitions(describe_contenders(problem, comparison.policies))
    yield paragraph(
        "V_D is the share of cycles that finished after the deadline or not at all; L95 the 95th "
        "percentile of a window's latencies, averaged over the windows; U_r and U_e the "
        "utilisation of the busiest robot and edge node; J the cost that weighs all of these and "
        "that DTP seeks to lower. Migrations are those of one run of "
        f"{comparison.windows - problem.warmup_windows} windows. Each number is the mean over "
        f"{len(comparison.seeds)} seeds with its 95 % interval."
    )
    head = [Cell("policy")]
    for measure in MEASURES:
        head.append(Cell(marked(measure.heading), "pair", 2))
        if measure is RATE:
            head.append(Cell(marked("V_D is")))
    head += [Cell(f"{escape(name)} (%)", "num") for name in problem.candidates]
    rows: list[tuple[str, Sequence[Cell]]] = []
    width = 2 * len(MEASURES) + 2 + len(problem.candidates)
    for scenario in comparison.scenarios:
        rows.append(("group", [Cell(escape(shown_scenario(scenario)), columns=width)]))
        rows += [
            ("", _result_row(comparison, palette, scenario, policy))
            for policy in comparison.policies
        ]
    yield table(
        head,
        rows,
        f"{_columns(problem.candidates)} the mean shares of the windows that began under each. "
        "Bold: the lowest V_D and J of a scenario. V_D is “under” 5 % where its one-sided 95 % "
        "limit is, “above” where its lower limit is, else “open”."
        f"{_on_no_miss(comparison)}{_ours(comparison)}",
        kind="wide of-chapter small",
    )


def _tenants(result: StudyResult) -> str:
    """Return V_D of every contender of the study of tenants, by scenario and share of the time."""
    (column,) = result.parameters
    shares = [_share_of_bursts(point.problem.fabric.nodes["E"]) for point in result.study.points]
    found: dict[tuple[str, str], list[Interval]] = {}
    for row in result.table(["violation_rate"]).sort(column, descending=True).to_dicts():
        value, *ends = (row[f"violation_rate{end}"] for end in ("", "_low", "_high"))
        low, high = (math.nan if end is None else end for end in ends)
        found.setdefault((row["scenario"], row["policy"]), []).append(Interval(value, low, high))
    rows: list[tuple[str, Sequence[Cell]]] = []
    for scenario in result.study.scenarios:
        rows.append(
            ("group", [Cell(escape(shown_scenario(scenario)), columns=1 + 2 * len(shares))])
        )
        for policy in result.study.policies:
            pairs = [_pair(interval, RATE) for interval in found[scenario, policy]]
            rows.append(("", [Cell(escape(shown_contender(policy))), *itertools.chain(*pairs)]))
    seeds = len(result.study.seeds)
    return table(
        [Cell("policy"), *(Cell(percent(share, 2), "pair", 2) for share in sorted(shares))],
        rows,
        f"V_D in %, mean over {seeds} seeds with its 95 % interval.",
        kind="small",
    )


def _share_of_bursts(node: Node) -> float:
    """Share of the time that a node's bursts last."""
    if node.bursts is None:
        return 0.0
    every_ms, for_ms = node.bursts.every_ms.expectation, node.bursts.for_ms.expectation
    return for_ms / (every_ms + for_ms)


def _on_no_miss(comparison: Comparison) -> str:
    """Say what “no miss” is, where the table says it."""
    found = (
        standing(comparison, scenario, policy)
        for scenario in comparison.scenarios
        for policy in comparison.policies
    )
    if "no miss" not in found:
        return ""
    return " “No miss” is open too: none was seen, in too few runs to show more."


def _columns(names: Iterable[str]) -> str:
    names = list(names)
    return f"Columns {listed(names)} are" if len(names) > 1 else f"Column {names[0]} is"


def _result_row(comparison: Comparison, palette: Palette, scenario: str, policy: str) -> list[Cell]:
    row = [Cell(_named(palette, policy))]
    for measure in MEASURES:
        means = {
            name: comparison.values(scenario, name, measure.column).mean()
            for name in comparison.policies
        }
        best = measure in (RATE, COST) and means[policy] == min(means.values())
        row += _pair(comparison.interval(scenario, policy, measure.column), measure, best=best)
        if measure is RATE:
            word, kind = STANDING[standing(comparison, scenario, policy)]
            row.append(Cell(f'<span class="{kind} nowrap">{word}</span>'))
    for name in comparison.problem.candidates:
        share = 100 * comparison.interval(scenario, policy, f"share_{name}").value
        row.append(Cell(write_number(share, 0), "num"))
    return row


def _pair(interval: Interval, measure: Measure, *, best: bool = False) -> list[Cell]:
    """Return a number and its error as two cells, so that columns of numbers align."""
    written = write_interval(interval, measure)
    return [Cell(written.value, "num best" if best else "num"), Cell(escape(written.error), "err")]


def _named(palette: Palette, policy: str) -> str:
    colour = palette.policies[policy].colour
    return named(shown_contender(policy), colour, ring=policy not in palette.placements)


def _ours(comparison: Comparison) -> str:
    """Say what ATP is beside everything that shows it."""
    return f" {OURS}" if "atp" in comparison.policies else ""


# ------------------------------------------------------------------------------- predictions


def _predictions(comparison: Comparison, palette: Palette) -> Iterator[str]:
    judged = judge_all(comparison)
    yield paragraph(
        "The paper predicts which placement dominates under DTP in each scenario, and how LOC and "
        "SO behave. Its words are read as conditions on numbers, given beside them; a condition "
        "holds or fails only where the 95 % interval over seeds says so."
    )
    rows: list[tuple[str, Sequence[Cell]]] = []
    for judgement in judged:
        prediction = judgement.prediction
        word, kind = TAGS[judgement.answer]
        rows.append(
            (
                "",
                [
                    Cell(escape(shown_scenario(prediction.scenario))),
                    Cell(escape(prediction.dtp)),
                    Cell(_shares(comparison, palette, prediction.scenario)),
                    Cell(f'<span class="{kind} nowrap">{word}</span>'),
                ],
            )
        )
    head = [Cell("scenario"), Cell("predicted"), Cell("share of the windows here"), Cell("")]
    yield table(head, rows, kind="prose")
    for judgement in judged:
        prediction = judgement.prediction
        word, kind = TAGS[judgement.answer]
        yield (
            f"<h3>{escape(shown_scenario(prediction.scenario))}"
            f'<span class="tag {kind}">{word}</span></h3>'
        )
        yield (
            f"<p>Predicted under DTP: “{escape(prediction.dtp)}”, "
            f'<span class="note">read as: {marked(prediction.reading)}.</span></p>'
        )
        yield paragraph(" ".join(explain(comparison, judgement)))
        yield _claims(comparison, prediction)


def _shares(comparison: Comparison, palette: Palette, scenario: str) -> str:
    """Return the shares of windows under DTP, the largest first."""
    found = {
        name: comparison.interval(scenario, DTP, f"share_{name}").value
        for name in comparison.problem.candidates
    }
    order = sorted(found, key=lambda name: -found[name])
    return "&emsp; ".join(
        f'<span class="nowrap">{swatch(palette.placements[name])}{escape(name)} '
        f"{marked(percent(found[name]))}</span>"
        for name in order
        if found[name] > 0
    )


def _claims(comparison: Comparison, prediction: Prediction) -> str:
    """Return the table of what the paper says of static placements."""
    rows: list[tuple[str, Sequence[Cell]]] = []
    for policy, claims in prediction.claims.items():
        for claim in claims:
            word, kind = TAGS[judge_claim(comparison, prediction.scenario, claim)]
            cells = [
                Cell(escape(policy)),
                Cell(marked(f"“{claim.words}”")),
                Cell(marked(claim.reading)),
                Cell(f'<span class="{kind}">{word}</span>'),
            ]
            rows.append(("", cells))
    head = [Cell("static"), Cell("predicted"), Cell("read as"), Cell("")]
    return table(head, rows, kind="prose")


# ----------------------------------------------------------------------------------- figures


def _figures(comparison: Comparison, look: PageStyle) -> Iterator[str]:
    deadline_ms = comparison.problem.pipeline.deadline_ms
    yield figure(
        figures.intervals(comparison, look, RATE, "percent", limit=AIM, name="the aim, 5 %"),
        "V_D, the share of missed deadlines: mean over seeds, with its 95 % interval as a bar "
        f"where that is wider than the mark. An open mark at the left edge: less, or none."
        f"{_ours(comparison)}",
    )
    yield figure(
        figures.intervals(comparison, look, L95, "ms", limit=deadline_ms, name="the deadline"),
        "Tail latency: L95 as the controller sees it, a cycle that has not finished counting with "
        "its age.",
    )
    yield figure(
        figures.distributions(comparison, look),
        "Latency of all cycles after the warm-up, all seeds together: one less the empirical "
        "distribution function, on a logarithmic scale. Where a curve crosses the dashed line one "
        "reads V_D; below the dotted line that is less than 5 %. A curve that ends on a plateau "
        "lost that share of its cycles.",
    )
    moving = [name for name in comparison.policies if name not in comparison.statics]
    if moving:
        yield figure(
            figures.placement_shares(comparison, look.palette, moving),
            "Where the policies that move spent their windows.",
        )
    yield figure(
        figures.latency_split(comparison),
        "Where the time goes along the critical path of the cycles that finished: computing, "
        "waiting for a worker, and on the network. Lost cycles are not in it.",
    )
    yield figure(
        figures.node_use(comparison),
        "Utilisation of each node as its operating system shows it: foreign work included.",
    )


def _shown_in_time(comparison: Comparison) -> str | None:
    """Which policy the timelines show: DTP, else the first that moves."""
    moving = [name for name in comparison.policies if name not in comparison.statics]
    return DTP if DTP in moving else next(iter(moving), None)


def _timelines(comparison: Comparison, look: PageStyle, policy: str) -> Iterator[str]:
    yield paragraph(
        f"One run in each scenario, of seed {comparison.seeds[0]}. Each mark is a window and has "
        "the colour of the placement that was active. In the lowest panel the lines without marks "
        "are what the policy believed that the other placements would cost: where a line lies "
        "below the marks of its colour, the estimate was too good."
    )
    for scenario in comparison.scenarios:
        example = comparison.examples[scenario, policy]
        yield f"<h3>{escape(shown_scenario(scenario))}</h3>"
        svg = figures.through_time(comparison, look, scenario, policy)
        moves = int(example.decisions["migrated"].sum())
        yield figure(svg, f"{shown_policy(policy)}: {moves} migrations, the warm-up included.")


# ------------------------------------------------------------------------------------ tables


def _beliefs(comparison: Comparison, policy: str) -> str:
    """Return the table of estimated against measured J."""
    colours = Palette.of(comparison.problem.candidates).placements
    above, head = [Cell("")], [Cell("scenario")]
    for name, colour in colours.items():
        above.append(Cell(swatch(colour) + escape(name), "over", 3))
        head += [Cell("idle", "num begin"), Cell("active", "num"), Cell("alone", "num")]
    rows: list[tuple[str, Sequence[Cell]]] = []
    for scenario in comparison.scenarios:
        row = [Cell(escape(shown_scenario(scenario)))]
        for belief in beliefs(comparison, scenario, policy):
            row.append(Cell(write_number(belief.estimated, COST.decimals), "num begin"))
            row.append(Cell(write_number(belief.active, COST.decimals), "num"))
            row.append(Cell(write_number(belief.alone, COST.decimals), "num"))
        rows.append(("", row))
    return table(
        head,
        rows,
        "J of each placement, mean over seeds. Idle: as estimated for "
        f"{shown_policy(policy)} by “{comparison.problem.controller.estimator}” while another "
        "was active, the cost of switching to it included. Active: as measured while it was. "
        "Alone: as measured of the static placement on the same realisations. A dash: never so.",
        above=above,
    )


def _more(comparison: Comparison) -> Iterator[str]:
    cycles = float(np.mean(comparison.runs["cycles"].to_numpy()))
    yield _numbers(
        comparison,
        MORE,
        "P95 is the 95th percentile of the final latencies of all cycles of a run, ∞ where more "
        "than 5 % never finished; its value is the median over seeds, its interval lies between "
        "order statistics. Lost are cycles of which a message, a job or an input was dropped or "
        f"replaced, of {write_number(cycles, 0)} in a run. The last three are means over the "
        "cycles that finished.",
    )
    measures = [measure for measure in ACTUATOR if measure.column in comparison.runs.columns]
    if len(measures) > 1:
        yield "<h3>What the actuator got</h3>"
        yield _numbers(
            comparison,
            measures,
            "Misses in a row, and the most in any 20 cycles that follow one another; the share of "
            "stretches of 100 cycles with more than 5 misses. Age is that of the newest command "
            "in effect, from the release of its cycle on. The tracking error is the root of the "
            "mean square of the servo's, a median over seeds.",
        )


def _numbers(comparison: Comparison, measures: Sequence[Measure], caption: str) -> str:
    """Return a table of columns by scenario and policy."""
    palette = palette_of(comparison.problem, comparison.policies)
    head = [Cell("policy"), *(Cell(marked(measure.heading), "pair", 2) for measure in measures)]
    rows: list[tuple[str, Sequence[Cell]]] = []
    for scenario in comparison.scenarios:
        heading = Cell(escape(shown_scenario(scenario)), columns=2 * len(measures) + 1)
        rows.append(("group", [heading]))
        for policy in comparison.policies:
            row = [Cell(_named(palette, policy))]
            for measure in measures:
                row += _pair(comparison.interval(scenario, policy, measure.column), measure)
            rows.append(("", row))
    return table(head, rows, f"{caption}{_ours(comparison)}", kind="of-chapter small")
